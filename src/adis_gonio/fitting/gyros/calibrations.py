"""From a fit of the gyros to a `GyroCalibration`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError
from adis_gonio.calibrate.coefficients import NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.record.provenance import Provenance
from adis_gonio.record.write_journal import INTERRUPTED

if TYPE_CHECKING:
    from adis_gonio.fitting.gyros.fit import GyroFit


@dataclass(frozen=True)
class GyroEstimates:
    """What a fit or a trace of the gyros found.

    Attributes
    ----------
    method : str
    estimates : mapping of str to objects with `value`, `u`, `unit`
    covariance : (names, (p, p) float) or None
    not_corrected : tuple of NotCorrected
    doubts : tuple of str
        Why it is no sound base for the chip, one line each; empty where it is.
    remarks : tuple of str
        What is to be said of it.
    """

    method: str
    estimates: Mapping[str, Any]
    covariance: tuple[Sequence[str], Floats] | None = None
    not_corrected: tuple[NotCorrected, ...] = ()
    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def estimates_of_gyro_fit(result: GyroFit) -> GyroEstimates:
    """Of `fit --sensor-part gyro`; a residual beyond the noise is a doubt."""
    large = [f"{axis} {math.sqrt(own):.2g}" for axis, own in result.inflation.items() if own > 1]
    doubts = [f"the gyros' residual is larger than their noise ({', '.join(large)} times)"] if large else []
    doubts += result.doubts
    names = list(result.parameters)
    return GyroEstimates(
        result.method,
        dict(result.parameters),
        (names, result.covariance),
        doubts=tuple(doubts),
        remarks=tuple(result.warnings),
    )


def gyro_calibration_as_it_is(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    """Return the calibration for the offsets that the sensor holds now; see `gyro_as_written`."""
    made = make_gyro_calibration(found, where)
    return made if where is None else gyro_as_written(made, where)


def make_gyro_calibration(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    """Return the calibration for the offsets in force while its session was recorded."""
    about: dict[str, Any] = {}
    if where is not None:
        about = {
            "temperature_c": where.temperature_c,
            "supply_v": where.supply_v,
            "offsets_lsb": where.gyro_offsets_lsb,
            "source": where.source,
        }
    return GyroCalibration.of(
        found.estimates,
        found.covariance,
        method=found.method,
        not_corrected=found.not_corrected,
        **about,
    )


def gyro_as_written(gyro: GyroCalibration, where: Provenance) -> GyroCalibration:
    """For the part as it is: what was written since is corrected by the chip, and moves the force."""
    if where.gyro_write_open:
        raise SessionError(f"{where.source}: {INTERRUPTED}")
    if where.gyro_written_lsb is not None:
        gyro = gyro.with_offsets(where.gyro_written_lsb)
    if where.offsets_lsb is None or where.written_lsb is None or where.sensor not in VARIANTS:
        return gyro
    moved = np.array(where.written_lsb) - np.array(where.offsets_lsb)
    return gyro.with_force_moved(moved * VARIANTS[where.sensor].accel_mg_per_lsb / 1000)
