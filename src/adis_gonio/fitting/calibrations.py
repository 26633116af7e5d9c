"""From a fit to a `Calibration`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.coefficients import Coefficient
from adis_gonio.fitting.result import Estimate, FitResult
from adis_gonio.model.effects import AXES
from adis_gonio.model.measurement import FreeAttitude, PlanarTurn
from adis_gonio.model.records import MG_PER_MPS2
from adis_gonio.record.provenance import Provenance
from adis_gonio.record.write_journal import INTERRUPTED


def calibration_as_recorded(result: FitResult) -> Calibration:
    """Return the calibration by a fit, for the offsets in force while its session was recorded.

    Use only this calibration for the session's own readings: a later write changes the sensor and the
    coefficients, but not the recorded readings.

    Raises
    ------
    UsageError
        The result was not made from a session (`fit_readings`).
    FitError
        The session does not determine a parameter that an angle needs.
    """
    where = known_provenance(result.provenance)
    model = _model(where)
    estimates = {one.name: one for one in result.parameters}
    if where.plane == "xy" and "scale_x" not in estimates and "delta_k" in estimates:
        # Only the ratio of the gains is known, which is enough for an angle: the gain of Y is set to 1.
        ratio = estimates["delta_k"]
        estimates["scale_x"] = Estimate("scale_x", 1 + ratio.value, ratio.u, "1")
    names = [name for name in _names(model) if name in estimates]
    given = [one.name for one in result.parameters]
    rows = [given.index("delta_k" if name not in given else name) for name in names]
    matrix = None if result.covariance is None else result.covariance[np.ix_(rows, rows)]
    parameters = tuple(Coefficient.of(name, estimates[name]) for name in names)
    assumed = assumed_parameters(model, names)
    counts = (
        tuple(estimates[f"scale_{axis}"].value / MG_PER_MPS2 for axis in AXES[: model.axes])
        if (where.counts)
        else None
    )
    return Calibration(result.method, where, parameters, matrix, assumed=assumed, counts_per_mg=counts)


def as_written(calibration: Calibration) -> Calibration:
    """Return the calibration for the offsets that the sensor holds now.

    Raises
    ------
    SessionError
        A write of offsets was interrupted.
    """
    where = calibration.provenance
    if where.write_open:
        raise SessionError(f"{where.source}: {INTERRUPTED}")
    return calibration if where.written_lsb is None else calibration.with_offsets(where.written_lsb)


def known_provenance(where: Provenance | None) -> Provenance:
    """Return the provenance of a result that was made from a session.

    Raises
    ------
    UsageError
        The result was made from readings.
    """
    if where is None:
        raise UsageError("this result was made from readings: fit or trace a session to get a calibration")
    return where


def _model(where: Provenance) -> PlanarTurn | FreeAttitude:
    gravity_mg = where.gravity_mps2 * MG_PER_MPS2
    return PlanarTurn(gravity_mg) if where.plane == "xy" else FreeAttitude(gravity_mg)


def _names(model: PlanarTurn | FreeAttitude) -> list[str]:
    return [*model.names, *(f"bias_{axis}" for axis in AXES[: model.axes])]


def assumed_parameters(model: object, names: Sequence[str]) -> tuple[str, ...]:
    """Parameters that keep their nominal values.

    Raises
    ------
    FitError
        One of them is needed for an angle.
    """
    assert isinstance(model, PlanarTurn | FreeAttitude)
    missing = [name for name in _names(model) if name not in names]
    needed = [name for name in missing if not name.startswith(("bias", "alpha", "scale_y"))]
    if needed:
        raise FitError(f"the session does not determine {', '.join(needed)}: it gives no calibration")
    return tuple(missing)
