"""State of a session: its ledger, the noise, the position of the sensor, and the fit so far."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.events import NoiseMeasured, Problem, Running, Vector, Watching, WatchState, Withdrawn
from adis_gonio.bench.guards import Judge, Turning
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.archive import Archive
from adis_gonio.record.blocks import Block, block_series, join
from adis_gonio.record.plans import Plan, Position, PriorKnowledge
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.stillness import (
    SETTLINGS_PER_WINDOW,
    StillnessLimits,
    StillnessWatch,
    limits_from_noise,
)


class Ledger:
    """Dwells done and decisions made in a session; begins with the state in the archive.

    A place is the index of a position in the plan.

    Parameters
    ----------
    archive : Archive
        File of the session.
    now : callable
        Returns the time in s on the sensor's clock, for records.

    Attributes
    ----------
    plan : Plan
        Plan of the session with its extensions.
    recorded_s : float or None
        Length of a free turn in s; None for dwells, which have the length of the settings.
    done : dict
        Number of the attempt that is used as the dwell, by place.
    skipped : set of int
        Skipped places.
    last_place : int or None
        Place of the newest dwell; None without a dwell.
    taken : int
        Number of dwells recorded since this program opened the session.
    """

    def __init__(self, archive: Archive, now: Callable[[], float]) -> None:
        self.archive = archive
        self.header = archive.header
        self.plan = archive.plan()
        self.recorded_s: float | None = None
        self.done = {attempt.place: attempt.number for attempt in archive.dwells()}
        self.skipped = archive.skipped()
        self.last_place = self._newest()
        self.taken = 0
        self._scanning: dict[str, Any] = archive.last("scanning") or {}
        self._now = now

    def note(self, kind: str, value: Any) -> None:
        """Write a record of this kind to the archive, unless its value is None."""
        if value is not None:
            self.archive.add_record(kind, value, self._now())

    def problem(self, problem: Problem) -> Problem:
        """Write a problem to the archive, before it is shown, and return it."""
        self.note("problem", problem.as_dict())
        return problem

    def scanning(self, now: dict[str, Any]) -> None:
        """Write the method by which scans are read to the archive if it has changed.

        `now` has this method as texts `how` and `caveat`.
        """
        if now != self._scanning:
            self._scanning = now
            self.note("scanning", now)

    @property
    def open_places(self) -> list[int]:
        """Indices of the positions in the plan that are neither done nor skipped, in order."""
        return [k for k in range(len(self.plan)) if k not in self.done and k not in self.skipped]

    @property
    def next_place(self) -> int | None:
        """Index of the next position that is neither done nor skipped; None if there is none."""
        return next(iter(self.open_places), None)

    def skip(self, place: int) -> None:
        """Mark the position at index `place` of the plan as skipped."""
        self.note("skipped", place)
        self.skipped.add(place)

    def use_attempt(self, place: int, number: int) -> None:
        """Use the attempt `number` as the dwell of the position at index `place`."""
        self.done[place] = number
        self.taken += 1
        self.skipped.discard(place)
        self.last_place = place

    def withdraw(self, place: int) -> Withdrawn:
        """Remove the dwell of a place from the session; it stays in the archive, marked as withdrawn."""
        self.note("withdrawn", self.done.pop(place))
        self.last_place = self._newest()
        return Withdrawn(place, self.plan.positions[place])

    def extend(self, plan: Plan) -> None:
        """Replace the plan by a changed one, such as a longer one, also in the archive."""
        self.note("plan", plan.as_dict())
        self.plan = plan

    def _newest(self) -> int | None:
        return max(self.done, key=self.done.__getitem__, default=None)


def vector(values: Any) -> Vector:
    """Convert three numbers to a tuple of floats."""
    x, y, z = (float(value) for value in np.asarray(values))
    return x, y, z


class Knowledge:
    """The present knowledge of a session from its scans and dwells, including archived dwells.

    Parameters
    ----------
    bench : SessionBench
        Sensor and stage of the session.
    ledger : Ledger
        Dwells done and decisions made in the session.
    judging : bool
        False if positions are not judged, as in a free turn.

    Attributes
    ----------
    target : Position or None
        Requested position; None if there is none.
    temperature_c : float or None
        Temperature in the newest scan; None if scans have no temperature.
    lost : int
        Number of scans lost since the session was opened.
    judge : Judge or None
        Judge of the positions; None before the noise is known, and if positions are not judged.
    limits : StillnessLimits or None
        Limits of stillness; None if the noise is not known, or has to be measured again.
    reversed : bool
        True if the stage counts angles the other way than the plan.
    fits_dwells : bool
        False if the dwells so far are not to be fitted, because the result is not shown.
    """

    def __init__(self, bench: SessionBench, ledger: Ledger, *, judging: bool) -> None:
        self._bench = bench
        self._ledger = ledger
        self._judging = judging
        self._noise_mg: Floats = np.zeros(3)
        self._fitted = 0  # number of dwells in the last fit
        self.target: Position | None = None
        self.temperature_c: float | None = None
        self.lost = 0
        self.judge: Judge | None = None
        self.limits: StillnessLimits | None = None
        self.reversed = bool(ledger.archive.last("reversed"))
        self.fits_dwells = True

    def take_noise(self, noise: list[float]) -> NoiseMeasured:
        """Set the limits of stillness by the noise at rest (mg), and prepare the check of positions.

        Returns the event that reports the noise.
        """
        bench = self._bench
        quantum = bench.source.part.step_mg
        self.limits = limits_from_noise(np.array(noise), bench.window, quantum)
        self._noise_mg = np.maximum(noise, quantum / math.sqrt(12))
        self.judge = self._new_judge(float(self._noise_mg.max()))
        return NoiseMeasured(vector(noise))

    def _new_judge(self, noise_mg: float) -> Judge | None:
        """Return a judge of positions that knows the dwells so far; None if positions are not judged.

        `noise_mg` is the largest noise of an axis.
        """
        bench, ledger = self._bench, self._ledger
        planar = ledger.plan.plane != "none"
        fixture = ledger.header.fixture_sigma_deg
        if not self._judging or (planar and fixture is not None and math.isinf(fixture)):
            return None
        spread = PriorKnowledge(
            max(bench.source.part.initial_bias_mg, 10.0),  # 10 mg: the estimate for the ADIS16354 (D)
            noise_mg / math.sqrt(SETTLINGS_PER_WINDOW),
            fixture,
            1000.0 * ledger.header.gravity_mps2 / STANDARD_GRAVITY_MPS2,
        )
        gap_s = bench.window * bench.period_s
        judge = Judge(spread, planar=planar, sense=-1 if self.reversed else 1, longest_gap_s=gap_s)
        archive = ledger.archive
        doubted = {doubt["attempt"] for doubt in archive.doubts()}
        for attempt in archive.dwells():
            scans = join(archive.blocks(attempt, "dwell"))
            judge.done(attempt.place, attempt.position, scans, doubted=attempt.number in doubted)
        judge.turning = Turning(gap_s)  # the turn since the last dwell was not followed
        return judge

    def watch(self) -> StillnessWatch:
        """Return a new detector of stillness; the noise must be known."""
        assert self.limits is not None
        return StillnessWatch(self.limits, self._noise_mg)

    def see(self, block: Block) -> None:
        """Take a block of scans into account: temperature, lost scans and turn by the gyros."""
        self.lost += block.lost
        series = block_series(block)
        if "temperature_c" in series and len(block):
            self.temperature_c = float(series["temperature_c"][-1])
        if self.judge is not None:
            self.judge.turning.see(block)

    def angle_deg(self, accel_mg: Floats, target_deg: float | None) -> tuple[float | None, float | None]:
        """Return the present angle in the stage's sense and its tolerance, both in degrees.

        `accel_mg` (3,) is the present reading, `target_deg` the requested stage angle, None without one.
        It is within ±180° of the target; None if attitudes are free. The tolerance is the largest deviation
        from the target that no guard doubts; None without a target or before the first dwell.
        """
        if self.judge is None:
            return None, None
        angle = self.judge.angle_deg(accel_mg)
        if angle is None or target_deg is None:
            return angle, None
        tolerance = self.judge.tolerance_deg(accel_mg, target_deg)
        return target_deg + wrap_degrees(angle - target_deg), tolerance

    def watching(
        self,
        state: WatchState,
        accel_mg: Floats,
        spread_mg: Floats,
        target_deg: float | None,
        waits_for: str,
    ) -> Watching:
        """Return the event that shows the newest readings.

        `accel_mg` and `spread_mg` are the mean and the standard deviation of the newest window,
        `target_deg` is the requested angle (None if there is none), and `waits_for` names what the session
        waits for.
        """
        angle_deg, tolerance_deg = self.angle_deg(accel_mg, target_deg)
        return Watching(
            state,
            vector(accel_mg),
            vector(spread_mg),
            angle_deg,
            target_deg,
            None if self.limits is None else vector(self.limits.upper),
            waits_for,
            self.temperature_c,
            self.lost,
            tolerance_deg,
        )

    def withdraw(self, place: int) -> Withdrawn:
        """Withdraw the dwell of a place (index in the plan) from the session and the check of positions."""
        withdrawn = self._ledger.withdraw(place)
        self._fitted = 0
        if self.judge is not None:
            self.judge.withdraw(place)
        return withdrawn

    def reverse(self) -> None:
        """Change the sign of all angles of the session."""
        self.reversed = not self.reversed
        self._ledger.note("reversed", self.reversed)
        if self.judge is not None:
            self.judge.reverse()

    def running(self) -> Running | None:
        """Fit the dwells so far, as in the archive, and return the event that shows the fit.

        Returns None if the dwells do not allow a fit, or if the session has no positions. With more than 36
        dwells, it also returns None until their number is 10 % larger than at the last fit.
        """
        from adis_gonio.fitting.methods import fit

        count = len(self._ledger.done)
        if 36 < count < 1.1 * self._fitted or not (self.fits_dwells and self._judging):
            return None
        try:
            result = fit(read_session(self._ledger.archive.path))
        except (AdisGonioError, np.linalg.LinAlgError):
            # Too few dwells or positions; the next dwell may change that.
            return None
        self._fitted = count
        # The whole document would compare the methods, with one fit for each of them.
        parameters = {name: value.as_dict() for name, value in result.parameters.items()}
        return Running(parameters, result.method, count)
