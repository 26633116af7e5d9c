"""Method `ml`: the base model with a bias, by maximum likelihood, in the plane and in space."""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.arrays import Floats, mean_direction, wrap_radians
from adis_gonio.base.errors import SingularError
from adis_gonio.base.numbers import counted, use_minus, with_unit
from adis_gonio.fitting.determination import (
    Determination,
    covariance,
    in_words,
    is_determined,
    natural_units,
    shift_by_held,
)
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.noise import Settled, settle
from adis_gonio.fitting.outputs import Output, estimates, left_to_the_stage, outputs_of, variances
from adis_gonio.fitting.result import FitResult, Origin
from adis_gonio.fitting.sources import Sources, Unseen, by_rotation_of, response_of, sources_of
from adis_gonio.model.measurement import PlanarTurn


def fit_ml(readings: Readings) -> FitResult:
    """Maximum likelihood of the base model and a bias.

    Raises
    ------
    SingularError
        If the session determines neither delta_k nor delta_phi, in space none of the parameters.
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
        directions = "; ".join(in_words(null, names))
        raise SingularError(
            f"{counted(len(readings), 'position')} cannot determine {' or '.join(wanted[:2])}: without "
            f"information is {directions}; {_advice(lost)}"
        )
    warnings = [*readings.notes, *noise.notes, *_warnings(determination, held, lost, reported)]
    sources = _sources(readings, settled)
    found = estimates(reported, sources)
    warnings += left_to_the_stage(found, noise.sigma_rad)
    norm = np.linalg.norm(_calibrated(fit), axis=1)[:, None] - 1
    return FitResult(
        method="ml",
        parameters=found,
        covariance=None if sources is None else variances(reported, sources.covariance),
        chi2=settled.chi2,
        dof=settled.dof,
        residual_mg=fit.misfit if readings.planar else norm * readings.gravity_mg,
        positions=tuple(readings.position.tolist()),
        angle_error_rad=angle_errors(fit),
        warnings=tuple(warnings),
        undetermined=(*unseen, *held, *lost),
        extra_mg=noise.extra_mg,
        fixture_sigma_deg=math.degrees(noise.sigma_rad) if readings.planar else None,
        origin=Origin(readings, noise, fit, tuple(reported), sources, determination),
    )


def _calibrated(fit: Fit) -> Floats:
    """Gravity (n, axes) that the calibrated sensor computes from each reading alone."""
    beside = sum((fit.added(k) for k in range(len(fit.terms))), np.zeros(fit.data.mean.shape))
    return fit.data.model.calibrated(fit.values.base, fit.data.mean - beside)


def angle_errors(fit: Fit) -> Floats | None:
    """Angle of the calibrated goniometer minus the declared angle (m,) in rad; None without any.

    Where attitudes are free, α is not known and the mean difference stands in for it.
    """
    data = fit.data
    declared = np.isfinite(data.angle_rad)
    if not isinstance(data.model, PlanarTurn) or not declared.any():
        return None
    gravity = _calibrated(fit)[declared]
    shown = np.arctan2(gravity[:, 1], gravity[:, 0]) + data.angle_rad[declared]
    zero = mean_direction(shown) if data.free else float(fit.values.base[0])
    # Positive for a stage that stands further on than declared: ψ = α − θ.
    return -wrap_radians(shown - zero)


def _sources(readings: Readings, settled: Settled) -> Sources | None:
    """Sources of the uncertainty; None where nothing tells the noise of a reading."""
    if not settled.noise.known:
        return None
    found = settled.determination
    inverse = covariance(found.fisher, found.free, found.null)
    natural = natural_units(found.fit.data)
    response = response_of(found.fit, inverse, natural)
    first = len(found.fit.data.model.parameters)
    rotation = by_rotation_of(found.fit, inverse, natural)
    unseen = Unseen(
        tuple(k - first for k in found.held if k >= first), tuple(k for k in found.held if k < first)
    )
    return sources_of(readings, settled.noise, found.fit, response, unseen, rotation)


def _warnings(
    determination: Determination, held: list[str], lost: list[str], reported: list[Output]
) -> list[str]:
    warnings = []
    names = determination.names
    for name, k in zip(held, determination.held, strict=True):
        shift = shift_by_held(determination, k)
        # One mg of bias, or a tenth of a degree of skew.
        one = 1 / determination.fit.data.gravity_mg if name.startswith("bias") else math.radians(0.1)
        moves = [
            f"{o.name} by {with_unit(use_minus(f'{float(o.gradient @ shift) * one:+.2g}'), o.unit)}"
            for o in reported
            if o.name in ("delta_k", "delta_phi") or o.name.startswith("bias")
        ]
        step = "1 mg" if name.startswith("bias") else "0.1°"
        moved = f": {step} of it moves {', '.join(moves)}" if moves else ""
        warnings.append(
            f"{name} cannot be seen in these positions and was taken as zero{moved}; {_advice([name])}"
        )
    if determination.null.shape[1]:
        for direction in in_words(determination.null, names):
            warnings.append(f"not determined by these positions: {direction}")
        warnings.append(f"left out because not determined: {', '.join(lost)}; {_advice(lost)}")
    return warnings


def _advice(names: list[str]) -> str:
    if any(name.startswith("skew") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure positions that share gravity between the two axes"
    axes = sorted({name[-1] for name in names if name.startswith(("bias", "scale"))})
    if any(name.endswith("_z") for name in names):
        return f"measure positions with axis {', '.join(axes) or 'z'} up and down"
    if any(name.startswith("bias") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure the opposite positions too (180° and 270°)"
    return "measure positions all around the turn (0°, 90°, 180°, 270°)"
