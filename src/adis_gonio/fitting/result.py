"""What a fit returns."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import counted, format_uncertain
from adis_gonio.base.tables import Entries, ParameterTable
from adis_gonio.base.uncertainty import Value, factor_over
from adis_gonio.fitting.slips.position_diagnosis import listed
from adis_gonio.fitting.solvable import unsolvable
from adis_gonio.record.provenance import Provenance

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration
    from adis_gonio.fitting.determination import Determination
    from adis_gonio.fitting.estimation.fit import Fit
    from adis_gonio.fitting.estimation.readings import Readings
    from adis_gonio.fitting.estimation.shown import ShownAngle
    from adis_gonio.fitting.linked import LinkReport
    from adis_gonio.fitting.noise import NoiseAssumptions
    from adis_gonio.fitting.outputs import Output
    from adis_gonio.fitting.slips import PositionFinding
    from adis_gonio.fitting.sources import Sources
    from adis_gonio.fitting.standing import Standing
    from adis_gonio.fitting.uncertainty_budget import BudgetRow


@dataclass(frozen=True)
class Estimate:
    """A parameter: value, standard uncertainty (None: nothing tells the noise), unit, degrees of freedom.

    `u` is the GUM's standard uncertainty, `dof` its effective degrees of freedom (inf where unlimited);
    what covers 95 % is `U` = `k`·`u` with Student's quantile k.
    """

    name: str
    value: float
    u: float | None
    unit: str
    dof: float = math.inf

    @property
    def stated(self) -> Value:
        """The same without its name."""
        return Value(self.value, self.u, self.unit, self.dof)

    @property
    def k(self) -> float | None:
        """Coverage factor of 95 % at `dof`; None without an uncertainty."""
        return self.stated.k

    @property
    def U(self) -> float | None:  # noqa: N802 (GUM)
        """Expanded uncertainty, 95 %."""
        return self.stated.U


@dataclass(frozen=True)
class Origin:
    """What a fit was made of, for all that follows from it.

    Attributes
    ----------
    readings : Readings
        That were fitted, before `noise` was settled.
    fit : Fit
        At the method's own parameters, on the readings with that noise.
    outputs : tuple of Output
        Gradients of the parameters, in their order.
    sources : Sources or None
        None where nothing tells the noise of a reading.
    determination : Determination or None
        Of `ml`: what was free.
    """

    readings: Readings
    noise: NoiseAssumptions
    fit: Fit
    outputs: tuple[Output, ...]
    sources: Sources | None
    determination: Determination | None = None


MISFIT = (
    "The model does not describe this session: the residual is larger than the noise."
    " Run adis-gonio trace to find the missing effect."
)


@dataclass(frozen=True)
class FitResult(ParameterTable):
    """Parameters of a session with covariance.

    Attributes
    ----------
    method : str
        One of `METHODS`.
    parameters : tuple of Estimate
        Those that the session determines; the others are named in `undetermined`.
    covariance : (p, p) float or None
        In the order and units of `parameters`; None where no noise is known.
    chi2, dof : float, int
        Residual against the noise measured in the dwells and the stated fixture uncertainty.
    residual_mg : (n, axes) or (n, 1) float
        Reading minus model of each dwell used, in mg; in space the residual of the norm.
    positions : tuple of int
        Numbers of the dwells used.
    angle_error_rad : (m,) float or None
        Angle that the calibrated goniometer computes minus the declared one.
    undetermined : tuple of str
        Parameters, or combinations, that the session cannot determine.
    extra_mg : float
        Standard deviation per reading and axis beyond the measured noise, which the residual demanded.
    fixture_sigma_deg : float or None
        Standard uncertainty of a declared angle that was used; inf free; None in space.
    provenance : Provenance or None
        Where the readings come from; None where no session was given.
    overrides : mapping
        What was stated otherwise than in the session's file, old and new (`session.overrides`).
    origin : Origin or None
        What it was made of; no part of the JSON, nor of a comparison.
    session : Readings or None
        All readings of the session, on which methods are compared.
    session_notes : tuple of str
        What the reader of the file had to tell, and what is wrong with positions; they precede the other
        `warnings`, and `doubts` precede them.
    position_findings : tuple of PositionFinding
        Positions that are not where they were declared (`adis_gonio.fitting.slips`).
    links : LinkReport or None
        What turns between poses in space gave; None where there are none.
    """

    method: str
    parameters: tuple[Estimate, ...]
    covariance: Floats | None
    chi2: float
    dof: int
    residual_mg: Floats
    positions: tuple[int, ...]
    angle_error_rad: Floats | None = None
    warnings: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    extra_mg: float = 0.0
    fixture_sigma_deg: float | None = None
    provenance: Provenance | None = field(default=None, compare=False)
    overrides: dict[str, Any] = field(default_factory=dict)
    origin: Origin | None = field(default=None, compare=False)
    session: Readings | None = field(default=None, compare=False)
    session_notes: tuple[str, ...] = ()
    position_findings: tuple[PositionFinding, ...] = ()
    links: LinkReport | None = None

    def __getitem__(self, name: str) -> Estimate:
        """Estimate by name; `KeyError` where the session does not determine it."""
        for estimate in self.parameters:
            if estimate.name == name:
                return estimate
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return any(estimate.name == name for estimate in self.parameters)

    @property
    def residual_rms_mg(self) -> float:
        """Root mean square of the residuals in mg."""
        return float(np.sqrt(np.mean(self.residual_mg**2)))

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentence that leads everything else if the model does not describe the session; else empty."""
        return (MISFIT,) if self.extra_mg else ()

    def __repr__(self) -> str:
        lead = [one for one in self.parameters if one.name in ("delta_k", "delta_phi")] or self.parameters[
            :2
        ]
        told = ", ".join(f"{one.name} {format_uncertain(one.value, one.u, one.unit)}" for one in lead)
        return f"FitResult({self.method}, {counted(len(self.positions), 'dwell')}, {told})"

    def calibration(self) -> Calibration:
        """What turns readings into angles by these parameters.

        Raises
        ------
        UsageError
            The result was made from readings, not from a session.
        FitError
            The session does not determine what an angle needs.
        """
        from adis_gonio.fitting.calibrations import as_written, calibration_as_recorded

        return as_written(calibration_as_recorded(self))

    @property
    def reference_temperature_c(self) -> float | None:
        """Mean temperature of the dwells used, at which the parameters hold; None where not recorded."""
        if self.origin is None or self.origin.readings.conditions.temperature_c is None:
            return None
        return float(self.origin.readings.conditions.temperature_c.mean())

    @cached_property
    def standing(self) -> Standing | None:
        """Every method of the session scored on the same readings, and which is recommended."""
        from adis_gonio.fitting.standing import standing_of

        if self.session is None:
            return None
        try:
            return standing_of(self.session)
        except np.linalg.LinAlgError as error:
            source = "" if self.provenance is None else self.provenance.source
            raise unsolvable(source or "session", error) from error

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budget of `delta_k`, `delta_phi` and `angle`; empty in space or without a noise."""
        from adis_gonio.fitting.uncertainty_budget import budget_of

        made = self.origin
        if made is None or made.sources is None or not made.readings.planar:
            return {}
        found = {
            output.name: budget_of(made.sources, output.gradient[None])
            for output in made.outputs
            if output.name in ("delta_k", "delta_phi")
        }
        shown = self._around
        if shown is None:
            return found
        return {**found, "angle": budget_of(made.sources, shown.gradient, shown.reading)}

    @cached_property
    def _around(self) -> ShownAngle | None:
        """The angle shown after calibration; None where the session leaves part of it undetermined."""
        from adis_gonio.fitting.determination import is_determined
        from adis_gonio.fitting.estimation.shown import ShownAngle

        assert self.origin is not None
        shown, found = ShownAngle.around(self.origin.fit), self.origin.determination
        sure = found is None or all(is_determined(slope, found.null) for slope in shown.gradient)
        return shown if sure else None

    @cached_property
    def shown_angle(self) -> Value | None:
        """An angle shown after calibration: no value, but its uncertainty; None in space.

        That of a reading as long as the session's dwells, the root mean square over a turn; no uncertainty
        where the session leaves part of what an angle needs undetermined.
        """
        made = self.origin
        if made is None or not made.readings.planar:
            return None
        shown = self._around
        if made.sources is None or shown is None:
            return Value(math.nan, None, "deg")
        u, dof = made.sources.uncertainty(shown.gradient, shown.reading)
        variances = made.sources.by_place(shown.gradient, shown.reading)
        return Value(math.nan, u, "deg", dof, factor_over(variances, dof))

    @cached_property
    def angle(self) -> Value | None:
        """Error of the angle after calibration (rms, deg) with the uncertainty of `shown_angle`.

        The value is the root mean square over the dwells of the session, left out of the fit where they
        were in it; NaN where none is declared or can be left out.
        """
        score = None if self.standing is None else self.standing.scores.get(self.method)
        if self.shown_angle is None or score is None or score.angle_rms_deg is None:
            return self.shown_angle
        return replace(self.shown_angle, value=score.angle_rms_deg)

    def summary(self) -> str:
        """The headline in a few lines of plain text, as the command `fit` shows it."""
        from adis_gonio.fitting.answer import Answer

        return Answer.of(self).text()

    def __str__(self) -> str:
        return self.summary()

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Method, and the parameters by name."""
        return f"fit by method {self.method}", self.as_dict()["parameters"].items()

    def as_dict(self) -> dict[str, Any]:
        """JSON document of `fit`."""
        names = [e.name for e in self.parameters] if self.covariance is not None else []
        matrix = [] if self.covariance is None else self.covariance.tolist()
        errors = None
        if self.angle_error_rad is not None and self.angle_error_rad.size:
            degrees = np.degrees(self.angle_error_rad)
            errors = {"rms": np.sqrt(np.mean(degrees**2)), "max": np.abs(degrees).max()}
        sigma = self.fixture_sigma_deg
        standing = self.standing
        return json_object(
            method=self.method,
            recommended=None if standing is None else standing.recommended,
            parameters={estimate.name: estimate.stated for estimate in self.parameters},
            angle=self.angle,
            covariance={"names": names, "matrix": matrix},
            budget=self.budget,
            scores={} if standing is None else standing.scores,
            chi2=self.chi2,
            dof=self.dof,
            residual_rms_mg=self.residual_rms_mg,
            angle_error_deg=errors,
            warnings=self.warnings,
            undetermined=self.undetermined,
            extra_reading_u_mg=self.extra_mg,
            fixture_sigma_deg="free" if sigma is not None and math.isinf(sigma) else sigma,
            reference_temperature_c=self.reference_temperature_c,
            positions_used=len(self.positions),
            overrides=self.overrides,
            **listed(self.position_findings),
            **{} if self.links is None else {"links": self.links},
        )
