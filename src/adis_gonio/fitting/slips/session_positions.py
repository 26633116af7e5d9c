"""Input of the diagnosis of positions: a session's declared angles, its readings, and its gyro turns."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.gyros.turn_integration import (
    LONGEST_GAP_S,
    Path,
    Sampling,
    dps_per_unit,
    integrate,
    path_between,
    period_of,
)
from adis_gonio.fitting.slips.position_diagnosis import LARGEST, Diagnosis, diagnose
from adis_gonio.fitting.slips.position_model import Angles, Halts, Increments, halts_of
from adis_gonio.model.records import Dwell, Session

BIAS_MG = 60.0
"""Standard deviation of a bias before a measurement: one real ADIS16350 had +57, −21 and +46 mg (CHIP)."""
INSTABILITY_DPS = 0.015
"""Drift of a gyro's zero between dwells if no figure is known (the simulator's default, D)."""
BLOCK_S = 0.25
"""Length of blocks in s: their means are independent with every filter setting."""
UNKNOWN_MG = 1.0
"""Standard uncertainty assumed for a reading without one."""


def positions_of(session: Session) -> Diagnosis:
    """Diagnose a session's positions from declared angles, gravity and gyro; the result is kept for reuse.

    There are no findings for sessions in space, without declared angles, or with more than `LARGEST`
    dwells.

    Raises
    ------
    DataError
        As `adis_gonio.fitting.estimation.readings_of`.
    """
    return session.once(_diagnosed)


def _diagnosed(session: Session) -> Diagnosis:
    angles = angles_of(session)
    return Diagnosis() if angles is None else diagnose(angles)


def failure_message(session: Session, error: Exception) -> str:
    """Message for a failed fit, with the file's name and suspected positions as a possible cause."""
    text = "; ".join((str(error), *positions_of(session).sentences))
    return f"{session.source}: {text}" if session.source else text


def angles_of(session: Session) -> Angles | None:
    """Input of the diagnosis: declared angles, readings and turns; None if no angle can be wrong."""
    if session.plane != "xy" or session.free_attitudes or not 2 <= len(session.dwells) <= LARGEST:
        return None
    readings = readings_of(session)
    if not readings.planar or not np.isfinite(readings.angle_rad).any():
        return None
    known = readings.known[:, None, None]
    return Angles(
        tuple(readings.position.tolist()),
        readings.angle_rad,
        readings.mean,
        np.where(known, readings.covariance, UNKNOWN_MG**2 * np.eye(2)),
        readings.conditions,
        readings.gravity_mg,
        readings.fixture_rad if readings.fixture_stated else None,
        BIAS_MG,
        _increments(session, readings),
    )


def _increments(session: Session, readings: Readings) -> Increments | None:
    if session.gyro_unit == "counts" or session.accel_unit == "counts":
        return None
    by_position = {dwell.position: dwell for dwell in session.dwells if dwell.gyro is not None}
    dwells = [by_position[p] for p in readings.position.tolist() if p in by_position]
    turns = {(turn.before, turn.position): turn for turn in session.turns if turn.gyro is not None}
    noted = _noted(session)
    if not dwells or not (turns or noted):
        return None
    sampling, zero_dps2 = _sampling(session, dwells)
    pairs = list(zip(readings.position[:-1].tolist(), readings.position[1:].tolist(), strict=True))
    # Angle, u and both forces of each turn; NaN without a record.
    rows = np.full((len(pairs), 4), np.nan)
    halts: list[Halts | None] = [None] * len(pairs)
    for k, pair in enumerate(pairs):
        if pair in turns and pair[0] in by_position and pair[1] in by_position:
            ends = by_position[pair[0]], by_position[pair[1]]
            path = path_between(session, turns[pair], *ends)
            found = None if path is None else _turned(path, sampling, zero_dps2)
            rows[k] = np.nan if found is None else found
            halts[k] = None if path is None or found is None else halts_of(path, sampling)
        if not np.isfinite(rows[k, 0]) and pair in noted:
            rows[k] = (*noted[pair], 0.0, 0.0)
    return Increments(np.radians(rows[:, 0]), np.radians(rows[:, 1]), rows[:, 2:], tuple(halts))


def _noted(session: Session) -> dict[tuple[int, int], tuple[float, float]]:
    """Turns about z that were noted while the session ran, with u, in degrees, by the two dwells.

    The u includes the g-sensitivity.
    """
    dwells = session.facts.get("dwells") or []
    number = {entry["attempt"]: k for k, entry in enumerate(dwells)}
    return {
        (number[entry["since"]], number[entry["attempt"]]): (entry["angle_deg"][2], entry["u_deg"])
        for entry in session.facts.get("turned") or []
        if entry["since"] in number and entry["attempt"] in number
    }


def _sampling(session: Session, dwells: Sequence[Dwell]) -> tuple[Sampling, float]:
    """Describe the sampling of the gyros, and compute the variance of the mean rate about z in a dwell."""
    configuration = session.facts.get("configuration") or {}
    variant = VARIANTS.get(session.sensor)
    range_dps = configuration.get("gyro_range_dps") or (math.inf if variant is None else 300.0)
    drift = INSTABILITY_DPS if variant is None else variant.performance.gyro_instability_dps
    period = period_of([dwell.time_s for dwell in dwells])
    density = _density(session, dwells, period)
    samples = float(np.mean([len(dwell) for dwell in dwells]))
    sampling = Sampling(
        period, int(configuration.get("filter_m", 0)), float(range_dps), density, np.full(3, drift)
    )
    return sampling, float(density[2, 2]) / samples


def _density(session: Session, dwells: Sequence[Dwell], period_s: float) -> Floats:
    """Spectral density (3, 3) of the gyro noise at frequency zero, per sample, in (°/s)².

    It is estimated from the scatter of block means within dwells.
    """
    block = max(1, round(BLOCK_S / period_s)) if period_s > 0 else 1
    squares, count = np.zeros((3, 3)), 0
    for dwell in dwells:
        whole = len(dwell) // block
        if whole < 2 or dwell.gyro is None:
            continue
        # Means of whole blocks; their scatter gives the density at low frequencies.
        means = dwell.gyro[: whole * block].reshape(whole, block, 3).mean(axis=1)
        left = means - means.mean(axis=0)
        squares += left.T @ left
        count += whole - 1
    return np.asarray(dps_per_unit(session) ** 2 * block * squares / max(count, 1))


def _turned(path: Path, sampling: Sampling, zero_dps2: float) -> tuple[float, float, float, float] | None:
    """Turn about z and its u in degrees, and the integral of the force minus the force at rest, in g·s.

    None if the record of the turn has a gap.
    """
    found = integrate(path, sampling)
    if not isinstance(found, str):
        angle, variance = float(found.turned_deg[2]), float(found.covariance_deg2[2, 2])
        length, mean = found.length_s, found.force_g
    elif _stayed(path, sampling):
        length = float(path.time_s[-1] - path.time_s[0])
        rate = path.rate_dps[:, 2] - path.zero_dps[:, 2].mean()
        angle = float(np.trapezoid(rate, path.time_s))
        variance = float(sampling.density_dps2[2, 2]) * length * sampling.period_s
        mean = path.force_g.mean(axis=0)
    else:
        return None
    rest = path.rest_g.mean(axis=0)
    # Error of the zero rate: noise of both dwells, and drift.
    zero = length**2 * (zero_dps2 / 2 + float(sampling.drift_dps[2]) ** 2)
    beyond = np.nan_to_num(length * (mean - rest))  # NaN for counts of unknown size in g
    return angle, math.sqrt(variance + zero), float(beyond[0]), float(beyond[1])


def _stayed(path: Path, sampling: Sampling) -> bool:
    """True if the gyro record between two dwells has no gap and shows no turn."""
    if float(np.diff(path.time_s).max()) > LONGEST_GAP_S:
        return False
    window = min(sampling.window, len(path.time_s))
    whole = len(path.time_s) // window
    rate = path.rate_dps[: whole * window] - path.zero_dps.mean(axis=0)
    # Means of windows must all stay within the noise of a part at rest.
    means = rate.reshape(whole, window, 3).mean(axis=1)
    allowed = sampling.moving_dps + np.abs(path.zero_dps[1] - path.zero_dps[0])
    return bool((np.abs(means) <= allowed).all())
