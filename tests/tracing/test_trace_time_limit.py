"""A time limit ends a trace in order: the best model so far, and nothing found that was not validated.

The clocks count how often they are asked, so that nothing here depends on the speed of a machine.
"""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest

from adis_gonio import trace
from adis_gonio.base.budget import Budget, attempt, check, current, spent, within
from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import main
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing import trace_summary as words
from adis_gonio.tracing.trace import UNCHECKED
from adis_gonio.tracing.trace_result import TraceResult

NEVER = 10**9


class Ticks:
    """A clock that goes on by one each time that it is read."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self) -> float:
        self.count += 1
        return float(self.count)


def turn(checks: int = 0, seed: int = 3) -> Session:
    """A turn of 20 dwells with a bias and a curved axis of 3 mg/g²; the last ones for checking."""
    rng = np.random.default_rng(seed)
    angles = np.arange(0, 360, 18.0)
    psi = np.radians(12.0 - angles)
    readings = 1000 * np.stack([1.002 * np.cos(psi), np.sin(psi + 0.003)], axis=1) + [8.0, -5.0]
    readings[:, 0] += 3.0 * np.cos(psi) ** 2
    readings += 0.1 * rng.standard_normal(readings.shape)
    dwells = [
        Dwell(k, np.array([20.0 * k]), readings[k : k + 1], angle_deg=float(a))
        for k, a in enumerate(angles)
    ]
    dwells[20 - checks :] = [replace(dwell, use="check") for dwell in dwells[20 - checks :]]
    return Session(
        tuple(dwells), accel_unit="mg", fixture_sigma_deg=0.003, reading_u_mg=0.1, sensor="generic"
    )


def one_pose(n: int = 2000) -> Session:
    """One pose whose zero follows the temperature by 0.5 mg/°C."""
    rng = np.random.default_rng(1)
    time = np.arange(n) * 0.1
    warm = 25 + 10 * np.sin(time / time[-1] * 6 * np.pi)
    accel = np.column_stack([0.5 * warm, 3 + 0 * warm, 1000 + 0.3 * warm]) + rng.normal(0, 0.5, (n, 3))
    return Session(
        (Dwell(0, time, accel, temperature_c=warm),), accel_unit="mg", plane=None, sensor="generic"
    )


def limited(session: Session, ticks: float):
    """Trace under a limit of so many looks at the clock."""
    with within(Budget(ticks, clock=Ticks())):
        return trace(session)


@dataclass(frozen=True)
class Watched:
    """A whole trace, how often it looked at the clock, and the stages that it told."""

    result: TraceResult
    looks: int
    told: list[str]


def watched(session: Session) -> Watched:
    """Trace under a limit that is not reached."""
    clock, told = Ticks(), []
    with within(Budget(NEVER, clock=clock, tell=told.append)):
        result = trace(session)
    return Watched(result, clock.count, told)


@pytest.fixture(scope="module")
def whole() -> Watched:
    return watched(turn())


def test_without_a_limit_nothing_is_stopped_and_a_limit_that_is_not_reached_changes_nothing(whole) -> None:
    free = trace(turn())
    assert free.stopped is None
    assert free.as_dict()["stopped"] is None
    assert {step.effect for step in free.steps} == {"bias", "quadratic"}
    assert whole.result.as_dict() == free.as_dict()


def test_wherever_it_ends_what_was_not_validated_is_not_called_found(whole) -> None:
    outcomes = set()
    reached = whole.result
    for ticks in np.unique(np.geomspace(1, whole.looks - 2, 9).round()):
        result = limited(turn(), ticks)
        assert result.stopped is not None
        assert result.stopped.left_out
        outcomes.add(result.stopped.checked)
        if result.stopped.checked:
            assert [f.effect for f in result.found] == [f.effect for f in reached.found]
            assert result.adequate == reached.adequate
            assert result.after == reached.after
        else:
            assert result.found == ()
            assert result.unnamed is None
            assert not result.adequate
            assert {step.effect for step in result.steps} <= set(result.reasons)
            assert set(result.reasons.values()) <= {UNCHECKED}
        assert np.isfinite(result.after.residual_rms)
        json.dumps(result.as_dict(), allow_nan=False)
    assert outcomes == {True, False}  # ends before validation and after it were both tried


def test_at_once_over_it_still_gives_a_model_and_says_what_was_left_out() -> None:
    told: list[str] = []
    with within(Budget(clock=Ticks(), tell=told.append)):
        result = trace(turn(), time_limit=0.5)
    assert told[0] == "noise of the readings"  # a limit of its own tells the same listeners
    assert result.steps
    assert result.after.residual_rms < 0.5 * result.before.residual_rms
    assert result.after.heldout_rms is None
    assert "no data were held out" in words.gains(result)
    said = words.headline(result)
    assert said.startswith("The time limit of 0.5 s ended the trace")
    assert "nothing is called found" in said
    assert "the error on held-out dwells" in said
    assert result.as_dict()["stopped"]["sentence"] == said


def test_check_dwells_need_no_folds_and_keep_their_error() -> None:
    result = limited(turn(checks=4), 0.5)
    assert result.stopped is not None
    assert result.found == ()
    assert result.heldout_design == "4 check dwells"
    assert result.after.heldout_rms is not None


def test_one_pose_keeps_what_the_blocks_of_time_have_proved() -> None:
    free = watched(one_pose())
    assert [finding.effect for finding in free.result.found] == ["bias_temperature"]
    early = limited(one_pose(), 0.5)
    assert early.found == ()
    assert early.stopped is not None
    assert "further effects" in early.stopped.left_out
    late = limited(one_pose(), free.looks - 2)
    assert [finding.effect for finding in late.found] == ["bias_temperature"]
    assert late.stopped is not None


def test_a_stage_that_runs_out_of_time_leaves_no_half_of_itself() -> None:
    done = []

    def work() -> str:
        for part in range(10):
            check()
            done.append(part)
        return "whole"

    with within(Budget(5, clock=Ticks())) as budget:
        assert attempt("the stage", work, "substitute") == "substitute"
        assert spent()
        assert attempt("the next", lambda: "whole", "none") == "none"
    assert 0 < len(done) < 10
    assert budget.left_out == ["the stage", "the next"]
    assert attempt("without a budget", work, "substitute") == "whole"
    assert current().left_out == []


def test_stages_are_told_in_order(whole) -> None:
    told = whole.told
    assert told[:2] == ["noise of the readings", "the search for effects"]
    folds = told.index("the error on held-out dwells, effects chosen again")
    assert folds < told.index("what to measure next")
    assert told[-1] == "the samples inside the dwells"


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
def test_a_limit_that_is_not_positive_is_refused(seconds: float) -> None:
    with pytest.raises(UsageError, match="give a positive number of seconds"):
        trace(turn(), time_limit=seconds)


def test_the_command_says_it_in_text_and_json(tmp_path, capsys) -> None:
    head = (
        "# sensor: generic\n# fixture_sigma_deg: 0.003\n# accel_unit: mg\ntime_s,position,angle_deg,ax,ay"
    )
    rows = [head]
    rng = np.random.default_rng(1)
    for k, dwell in enumerate(turn().dwells):
        for i in range(4):
            x, y = dwell.accel[0] + rng.normal(0, 0.2, 2)
            rows.append(f"{20 * k + i},{k},{dwell.angle_deg},{x:.4f},{y:.4f}")
    path = tmp_path / "turn.csv"
    path.write_text("\n".join(rows) + "\n")
    assert main(["trace", str(path), "--time-limit", "1e-9"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "The time limit of 1e-09 s ended the trace" in said
    assert main(["trace", str(path), "--time-limit", "1e-9", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["stopped"]["limit_s"] == 1e-9
    assert document["found"] == []
