"""Readings of several sessions as one set of readings, for a joint trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import JointMeasurement, SessionOrigin


def stack(each: Sequence[Readings], origins: Sequence[SessionOrigin]) -> Readings:
    """Join the readings `each` of several sessions; the sessions of one part share base parameters.

    `origins` has part, stage and label of each session. The rows keep the number of their session
    (`Conditions.session`). Noise that dwells share is independent between sessions. A covariate that a
    session did not record is dropped.

    Raises
    ------
    UsageError
        Sessions of different kinds, in counts, with different uncertainties of the declared angles, or only
        some with a known noise.
    """
    first = each[0]
    for one, origin in zip(each, origins, strict=True):
        for same, what in (
            (one.axes == first.axes, "one plane and attitudes in space"),
            (one.fixture_rad == first.fixture_rad, "different uncertainties of the declared angles"),
            (one.unit.known, "readings in counts"),
            (one.noise_known == first.noise_known, "readings with and without a known noise"),
        ):
            if not same:
                raise UsageError(
                    f"{origin.label}: a joint trace cannot join {what}; trace this session alone, or state"
                    " one --fixture, --unit or reading_u_mg for all"
                )
    if len(each) == 1:
        return first
    session = np.repeat(np.arange(len(each)), [len(one) for one in each])
    by_row = ["mean", "own_covariance", "dof", "angle_rad", "check", "position", "samples"]
    parts = [
        name for name in ("quantization", "flicker") if all(getattr(r, name) is not None for r in each)
    ]
    joined: dict[str, Any] = {n: np.concatenate([getattr(r, n) for r in each]) for n in (*by_row, *parts)}
    return replace(
        first,
        **joined,
        conditions=_conditions([one.conditions for one in each], session),
        slow=_modes(each, origins),
        flicker_shown=any(one.flicker_shown for one in each),
        pooled=all(one.pooled for one in each),
        notes=tuple(dict.fromkeys(note for one in each for note in one.notes)),
        measurement=JointMeasurement([one.model for one in each], origins, session),
        converter=None,
        links=None,
        fitted=None,
    )


def _conditions(each: Sequence[Conditions], session: NDArray[np.intp]) -> Conditions:
    """Join the conditions of several sessions; `session` (n,) is the number of the session of each dwell.

    The order of the dwells is counted through all sessions, and histories (such as temperatures over time)
    are put on one common clock. A condition that a session did not record is dropped.
    """
    made: dict[str, Any] = {}
    for name in (field.name for field in fields(Conditions)):
        values = [getattr(one, name) for one in each]
        if any(value is None for value in values):
            continue
        if name.endswith("_history"):
            clocks = [replace(one, session=np.full(len(one), float(k))) for k, one in enumerate(each)]
            shifts = [one.clock_s[0] - one.time_s[0] for one in clocks]
            times = np.concatenate([time + shift for (time, _), shift in zip(values, shifts, strict=True)])
            made[name] = times, np.concatenate([value for _, value in values])
        else:
            made[name] = np.concatenate(values)
    made["session"] = session.astype(float)
    if "order" in made:
        made["order"] = np.arange(float(len(session)))
    return Conditions(**made)


def _modes(each: Sequence[Readings], origins: Sequence[SessionOrigin]) -> Floats | None:
    """Join the modes (n, axes, k) of the noise that the dwells of each session share; None without modes.

    A mode is an independent error that acts on several readings. The modes of the sessions come first, then
    the modes of the certificates of their stages. Sessions on one stage (see `origins`) share the modes of
    its certificate if they have equally many.
    """
    n, axes = sum(len(one) for one in each), each[0].axes
    blocks: dict[tuple[str, int | str, int], Floats] = {}
    start = 0
    for k, (one, origin) in enumerate(zip(each, origins, strict=True)):
        end = start + len(one)
        if one.slow is not None:
            own = one.slow.shape[2] - one.stage_modes
            for key, modes in (
                (("own", k, own), one.slow[:, :, :own]),
                (("stage", origin.stage or k, one.stage_modes), one.slow[:, :, own:]),
            ):
                block = blocks.setdefault(key, np.zeros((n, axes, key[2])))
                block[start:end] = modes
        start = end
    ordered = [blocks[key] for key in sorted(blocks, key=lambda key: key[0])]
    joined = np.concatenate(ordered, axis=2) if ordered else np.zeros((n, axes, 0))
    return joined if joined.shape[2] else None
