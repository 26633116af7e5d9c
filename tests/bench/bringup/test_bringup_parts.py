"""Parts of a bring-up without a board: runs of scans, limits of statistics, the summary of the steps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from adis_gonio.bench.bringup.bringup_step import (
    QUESTIONS,
    Bringup,
    BringupBench,
    BringupBus,
    BringupStep,
    Measured,
    NotMeasuredError,
    Outcome,
    StepResult,
    Verdict,
    highest_bin,
    longest_run,
    variance_ratio,
)
from adis_gonio.bench.bringup.link_steps import legal
from adis_gonio.bench.bringup.part_steps import flicker, spectrum
from adis_gonio.bench.bringup.update_steps import nearest_code
from adis_gonio.device.bus import SpiTiming
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.sim import SimBus, SimulatedChip, World


@pytest.mark.parametrize(
    ("times", "run"),
    [
        ([0.0], (0, 1)),
        ([0.0, 1.0, 2.0], (0, 3)),
        ([0.0, 1.49, 2.98], (0, 3)),  # less than one and a half steps is no gap
        ([0.0, 1.51, 2.5], (1, 3)),
        ([0.0, 1.0, 5.0, 6.0, 7.0, 12.0], (2, 5)),
        ([0.0, 1.0, 5.0, 6.0], (0, 2)),
    ],
)
def test_the_longest_run_of_scans_has_no_gap(times, run):
    assert longest_run(np.array(times), 1.0) == run
    assert longest_run(np.array(times) * 1e-3, 1e-3) == run


@pytest.mark.parametrize("dof", [2.0, 35.0, 4000.0])
def test_a_measured_variance_leaves_its_limits_once_in_a_million(dof):
    low, high = variance_ratio(dof)
    assert stats.chi2.cdf(low * dof, dof) == pytest.approx(0.5e-6, rel=1e-6)
    assert stats.chi2.sf(high * dof, dof) == pytest.approx(0.5e-6, rel=1e-6)


def test_the_largest_of_many_bins_of_white_noise_exceeds_its_limit_once_in_a_million():
    # Bins are exponential with the mean 1.
    assert 1 - stats.expon.cdf(highest_bin(1)) == pytest.approx(1e-6)
    assert stats.expon.sf(highest_bin(2000)) * 2000 == pytest.approx(1e-6)


def test_a_periodogram_has_the_variance_of_white_noise_in_each_bin_and_no_trend():
    rng = np.random.default_rng(1)
    values = rng.normal(0.0, [1.0, 3.0], (4096, 2)) + np.linspace(0, 500, 4096)[:, None]
    cycles, power = spectrum(values)
    assert (cycles[0], cycles[-1], len(cycles)) == (0.0, 0.5, 2049)
    assert power[1:-1].mean(axis=0) == pytest.approx([1.0, 9.0], rel=0.1)


def test_flicker_in_a_periodogram_falls_with_the_frequency_and_belongs_to_its_allan_deviation():
    level = flicker(np.array([0.1, 0.2]), np.array([1.0, 4.0]), 800.0)
    # A density h/f has the Allan variance 2 ln 2 h; a one-sided density S is the level S rate / 2.
    assert level[0, 0] == pytest.approx(0.1**2 / (2 * np.log(2)) * 400.0)
    assert level == pytest.approx(level[0, 0] * np.array([[1.0, 4.0], [0.25, 1.0]]))


# -- results of steps -------------------------------------------------------------------------------------


def row(name: str, verdict: Verdict) -> StepResult:
    return StepResult(name, "does something", "reads", verdict)


def summary(*verdicts: Verdict, unrestored: list[str] | None = None) -> Bringup:
    made = Bringup("sim:?seed=1", "adis16354", "2026-01-01T00:00:00+00:00", "adis-gonio")
    made.rows = [row(f"step {k}", verdict) for k, verdict in enumerate(verdicts)]
    if unrestored is not None:
        made.undo = SimpleNamespace(rows=["a", "b", "c"], unrestored=unrestored)
    return made


@pytest.mark.parametrize(
    ("verdicts", "accused", "sound", "headline"),
    [
        ([Verdict.OK], (), True, "No fault was found."),
        ([Verdict.OK, Verdict.FAULT], ("step 1",), False, "Fault: step 1."),
        (
            [Verdict.DIFFERS, Verdict.NOT_MEASURED],
            ("step 0",),
            True,
            "No fault was found; differs from the table: step 0; 1 of 2 steps not measured.",
        ),
        (
            [Verdict.FAULT, Verdict.DIFFERS, Verdict.FAULT],
            ("step 0", "step 1", "step 2"),
            False,
            "Fault: step 0, step 2; differs from the table: step 1.",
        ),
    ],
)
def test_a_bring_up_accuses_faults_and_differences_and_is_sound_without_faults(
    verdicts, accused, sound, headline
):
    made = summary(*verdicts)
    assert (made.accused, made.sound) == (accused, sound)
    assert made.headline == headline
    assert made.as_dict()["sound"] == sound


def test_a_register_that_was_not_put_back_spoils_the_bring_up():
    assert summary(Verdict.OK).undone == "nothing was written"
    good, bad = summary(Verdict.OK, unrestored=[]), summary(Verdict.OK, unrestored=["SENS_AVG"])
    assert (good.undone_ok, good.sound) == (True, True)
    assert "all 3 registers" in good.undone
    assert (bad.undone_ok, bad.sound) == (False, False)
    assert "NOT put back: SENS_AVG" in bad.headline
    assert bad.as_dict()["undone"]["verified"] is False


def test_a_step_ends_by_its_answers():
    found = row("filter", Verdict.NOT_MEASURED)
    with pytest.raises(NotMeasuredError):
        found.by_answers()
    found.check("filter_gain", True, "as the table says", Measured("gain", 0.4))
    assert found.by_answers() == (Verdict.OK, "as the table says")
    found.check("sample_period", False, "twice the period")
    assert found.by_answers() == (Verdict.DIFFERS, "twice the period")
    assert [one.outcome for one in found.answers.values()] == [Outcome.CONFIRMS, Outcome.CONTRADICTS]
    assert found.answers["filter_gain"].figures[0].value == 0.4


def test_a_question_that_no_step_answers_says_why():
    answers = {one["name"]: one for one in summary().as_dict()["answers"]}
    assert list(answers) == [question.name for question in QUESTIONS]
    assert "oscilloscope" in answers["data_ready_pulse"]["text"]
    assert answers["flash_count"]["text"] == "the step that answers it was not done"
    assert {one["outcome"] for one in answers.values()} == {"not measured"}


def test_a_step_is_described_by_the_first_line_of_its_docstring():
    def run(bench, found):
        """Read a register twice.

        And more.
        """

    made = BringupStep("twice", run).new_result("the board is blocked")
    assert (made.name, made.does, made.text) == ("twice", "Read a register twice", "the board is blocked")
    assert (made.effect, made.verdict) == ("reads", Verdict.NOT_MEASURED)


@pytest.mark.parametrize(("asked_hz", "given_hz"), [(1e6, 500e3), (250e3, 250e3)])
def test_the_bus_of_a_bring_up_limits_the_clock_and_keeps_its_calls(asked_hz, given_hz):
    bus = BringupBus(SimBus(World(seed=1)), 500e3)
    bus.configure(SpiTiming(asked_hz, 75.0, 160.0))
    assert bus.timing.clock_hz == given_hz
    before = len(bus.calls)
    bus.exchange([0x3800, 0])
    assert len(bus.calls) == before + 1


# -- contents of registers --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "word", "possible"),
    [
        ("ENDURANCE", 0x7FFF, True),
        ("ENDURANCE", 0x8000, False),
        ("SMPL_PRD", 0x0001, True),
        ("SMPL_PRD", 0x0000, False),
        ("SMPL_PRD", 0x0101, False),
        ("SENS_AVG", 0x0402, True),
        ("SENS_AVG", 0x0406, True),
        ("SENS_AVG", 0x0407, False),  # M is 6 at most
        ("SENS_AVG", 0x0201, False),  # ±150 °/s has M = 2 at least
        ("SENS_AVG", 0x0202, True),
        ("SENS_AVG", 0x0302, False),  # no range
        ("SENS_AVG", 0x8402, False),
        ("XACCL_OFF", 0x07FF, True),
        ("XACCL_OFF", 0x0FFF, True),  # −1, with zeros or its sign above
        ("XACCL_OFF", 0xFFFF, True),
        ("XACCL_OFF", 0x1FFF, False),
        ("XACCL_OFF", 0xF001, False),
        ("ALM_SMPL1", 0x00FF, True),
        ("ALM_SMPL1", 0x0100, False),
    ],
)
def test_a_register_holds_only_what_its_bits_allow(name, word, possible):
    assert legal(BY_NAME[name], word) == possible


@pytest.mark.parametrize(
    ("period_s", "code"),
    [(1 / 819.2, 0x01), (1.02 / 819.2, 0x01), (1e-9, 0x01), (1e3, 0xFF), (0.018921 * 3, 0x82)],
)
def test_a_measured_period_is_named_by_the_nearest_value_of_smpl_prd(period_s, code):
    assert nearest_code(period_s) == code


# -- reading ----------------------------------------------------------------------------------------------


def bench(ceiling_hz: float = 2e6, **flash: int) -> BringupBench:
    """Return a bench with a simulated sensor that has these words in its flash."""
    world = World(seed=1)
    inner = SimBus(world, chip=SimulatedChip(world, start_s=-0.5, flash=flash))
    bus = BringupBus(inner, ceiling_hz)
    return BringupBench(bus, Adis16354(bus))


@pytest.mark.parametrize(("unbroken", "count"), [(None, 50), (32, 31), (200, 50)])
def test_repeated_reads_give_as_many_words_as_the_bridge_sends_without_a_pause(unbroken, count):
    made = bench(XACCL_OFF=57)
    made.bus.unbroken_frames = unbroken
    words, frame_s = made.repeated("XACCL_OFF", 50)
    assert words.tolist() == [57] * count
    assert frame_s == pytest.approx(made.bus.timing.frame_s)


def test_scans_that_skip_updates_have_no_spectrum_but_means():
    names = ["XACCL_OUT", "YACCL_OUT", "ZACCL_OUT"]
    fast, slow = bench(), bench(ceiling_hz=31.25e3)
    for made in (fast, slow):
        made.refresh()
        assert len(made.scans(64, names)) == 64
        assert made.means(64, names) == pytest.approx(fast.means(64, names), abs=20)
    assert len(fast.scans(64, names, gaps=False)) >= 32
    with pytest.raises(NotMeasuredError, match="gaps"):
        slow.scans(64, names, gaps=False)


@pytest.mark.parametrize("word", [0x01, 0x03])
def test_a_step_that_may_write_sets_the_fastest_rate_if_it_is_another(word):
    made = bench(SMPL_PRD=word)
    before = len(made.bus.calls)
    made.sample_quickly()
    assert made.bus.inner.chip.memory["SMPL_PRD"] == 0x01
    frames = [frame for call in made.bus.calls[before:] if call.frames is not None for frame in call.frames]
    assert any(frame & 0x8000 for frame in frames) == (word != 0x01)
