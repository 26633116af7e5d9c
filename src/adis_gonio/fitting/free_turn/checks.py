"""What a free turn must be for its estimate to hold, and what is said where it is not."""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.base.numbers import counted
from adis_gonio.fitting.free_turn.windows import TurnRecording, Windows
from adis_gonio.model.records import Sweeps

LEAST_S = 10.0
"""A recording shorter than this holds no slow turn."""
FASTEST_DPS = 90.0
"""Beyond it a window holds more than an eighth of a turn, and a lever arm of 0.1 m brings 25 mg."""
LEAST_TURN_DEG = 180.0
"""Of less than half a turn a bias and a gain are nearly the same."""
WOBBLE_DEG = 0.5
"""Tilt (rms) out of the plane that shortens gravity's part in it by 0.04 mg, what a session can tell."""
LEANING_DEG = 10.0
MOST_LOST = 0.2
"""Part of the time without samples."""
REST_DPS = 0.5
"""Mean rate in a window below which the part is taken as at rest."""

_AGAIN = "turn once more"


def require_recording(series: TurnRecording) -> None:
    """Raise `FitError` where a recording is too short, broken, too fast or not about Z."""
    if series.length_s < LEAST_S:
        raise FitError(
            f"the recording has {series.length_s:.1f} s: a free turn takes {LEAST_S:.0f} s or more,"
            " 60 s is good"
        )
    steps = np.diff(series.time_s)
    lost_s = float(steps[steps > 5 * series.period_s].sum())
    if lost_s > MOST_LOST * series.length_s:
        raise FitError(
            f"the recording was interrupted: {lost_s:.1f} of {series.length_s:.1f} s have no samples;"
            f" mend the link and {_AGAIN}"
        )


def require_slow(series: TurnRecording, windows: Windows, range_dps: float | None) -> None:
    """Raise `FitError` where the turn was faster than the model reaches, or than the gyro."""
    rate = np.degrees(np.abs(windows.mean(series.rate[:, 2])))
    fastest = float(rate.max())
    limit = FASTEST_DPS if range_dps is None else min(FASTEST_DPS, 0.9 * range_dps)
    if fastest > limit:
        raise FitError(
            f"the turn was too fast: {fastest:.0f} °/s at {windows.centre_s[rate.argmax()]:.1f} s, at most"
            f" {limit:.0f} °/s can be modelled; {_AGAIN}, a turn in about a minute (6 °/s)"
        )


def require_axis(series: TurnRecording, windows: Windows) -> None:
    """Raise `FitError` where the gyros saw a turn about another axis than Z."""
    rates = windows.mean(series.rate)
    rates = rates - np.median(rates, axis=0)
    size = np.sqrt((rates**2).mean(axis=0))
    other = int(np.argmax(size[:2]))
    if size[other] > 0.5 * size[2]:
        raise FitError(
            f"the part turned about its {'XY'[other]} axis too ({math.degrees(size[other]):.1f} °/s rms,"
            f" about Z {math.degrees(size[2]):.1f}): lay Z level along the axis of the turn and {_AGAIN}"
        )


def sweeps_of(psi_rad: Floats) -> Sweeps:
    """How far the part was turned, there and back."""
    found = Sweeps()
    for angle_deg in np.degrees(psi_rad - psi_rad[0]).tolist():
        found.see(angle_deg)
    return found


def require_turn(psi_rad: Floats) -> None:
    """Raise `FitError` where too little of a turn was made to tell anything."""
    turned = sweeps_of(psi_rad).span_deg
    if turned < LEAST_TURN_DEG:
        raise FitError(
            f"the turn is too short: it went {turned:.0f}°, at least {LEAST_TURN_DEG:.0f}° tell biases from"
            f" gains and 360° are wanted; {_AGAIN}, all around"
        )


def require_plane(series: TurnRecording, windows: Windows, psi_rad: Floats, gravity_mg: float) -> list[str]:
    """Warnings of how flat the turn was; without Z nobody can tell.

    Raises
    ------
    FitError
        It left its plane by more than the model bears.
    """
    if series.accel_mg.shape[1] < 3:
        return ["no Z accelerometer: whether the turn stayed in one plane is not known"]
    z = windows.mean(series.accel_mg[:, 2])
    # A skew of Z, and a tilt that turns with the part, read as one cycle; a bias as a constant.
    design = np.column_stack([np.ones(len(z)), np.cos(psi_rad), np.sin(psi_rad)])
    found = np.linalg.lstsq(design, z, rcond=None)[0]
    noise = float(np.median(np.abs(np.diff(z, n=2)))) / 0.6745 / math.sqrt(6)
    left = math.sqrt(max(float(((z - design @ found) ** 2).mean()) - noise**2, 0.0))
    wobble = math.degrees(left / gravity_mg)
    leaning = math.degrees(math.asin(min(abs(float(found[0])) / gravity_mg, 1.0)))
    swing = math.degrees(math.hypot(found[1], found[2]) / gravity_mg)
    if wobble > WOBBLE_DEG or swing > LEANING_DEG or leaning > LEANING_DEG:
        _, worst = max(
            (wobble / WOBBLE_DEG, f"swayed by {wobble:.1f}° rms"),
            (swing / LEANING_DEG, f"tilted by {swing:.1f}° with the turn"),
            (leaning / LEANING_DEG, f"leaned by {leaning:.1f}°"),
        )
        raise FitError(
            f"the turn was not in one vertical plane: the part {worst}; hold it in a bearing or on a stage"
            f" whose axis lies level and {_AGAIN}"
        )
    return []


def remarks(
    series: TurnRecording, windows: Windows, psi_rad: Floats, u_phi_deg: float, wanted: int = 0
) -> list[str]:
    """What has to be said of a turn that holds; `wanted` is how many full turns the plan asked for."""
    said = []
    sweeps = sweeps_of(psi_rad)
    if not sweeps.full:
        said.append(
            f"the turn went {sweeps.span_deg:.0f}°, no full turn: u(Δφ) is {u_phi_deg:.2g}°;"
            " all around would determine it better"
        )
    elif sweeps.full < wanted:
        said.append(
            f"{sweeps.full} of {counted(wanted, 'turn')} seen: u(Δφ) is {u_phi_deg:.2g}°; each angle seen"
            " again, on or back, would make it smaller"
        )
    rate = np.degrees(np.abs(np.diff(psi_rad) / np.diff(windows.centre_s)))
    for where, part in (("start", rate[:4]), ("end", rate[-4:])):
        if len(part) and float(np.median(part)) > REST_DPS:
            said.append(f"no rest at the {where}: a lever arm is told from a bias less well")
    gaps = int((windows.gap_s > 0).sum())
    if gaps:
        lost = float(windows.gap_s.sum())
        said.append(f"{lost:.2g} s of samples are missing: across them the gyro is not used")
    return said
