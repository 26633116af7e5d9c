"""One fault between driver and chip in a guided session: the result is right, or the session reports it.

`scripts/session_faults.py` does the same with hundreds of sessions.
"""

import pytest

import session_faults as rig
from fakes.faulty_chip import FAULTS


def task(kind, **changes):
    """A session of four short dwells with a fault in the dwell at any position."""
    usual = {
        "seed": 41, "plan": "four-position", "polled": True, "dwell_s": 0.5, "place": "any",
        "within": True, "preset": "40", "pulsing": False,
    }  # fmt: skip
    return rig.Task(kind=kind, **usual | changes)


KINDS = [*FAULTS, "restart", "dip", "dip-and-restart"]


@pytest.mark.parametrize("number", range(len(KINDS)))
def test_no_fault_gives_a_wrong_result_silently(number):
    polled, within = number % 2 == 0, number % 3 > 0
    found = rig.session(
        task(KINDS[number], seed=41 + number, polled=polled, within=within, pulsing=not polled)
    )
    assert found.fired
    assert found.outcome in rig.GOOD, (found.command, found.said, found.off)


@pytest.mark.parametrize("kind", ["restart", "offset", "range"])
def test_a_change_of_the_chip_between_two_dwells_is_reported(kind):
    found = rig.session(task(kind, seed=43, within=False, place="last"))
    assert (found.outcome, found.status) == ("reported", 1)
    assert found.dwells == 3


@pytest.mark.parametrize("polled", [True, False])
def test_without_a_fault_the_result_is_right_and_holds_the_offsets(polled):
    found = rig.session(task(rig.NO_FAULT, polled=polled, preset="written"))
    assert (found.outcome, found.fired) == ("right", False)
    assert {"delta_k", "delta_phi", "bias_x", "bias_y"} <= set(found.off)


@pytest.fixture
def blind(monkeypatch):
    """Switch off both comparisons of registers: during the session and of its file."""
    monkeypatch.setattr("adis_gonio.bench.session_bench.SessionBench.settings_lost", lambda bench: "")
    monkeypatch.setattr("adis_gonio.record.session_reader._changed_registers", lambda view: [])


@pytest.mark.usefixtures("blind")
def test_the_rig_finds_a_wrong_result_if_registers_are_not_compared():
    found = rig.session(task("restart", place="first", within=False))
    assert (found.outcome, found.status) == ("wrong", 0)
    assert abs(found.off["bias_x"]) > rig.MOST_U


def test_a_reported_session_goes_on_after_a_restart_only_with_the_offsets_that_it_began_with():
    fault = {"seed": 43, "place": "last", "within": False}
    same = rig.session(task("restart", **fault, preset="0"), resume=True)
    assert (same.outcome, same.resumed, same.resumed_said) == ("reported", "right", "")
    other = rig.session(task("restart", **fault, preset="40"), resume=True)
    assert (other.outcome, other.resumed) == ("reported", "reported")
    assert "XACCL_OFF was 40 and is 0" in other.resumed_said


def test_the_rig_finds_a_hung_session(monkeypatch):
    clean = rig.faulty_url(task(rig.NO_FAULT))
    monkeypatch.setattr(rig, "faulty_url", lambda task: clean.partition("&limit_s")[0] + "&limit_s=3")
    assert rig.session(task(rig.NO_FAULT)).outcome == "hung"


def test_the_rig_finds_an_exception_and_a_lost_dwell(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("adis_gonio.bench.session_bench.SessionBench.settings_lost", lambda bench: 1 / 0)
        assert rig.session(task(rig.NO_FAULT)).outcome == "traceback"
    monkeypatch.setattr(rig, "kept_dwells", lambda path: 0)
    assert rig.session(task("range", seed=43, place="last", within=False)).outcome == "lost"
