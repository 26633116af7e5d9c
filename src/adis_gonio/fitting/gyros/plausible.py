"""What no gyro at rest reads: such zero rates, or the same number throughout."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Session

LARGEST_DPS = 10.0
"""Zero rate beyond which something else is likelier: ten times that of parts of this class (D)."""


def implausible(session: Session, zero_dps: Sequence[float]) -> tuple[str, ...]:
    """Why the gyros of a session are to be doubted, a line each; empty where they are not.

    Parameters
    ----------
    zero_dps : (3,) float
        Zero rates that were found, in °/s.
    """
    said = []
    for axis, zero in zip(AXES, zero_dps, strict=True):
        if abs(zero) > LARGEST_DPS:
            said.append(
                f"gyro_bias_{axis} is {zero:.4g} °/s, and gyros of this class have about 1 °/s: did the"
                f" part turn, is the gyro broken, or the unit another (here {session.gyro_unit})?"
            )
    samples = [dwell.gyro for dwell in session.dwells if dwell.gyro is not None and len(dwell) > 1]
    for k, axis in enumerate(AXES):
        if samples and np.ptp(np.concatenate([rows[:, k] for rows in samples])) == 0:
            said.append(
                f"gyro {axis} reads {samples[0][0, k]:g} in every sample, without any noise: is it"
                " connected, and the column that of a gyro?"
            )
    return tuple(said)
