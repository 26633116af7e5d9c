"""Method `ml`: maximum likelihood of the base model and a bias, in the plane and in space."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from adis_gonio.base.errors import FitError, SingularError
from adis_gonio.base.numbers import counted, signed, with_unit
from adis_gonio.fitting.determination import (
    Determination,
    covariance,
    format_directions,
    is_determined,
    natural_units,
    shift_by_held,
)
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import FitResult, Origin, Output, outputs_of, result_of
from adis_gonio.fitting.noise_estimation import settle
from adis_gonio.fitting.uncertainty import by_rotation_of, response_of, sources_of


def fit_ml(readings: Readings) -> FitResult:
    """Fit the base model (attitude, gains, misalignments) and a bias of each axis by maximum likelihood.

    This is the method `ml`.

    Raises
    ------
    SingularError
        The session determines neither delta_k nor delta_phi, or in space none of the parameters.
    """
    settled = settle(readings)
    determination, noise = settled.determination, settled.noise
    fit = determination.fit
    names, null = determination.names, determination.null
    held = [names[k] for k in determination.held]
    unseen = ["alpha"] if readings.planar and not fit.data.visible[0] else []
    outputs = [o for o in outputs_of(fit.data, fit.values.parameters) if o.name not in (*held, *unseen)]
    reported = [o for o in outputs if is_determined(o.gradient, null)]
    lost = [o.name for o in outputs if not is_determined(o.gradient, null)]
    wanted = ("delta_k", "delta_phi") if readings.planar else names
    if not any(o.name in wanted for o in reported):
        directions = "; ".join(format_directions(null, names))
        advice = advise_positions(lost)
        if readings.planar and not np.isfinite(readings.angle_rad).any():
            advice = "declare the stage's angle of each position (column angle_deg)"
        raise SingularError(
            f"{counted(len(readings), 'position')} cannot determine {' or '.join(wanted[:2])}: they "
            f"contain no information on {directions}; {advice}"
        )
    warnings = [*readings.notes, *noise.notes, *_warnings(determination, held, lost, reported)]
    sources = None
    if noise.known:
        inverse, natural = (
            covariance(determination.fisher, determination.free, null),
            natural_units(fit.data),
        )
        response, rotation = response_of(fit, inverse, natural), by_rotation_of(fit, inverse, natural)
        sources = sources_of(readings, noise, fit, response, determination.held, rotation)
    made = Origin(readings, noise, fit, tuple(reported), sources, determination)
    return result_of(made, "ml", settled.chi2, settled.dof, warnings, (*unseen, *held, *lost))


def _warnings(
    determination: Determination, held: list[str], lost: list[str], reported: list[Output]
) -> list[str]:
    warnings = []
    names = determination.names
    for name, k in zip(held, determination.held, strict=True):
        shift = shift_by_held(determination, k)
        # Effect of 1 mg of bias, or of a tenth of a degree of skew.
        one = 1 / determination.fit.data.gravity_mg if name.startswith("bias") else math.radians(0.1)
        moves = [
            f"{o.name} by {with_unit(signed(float(o.gradient @ shift) * one, digits=2), o.unit)}"
            for o in reported
            if o.name in ("delta_k", "delta_phi") or o.name.startswith("bias")
        ]
        step = "1 mg" if name.startswith("bias") else "0.1°"
        moved = f": {step} of it moves {', '.join(moves)}" if moves else ""
        warnings.append(
            f"{name} cannot be seen in these positions and was taken as zero{moved}; "
            f"{advise_positions([name])}"
        )
    if determination.null.shape[1]:
        for direction in format_directions(determination.null, names):
            warnings.append(f"not determined by these positions: {direction}")
        warnings.append(f"left out because not determined: {', '.join(lost)}; {advise_positions(lost)}")
    return warnings


def advise_positions(names: list[str]) -> str:
    """Return advice on positions that determine the parameters with these names."""
    if any(name.startswith("skew") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure positions that share gravity between the two axes"
    axes = sorted({name[-1] for name in names if name.startswith(("bias", "scale"))})
    if any(name.endswith("_z") for name in names):
        return f"measure positions with axis {', '.join(axes) or 'z'} up and down"
    if any(name.startswith("bias") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure the opposite positions too (180° and 270°)"
    return "measure positions all around the turn (0°, 90°, 180°, 270°)"


def refit_ml(readings: Readings, made: Origin) -> Fit:
    """Repeat the fit of the method `ml` on other readings, or on a subset of the dwells.

    The fit starts from the values of the original fit in `made`.

    Raises
    ------
    FitError
        If these dwells do not determine the parameters that all dwells determine.
    """
    found = made.determination
    assert found is not None
    row = {position: k for k, position in enumerate(made.fit.data.position.tolist())}
    attitude = made.fit.values.attitude[[row[position] for position in readings.position.tolist()]]
    readings = replace(readings, fitted=made.fit.data.fitted)
    start = replace(made.fit, data=readings, values=replace(made.fit.values, attitude=attitude))
    # Along a direction without information a refit runs for many steps, so this is checked before it.
    if not found.determined_by(start):
        raise FitError("the other dwells do not determine the parameters")
    return replace(found, fit=start).refitted(readings)
