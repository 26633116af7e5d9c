"""Method `ml`: maximum likelihood in the plane and in space, made into a result."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from adis_gonio.errors import SingularError
from adis_gonio.fitting import planar
from adis_gonio.fitting.families import PlanarFamily, SpatialFamily
from adis_gonio.fitting.least_squares import (
    Determination,
    covariance,
    in_words,
    is_determined,
    shift_by_held,
)
from adis_gonio.fitting.outputs import Output, planar_outputs, spatial_outputs
from adis_gonio.fitting.planar import PlanarProblem
from adis_gonio.fitting.readings import Readings
from adis_gonio.fitting.result import Estimate, FitResult
from adis_gonio.fitting.spatial import SpatialProblem
from adis_gonio.fitting.stochastic import Noise, Settled, problem_of, settle
from adis_gonio.model.geometry import wrap_rad
from adis_gonio.model.records import Floats


def fit_planar(readings: Readings) -> FitResult:
    """Maximum likelihood in the plane.

    Raises
    ------
    SingularError
        If the session determines neither delta_k nor delta_phi.
    FitError
        If the fit does not converge or counts lie on no ellipse.
    """
    family = PlanarFamily(readings)
    settled = settle(family)
    beta = settled.determination.solution.beta
    problem = problem_of(family, settled.noise)
    assert isinstance(problem, PlanarProblem)
    outputs = planar_outputs(beta, family.units)
    if not family.free[planar.ALPHA]:
        outputs = tuple(o for o in outputs if o.name != "alpha")
    result = _result(family, settled, outputs, ("delta_k", "delta_phi"))
    psi = beta[planar.ALPHA] - problem.angle + problem.best_delta(beta)
    residual = (problem.readings - problem.model(beta, psi)) * readings.gravity_mg
    extra = () if family.free[planar.ALPHA] else ("alpha",)
    return replace(
        result,
        residual_mg=residual,
        angle_error_rad=angle_errors(problem, beta, readings),
        undetermined=extra + result.undetermined,
        fixture_sigma_deg=math.degrees(settled.noise.sigma_rad),
    )


def fit_spatial(readings: Readings) -> FitResult:
    """Maximum likelihood in space with free attitudes.

    Raises
    ------
    SingularError
        If the session determines none of the parameters.
    FitError
        If the fit does not converge or counts lie on no ellipsoid.
    """
    family = SpatialFamily(readings)
    settled = settle(family)
    beta = settled.determination.solution.beta
    problem = problem_of(family, settled.noise)
    assert isinstance(problem, SpatialProblem)
    outputs = spatial_outputs(beta, family.units)
    result = _result(family, settled, outputs, tuple(o.name for o in outputs))
    norm = np.linalg.norm(problem.calibrated(beta), axis=1) - 1
    return replace(result, residual_mg=norm[:, None] * readings.gravity_mg)


def angle_errors(problem: PlanarProblem, beta: Floats, readings: Readings) -> Floats | None:
    """Angle of the calibrated goniometer minus the declared angle (m,) in rad; None without any.

    Where attitudes are free, α is not known and the mean difference stands in for it.
    """
    declared = np.isfinite(readings.angle_rad)
    if not declared.any():
        return None
    shown = problem.angle_shown(beta)[declared] + readings.angle_rad[declared]
    zero = beta[planar.ALPHA] if problem.determines_alpha else np.angle(np.exp(1j * shown).sum())
    # Positive for a stage that stands further on than declared: ψ = α − θ.
    return -wrap_rad(shown - zero)


def _result(
    family: PlanarFamily | SpatialFamily,
    settled: Settled,
    outputs: tuple[Output, ...],
    wanted: tuple[str, ...],
) -> FitResult:
    determination, noise = settled.determination, settled.noise
    problem = problem_of(family, noise)
    null = determination.null
    held = [problem.names[k] for k in determination.held]
    reported = [o for o in outputs if o.name not in held and is_determined(o.gradient, null)]
    lost = [o.name for o in outputs if o.name not in held and not is_determined(o.gradient, null)]
    if not any(o.name in wanted for o in reported):
        directions = "; ".join(in_words(null, problem.names))
        raise SingularError(
            f"{len(family.readings)} positions do not determine {' or '.join(wanted[:2])}: without "
            f"information is {directions}; {_advice(lost)}"
        )
    warnings = [*family.readings.notes, *noise.notes]
    warnings += _warnings(determination, held, lost, reported, problem.names, family)
    estimates, matrix = _uncertainties(family, noise, determination, reported)
    return FitResult(
        method="ml",
        parameters=estimates,
        covariance=matrix,
        chi2=settled.chi2,
        dof=settled.dof,
        residual_mg=np.zeros((0, 1)),
        positions=tuple(family.readings.position.tolist()),
        warnings=tuple(warnings),
        undetermined=tuple(held + lost),
        extra_mg=noise.extra * family.gravity_mg,
    )


def _uncertainties(
    family: PlanarFamily | SpatialFamily, noise: Noise, determination: Determination, reported: list[Output]
) -> tuple[tuple[Estimate, ...], Floats | None]:
    if not noise.known:
        return tuple(Estimate(o.name, o.value, None, o.unit) for o in reported), None
    solution = determination.solution
    wide, sigma = noise.for_intervals(family.natural_covariance, family.readings)
    problem = family.problem(wide, sigma)
    fisher = problem.evaluate(solution.beta).fisher
    natural = covariance(fisher, solution.free, determination.null)
    shared = family.natural_shared()
    if shared is not None:
        # Neighbours share 1/f noise. The fit takes it for noise of each reading's own and so weighs nearly
        # as it should; what its result scatters by is another matter.
        carried = natural @ np.moveaxis(problem.influence(solution.beta), 2, 0).reshape(len(natural), -1)
        carried = carried.reshape(len(natural), *family.natural.shape)
        natural = natural + np.einsum("pna,nma,qma->pq", carried, shared, carried)
    gradients = np.stack([o.gradient for o in reported])
    matrix = gradients @ natural @ gradients.T
    return (
        tuple(
            Estimate(o.name, o.value, math.sqrt(max(float(matrix[k, k]), 0.0)), o.unit)
            for k, o in enumerate(reported)
        ),
        matrix,
    )


def _warnings(
    determination: Determination,
    held: list[str],
    lost: list[str],
    reported: list[Output],
    names: tuple[str, ...],
    family: PlanarFamily | SpatialFamily,
) -> list[str]:
    warnings = []
    solution = determination.solution
    for name, k in zip(held, determination.held, strict=True):
        shift = shift_by_held(solution.fisher, solution.free, determination.null, k)
        # One mg of bias, or a tenth of a degree of skew.
        one = 1 / family.gravity_mg if name.startswith("bias") else math.radians(0.1)
        moves = [
            f"{o.name} by {float(o.gradient @ shift) * one:+.2g}{_unit(o.unit)}"
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


def _unit(unit: str) -> str:
    return {"1": "", "deg": "°"}.get(unit, f" {unit}")


def _advice(names: list[str]) -> str:
    if any(name.startswith("skew") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure positions that share gravity between the two axes"
    axes = sorted({name[-1] for name in names if name.startswith(("bias", "scale")) and len(name) == 6 + 1})
    if any(name.endswith("_z") for name in names):
        return f"measure positions with axis {', '.join(axes) or 'z'} up and down"
    if any(name.startswith("bias") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure the opposite positions too (180° and 270°)"
    return "measure positions all around the turn (0°, 90°, 180°, 270°)"
