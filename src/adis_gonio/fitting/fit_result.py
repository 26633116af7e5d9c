"""Result of a fit: parameters with names, units and covariance, and everything derived from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats, mean_direction, unsolvable, wrap_radians
from adis_gonio.base.conformity import ErrorCurve
from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import counted
from adis_gonio.base.tables import ParameterTable
from adis_gonio.base.uncertainty import Value, factor_over
from adis_gonio.calibrate.calibration import Calibration, Coefficient
from adis_gonio.fitting.determination import LIMIT, Determination, NoiseAssumptions, is_determined, names_of
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.linked import LinkReport
from adis_gonio.fitting.slips.session_positions import PositionFinding, listed
from adis_gonio.fitting.uncertainty import FIXTURE, BudgetRow, ShownAngle, Sources, budget_of
from adis_gonio.model.effects import AXES
from adis_gonio.model.measurement import FreeAttitude, Measurement, PlanarTurn
from adis_gonio.model.records import MG_PER_MPS2
from adis_gonio.record.provenance import Provenance
from adis_gonio.record.write_journal import INTERRUPTED

if TYPE_CHECKING:
    from adis_gonio.fitting.answer import MethodComparison


class FittedParameters(ParameterTable, kw_only=True):
    """Base class of the results of fits: parameters by name with their covariance, and remarks.

    Attributes
    ----------
    method : str
        Name of the method.
    parameters : mapping of str to Value
        Parameters that the session determines; the others are named in `undetermined`.
    covariance : (p, p) float or None
        In the order and units of `parameters`; None if the noise is unknown.
    chi2, dof : float, int
        χ² of the residual, by the measured or stated noise, and its degrees of freedom.
    positions : tuple of int
        Numbers of the dwells used; for a turn of the gyros, of the dwell in which it ends.
    warnings : tuple of str
        Remarks for the user.
    undetermined : tuple of str
        Parameters, or combinations of parameters, that the session cannot determine.
    reference_temperature_c : float or None
        Mean temperature of the fitted dwells, at which the parameters are valid; None if unknown.
    provenance : Provenance or None
        Origin of the readings; None if no session was given.
    overrides : mapping
        Overrides of values in the session's file, old and new (`session.overrides`).
    """

    method: str
    parameters: dict[str, Value]
    covariance: Floats | None
    chi2: float
    dof: int
    positions: tuple[int, ...]
    warnings: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    reference_temperature_c: float | None = None
    provenance: Provenance | None = field(default=None, compare=False)
    overrides: dict[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Value:
        """Return the parameter of this name; `KeyError` if the session does not determine it."""
        return self.parameters[name]

    def __contains__(self, name: object) -> bool:
        return name in self.parameters

    @property
    def names(self) -> list[str]:
        """Names of the parameters, in their order."""
        return list(self.parameters)

    def as_dict(self) -> dict[str, Any]:
        """Return the entries that the JSON documents of all fits have in common."""
        known = self.covariance is not None
        return json_object(
            method=self.method,
            parameters=self.parameters,
            covariance={"names": self.names * known, "matrix": self.covariance if known else []},
            chi2=self.chi2,
            dof=self.dof,
            warnings=self.warnings,
            undetermined=self.undetermined,
            reference_temperature_c=self.reference_temperature_c,
            overrides=self.overrides,
        )


@dataclass(frozen=True)
class Origin:
    """Inputs of a fit, kept to compute further quantities from it later.

    Attributes
    ----------
    readings : Readings
        Fitted readings, before `noise` was estimated.
    noise : NoiseAssumptions
        Noise of the readings and of the declared angles that the fit used, stated or estimated.
    fit : Fit
        Model at the parameters of the method, on the readings with that noise.
    determination : Determination or None
        Fitted and fixed parameters of the method `ml`; None for other methods.
    """

    readings: Readings
    noise: NoiseAssumptions
    fit: Fit
    determination: Determination | None = None


MAIN = ("delta_k", "delta_phi")
"""Names of the main parameters of a session in the plane."""
MISFIT = (
    "The model does not describe this session: the residual is larger than the noise."
    " Run adis-gonio trace to find the missing effect."
)


class FitResult(FittedParameters, kw_only=True):
    """Fitted parameters of a session, with their covariance, warnings and residuals.

    The method is one of `METHODS`.

    Attributes
    ----------
    residual_mg : (n, axes) or (n, 1) float
        Reading minus model of each dwell used, in mg; in space the residual of the norm.
    angle_error_rad : (m,) float or None
        Angle by the calibrated goniometer minus the declared angle, for each dwell with a declared angle;
        None without declared angles.
    extra_mg : float
        Standard deviation per reading and axis, in addition to the measured noise, that explains the
        residual; 0 if the measured noise explains it.
    fixture_sigma_deg : float or None
        Standard uncertainty of a declared angle in the fit; inf for free attitudes; None in space.
    outputs : tuple of Output
        The parameters with their derivatives, in the order of `parameters`.
    sources : Sources or None
        Sources of the uncertainty; None if the noise of a reading is unknown.
    around : ShownAngle or None
        Derivatives of the calibrated angle at angles around the turn; None in space, or if the session does
        not determine a parameter that an angle needs.
    origin : Origin or None
        Inputs of the fit; like the three attributes before not part of the JSON document or a comparison.
    session : Readings or None
        All readings of the session, on which methods are compared; None if the result was made from
        readings.
    session_notes : tuple of str
        Notes from the reader of the file and on wrong positions; they are the first `warnings` after
        `doubts`.
    position_findings : tuple of PositionFinding
        Positions that differ from the declared angle (`adis_gonio.fitting.slips`).
    links : LinkReport or None
        Report on turns between poses in space; None without such turns.
    """

    residual_mg: Floats
    angle_error_rad: Floats | None = None
    extra_mg: float = 0.0
    fixture_sigma_deg: float | None = None
    outputs: tuple[Output, ...] = field(default=(), compare=False)
    sources: Sources | None = field(default=None, compare=False)
    around: ShownAngle | None = field(default=None, compare=False)
    origin: Origin | None = field(default=None, compare=False)
    session: Readings | None = field(default=None, compare=False)
    session_notes: tuple[str, ...] = ()
    position_findings: tuple[PositionFinding, ...] = ()
    links: LinkReport | None = None

    @property
    def residual_rms_mg(self) -> float:
        """Root mean square of the residuals of all dwells and axes, in mg."""
        return float(np.sqrt(np.mean(self.residual_mg**2)))

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warning `MISFIT` if the residual is larger than the measured noise; otherwise empty."""
        return (MISFIT,) if self.extra_mg else ()

    def __repr__(self) -> str:
        lead = [name for name in MAIN if name in self] or self.names[:2]
        values = ", ".join(f"{name} {self[name]}" for name in lead)
        return f"FitResult({self.method}, {counted(len(self.positions), 'dwell')}, {values})"

    def calibration(self) -> Calibration:
        """Return the calibration that converts readings to angles with these parameters.

        It is valid for the offsets that the sensor's registers have now, after the last write in the
        session's file.

        Raises
        ------
        UsageError
            The result was made from readings, not from a session.
        FitError
            The session does not determine a parameter that an angle needs.
        SessionError
            A write of offsets was interrupted.
        """
        return as_written(calibration_as_recorded(self))

    @cached_property
    def comparison(self) -> MethodComparison | None:
        """Scores of all methods on the session's readings, with the recommended method.

        None if the result was not made from a session.
        """
        from adis_gonio.fitting.answer import compare_methods

        if self.session is None:
            return None
        try:
            return self.session.once(compare_methods)
        except np.linalg.LinAlgError as error:
            source = "" if self.provenance is None else self.provenance.source
            raise unsolvable(source or "session", error) from error

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budget of `delta_k`, `delta_phi` and `angle`: one row for each source, by result.

        Empty in space, or if the noise is unknown. A result that the session does not determine is absent.
        """
        if self.sources is None:
            return {}
        slopes: dict[str, tuple[Floats, Floats | None]] = {
            one.name: (one.gradient[None], None) for one in self.outputs if one.name in MAIN
        }
        if self.around is not None:
            slopes["angle"] = self.around.gradient, self.around.reading
        return {name: budget_of(self.sources, *slope) for name, slope in slopes.items()}

    @cached_property
    def shown_angle(self) -> Value | None:
        """Standard uncertainty of an angle that the calibrated sensor shows; None in space.

        It is the root mean square over a turn, for a reading that is averaged for as long as a dwell of the
        session; the `value` is NaN. There is no uncertainty if the noise is unknown, or if the session does
        not determine a parameter that an angle needs.
        """
        shown = self.around
        if shown is None or self.sources is None:
            return Value(math.nan, None, "deg") if self.parameters.keys() & MAIN else None
        u, dof = self.sources.uncertainty(shown.gradient, shown.reading)
        variances = self.sources.by_place(shown.gradient, shown.reading)
        return Value(math.nan, u, "deg", dof, factor_over(variances, dof))

    @property
    def stage_influence(self) -> dict[str, Floats]:
        """Change (k,) of each parameter by one u of each error of the stage's certificate, by name.

        The k errors are independent. Empty without such a certificate, or if the noise is unknown.
        """
        made = self.origin
        if made is None or self.sources is None or not (errors := made.readings.stage.shape[2]):
            return {}
        fixture = next(source for source in self.sources.each if source.name == FIXTURE)
        moves = fixture.moves[:, -errors:]
        return {output.name: output.gradient @ moves for output in self.outputs}

    def error_curves(self) -> tuple[ErrorCurve | None, ErrorCurve]:
        """Return the error of the angle over the turn, first without and then with this calibration.

        The first is None if the sensor's scale is unknown (`Calibration.error_curves`). In the plane the
        uncertainty also covers biases that the fit had to take as zero.

        Raises
        ------
        FitError
            The session does not determine the angle.
        """
        # A free turn has no stage; its result is made without readings of positions.
        curves = calibration_as_recorded(self).error_curves(stage=self.origin is not None)
        shown = self.shown_angle
        if shown is not None and shown.u is None and self.origin is not None:
            raise FitError("the session does not determine the angle: conformity needs more positions")
        return curves

    @cached_property
    def angle(self) -> Value | None:
        """Error of the calibrated angle (rms, deg), with the u of one displayed angle; None in space.

        The value is the root mean square over the dwells of the session, each left out of the fit; NaN if
        no angle is declared or no dwell can be left out.
        """
        score = None if self.comparison is None else self.comparison.scores.get(self.method)
        if self.shown_angle is None or score is None or score.angle_rms_deg is None:
            return self.shown_angle
        return replace(self.shown_angle, value=score.angle_rms_deg)

    def summary(self) -> str:
        """Return a summary in a few lines of plain text, as `adis-gonio fit` prints it."""
        from adis_gonio.fitting.answer import Answer

        return Answer.of(self).text()

    def __str__(self) -> str:
        return self.summary()

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio fit --json` prints."""
        errors = None
        if self.angle_error_rad is not None and self.angle_error_rad.size:
            degrees = np.degrees(self.angle_error_rad)
            errors = {"rms": np.sqrt(np.mean(degrees**2)), "max": np.abs(degrees).max()}
        sigma = self.fixture_sigma_deg
        comparison = self.comparison
        return super().as_dict() | json_object(
            recommended=None if comparison is None else comparison.recommended,
            angle=self.angle,
            budget=self.budget,
            scores={} if comparison is None else comparison.scores,
            residual_rms_mg=self.residual_rms_mg,
            angle_error_deg=errors,
            extra_reading_u_mg=self.extra_mg,
            fixture_sigma_deg="free" if sigma is not None and math.isinf(sigma) else sigma,
            positions_used=len(self.positions),
            **listed(self.position_findings),
            **{} if self.links is None else {"links": self.links},
        )


@dataclass(frozen=True)
class Output:
    """A quantity that a result reports, with its derivative by the parameters in natural units.

    `name`, `value` and `unit` are as reported; `gradient` (p,) is the derivative.
    """

    name: str
    value: float
    unit: str
    gradient: Floats


def outputs_of(data: Readings, parameters: Floats) -> tuple[Output, ...]:
    """Return all reported quantities, from base parameters and biases in one array (p,).

    Base parameters are in natural units, biases in mg. In the plane delta_k and delta_phi come first. For
    readings in counts, gains and biases are in counts.
    """
    names = names_of(data.model)
    eye = np.eye(len(names))
    at = {name: k for k, name in enumerate(names)}
    axes = AXES[: data.axes]
    outputs = []
    for base in data.model.parameters:
        k = at[base.name]
        factor, unit = base.per_natural, base.unit
        if base.name.startswith("scale") and not data.unit.known:
            factor, unit = float(data.unit.per_mg[AXES.index(base.name[-1])]) * MG_PER_MPS2, "counts/(m/s²)"
        value = float(parameters[k]) * factor if unit != "deg" else base.stated(float(parameters[k]))
        outputs.append(Output(base.name, value, unit, eye[k] * factor))
    for axis, letter in enumerate(axes):
        k = at[f"bias_{letter}"]
        factor = float(data.unit.per_mg[axis])
        value = float(data.unit.zero[axis]) + float(parameters[k]) * factor
        outputs.append(Output(names[k], value, data.unit.name, eye[k] * factor * data.gravity_mg))
    if data.planar:
        x, y = at["scale_x"], at["scale_y"]
        ratio = float(data.unit.per_mg[0] / data.unit.per_mg[1])
        k_x, k_y = float(parameters[x]), float(parameters[y])
        outputs.append(
            Output("delta_k", ratio * k_x / k_y - 1, "1", ratio * (eye[x] / k_y - eye[y] * k_x / k_y**2))
        )
    return tuple(sorted(outputs, key=lambda output: _RANK.get(output.name, len(_RANK))))


def stage_warnings(found: Mapping[str, Value], sigma_rad: float) -> list[str]:
    """Return a warning if only the stage's angles determine the angle between the axes, and poorly.

    Otherwise the list is empty. `found` are the parameters of the result; `sigma_rad` is the standard
    uncertainty of a declared angle.
    """
    u_deg = found["delta_phi"].u if "delta_phi" in found else None
    if u_deg is None or math.radians(u_deg) <= LIMIT or not math.radians(u_deg) <= 2 * sigma_rad < math.inf:
        return []
    return [
        f"u of Δφ is {u_deg:.2g}°: only the stage determines it in these positions "
        f"({math.degrees(sigma_rad):.3g}°), and the uncertainties of gains and biases, "
        "which are linear in it, are rough; five or more positions all around the turn need no stage for it"
    ]


_FIRST: Sequence[str] = ("delta_k", "delta_phi", "alpha", "scale_x", "scale_y", "scale_z")
_RANK = {name: rank for rank, name in enumerate(_FIRST)}


def variances(outputs: Sequence[Output], natural: Floats) -> Floats:
    """Return the covariance (m, m) of m reported quantities.

    `natural` is the covariance (p, p) of the parameters in natural units.
    """
    gradients = np.stack([output.gradient for output in outputs])
    return np.asarray(gradients @ natural @ gradients.T)


def values_of(outputs: Sequence[Output], sources: Sources | None) -> dict[str, Value]:
    """Return the reported quantities by name, with u from `sources` (None: without u)."""
    found = {}
    for output in outputs:
        u, dof = (None, math.inf) if sources is None else sources.uncertainty(output.gradient[None])
        found[output.name] = Value(output.value, u, output.unit, dof)
    return found


def start_angle(fit: Fit) -> float:
    """Return the start angle α in rad, from which a planar fit counts angles.

    If the attitudes were fitted without declared angles, α is unknown. The result is then the mean that the
    dwells with a declared angle show; NaN without such a dwell.
    """
    if fit.data.visible[0]:
        return float(fit.values.base[0])
    shown = -differences_of_angle(fit, 0.0)
    shown = shown[np.isfinite(shown)]
    return mean_direction(shown) if shown.size else math.nan


def differences_of_angle(fit: Fit, start_rad: float) -> Floats:
    """Return the calibrated minus the declared angle (n,) in rad; NaN for a dwell without a declared angle.

    `start_rad` is the start angle α.
    """
    # Positive for a stage at a larger angle than declared: ψ = α − θ.
    shown = np.arctan2(fit.gravity[:, 1], fit.gravity[:, 0]) - fit.turn_rad
    return np.where(np.isfinite(fit.data.angle_rad), -wrap_radians(shown - start_rad), np.nan)


def result_of(
    made: Origin, outputs: Sequence[Output], sources: Sources | None, warnings: Sequence[str], **about: Any
) -> FitResult:
    """Return the result of a fit: its parameters with uncertainties, residuals and warnings.

    `about` are further attributes of the result. A warning is added if only the stage determines the
    misalignment.
    """
    fit, noise = made.fit, made.noise
    found = values_of(outputs, sources)
    planar = fit.data.planar
    norm = np.linalg.norm(fit.gravity, axis=1)[:, None] - 1
    declared = np.isfinite(fit.data.angle_rad) & isinstance(fit.data.model, PlanarTurn)
    temperature = fit.data.conditions.temperature_c
    around = ShownAngle.around(fit) if planar else None
    if around is not None and made.determination is not None:
        null = made.determination.null
        around = around if all(is_determined(slope, null) for slope in around.gradient) else None
    return FitResult(
        parameters=found,
        covariance=None if sources is None else variances(outputs, sources.covariance),
        residual_mg=fit.misfit if planar else norm * fit.data.gravity_mg,
        positions=tuple(fit.data.position.tolist()),
        angle_error_rad=differences_of_angle(fit, start_angle(fit))[declared] if declared.any() else None,
        warnings=(*warnings, *stage_warnings(found, noise.sigma_rad)),
        reference_temperature_c=None if temperature is None else float(temperature.mean()),
        extra_mg=noise.extra_mg,
        fixture_sigma_deg=math.degrees(noise.sigma_rad) if planar else None,
        outputs=tuple(outputs),
        sources=sources,
        around=around,
        origin=made,
        **about,
    )


def calibration_as_recorded(result: FitResult, *, nominal: bool = False) -> Calibration:
    """Return the calibration for the offset registers as they were while the session was recorded.

    Use only this calibration for the session's own readings: a later write changes the sensor and the
    coefficients, but not the recorded readings. `nominal` allows each parameter that the session does not
    determine to be nominal, which is enough to predict a reading, but not to compute an angle.

    Raises
    ------
    UsageError
        The result was not made from a session (`fit_readings`).
    FitError
        The session does not determine a parameter that an angle needs, and `nominal` is False.
    """
    where = known_provenance(result.provenance)
    gravity_mg = where.gravity_mps2 * MG_PER_MPS2
    model = PlanarTurn(gravity_mg) if where.plane == "xy" else FreeAttitude(gravity_mg)
    estimates = dict(result.parameters)
    if where.plane == "xy" and "scale_x" not in estimates and "delta_k" in estimates:
        # Only the ratio of the gains is known, which is enough for an angle: the gain of Y is set to 1.
        ratio = estimates["delta_k"]
        estimates["scale_x"] = replace(ratio, value=1 + ratio.value)
    names = [name for name in names_of(model) if name in estimates]
    given = ["delta_k" if name not in result else name for name in names]
    rows = [result.names.index(name) for name in given]
    matrix = None if result.covariance is None else result.covariance[np.ix_(rows, rows)]
    parameters = tuple(Coefficient.of(name, estimates[name]) for name in names)
    assumed = assumed_parameters(model, names, nominal=nominal)
    if result.sources is not None:
        gradients = {one.name: one.gradient for one in result.outputs}
        slopes = np.stack([gradients[name] for name in given])
        held, matrix = _with_held_biases(result.sources, slopes, assumed, model.axes)
        parameters += held
    scales = [estimates[f"scale_{axis}"].value for axis in AXES[: model.axes]] if where.counts else []
    counts, shown = tuple(scale / MG_PER_MPS2 for scale in scales) or None, result.shown_angle
    return Calibration(
        method=result.method,
        provenance=where,
        parameters=parameters,
        covariance=matrix,
        assumed=assumed,
        counts_per_mg=counts,
        ratio_dof=getattr(estimates.get("delta_k"), "dof", None),
        angle_dof=None if shown is None or shown.u is None else shown.dof,
    )


def _with_held_biases(
    sources: Sources, gradient: Floats, assumed: Sequence[str], axes: int
) -> tuple[tuple[Coefficient, ...], Floats]:
    """Return the biases that a fit took as zero, and the joint covariance of parameters and biases.

    An error of such a bias moves the parameters and also each further reading, so that an angle has the
    right uncertainty only with both. A bias of a size that nothing states is left out.

    Parameters
    ----------
    sources : Sources
        Sources of the uncertainty of the result.
    gradient : (p, q) float
        Derivatives of the parameters of a calibration by the natural parameters of the fit.
    assumed : sequence of str
        Names of the parameters that the session does not determine.
    """
    # The bias is zero in the model: its error is the negative change of a further reading.
    roots = sources.roots(
        np.pad(gradient, ((0, axes), (0, 0))), np.pad(-np.eye(axes), ((len(gradient), 0), (0, 0)))
    )
    matrix = np.asarray(roots @ roots.T)
    u = np.sqrt(np.diag(matrix)[len(gradient) :])
    held = [k for k, axis in enumerate(AXES[:axes]) if f"bias_{axis}" in assumed and u[k] > 0]
    kept = [*range(len(gradient)), *(len(gradient) + k for k in held)]
    biases = tuple(Coefficient(f"bias_{AXES[k]}", 0.0, float(u[k]), "mg") for k in held)
    return biases, matrix[np.ix_(kept, kept)]


def as_written(calibration: Calibration) -> Calibration:
    """Return a calibration adapted to the offsets that were written to the sensor after its session.

    A calibration of a session without a later write is returned unchanged.

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
    """Return the provenance `where` of a result; fail if the result has none.

    Raises
    ------
    UsageError
        The result was made from readings, not from a session.
    """
    if where is None:
        raise UsageError("this result was made from readings: fit or trace a session to get a calibration")
    return where


def assumed_parameters(
    model: Measurement, names: Sequence[str], *, nominal: bool = False
) -> tuple[str, ...]:
    """Return the names of the model's parameters that are not in `names` and keep their nominal values.

    `names` are the parameters that the session determines. `nominal` allows each other parameter to be
    nominal, which is not enough to compute an angle.

    Raises
    ------
    FitError
        An undetermined parameter is needed to compute an angle, and `nominal` is False.
    """
    missing = [name for name in names_of(model) if name not in names]
    needed = [name for name in missing if not name.startswith(("bias", "alpha", "scale_y"))]
    if needed and not nominal:
        raise FitError(f"the session does not determine {', '.join(needed)}: record more positions")
    return tuple(missing)
