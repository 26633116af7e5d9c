"""What a fit returns."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.model.provenance import Provenance
from adis_gonio.model.records import Floats

if TYPE_CHECKING:
    from adis_gonio.calibration import Calibration


@dataclass(frozen=True)
class Estimate:
    """A parameter: value, standard uncertainty (None where nothing states the noise), unit.

    The uncertainty is such that value ± 1.96 u covers 95 %: where it rests on few degrees of freedom it is
    enlarged by Student's quantile over 1.96.
    """

    name: str
    value: float
    u: float | None
    unit: str


@dataclass(frozen=True)
class FitResult:
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
    provenance: Provenance | None = field(default=None, repr=False, compare=False)

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

    def calibration(self) -> Calibration:
        """What turns readings into angles by these parameters.

        Raises
        ------
        UsageError
            The result was made from readings, not from a session.
        FitError
            The session does not determine what an angle needs.
        """
        from adis_gonio.calibration.building import calibration_of_fit

        return calibration_of_fit(self)

    def as_dict(self) -> dict[str, Any]:
        """JSON document of `fit`."""
        names = [e.name for e in self.parameters] if self.covariance is not None else []
        matrix = [] if self.covariance is None else self.covariance.tolist()
        angle = None
        if self.angle_error_rad is not None and self.angle_error_rad.size:
            degrees = np.degrees(self.angle_error_rad)
            angle = {
                "rms": float(np.sqrt(np.mean(degrees**2))),
                "max": float(np.abs(degrees).max()),
            }
        sigma = self.fixture_sigma_deg
        return {
            "method": self.method,
            "parameters": {e.name: {"value": e.value, "u": e.u, "unit": e.unit} for e in self.parameters},
            "covariance": {"names": names, "matrix": matrix},
            "chi2": self.chi2,
            "dof": self.dof,
            "residual_rms_mg": self.residual_rms_mg,
            "angle_error_deg": angle,
            "warnings": list(self.warnings),
            "undetermined": list(self.undetermined),
            "extra_reading_u_mg": self.extra_mg,
            "fixture_sigma_deg": "free" if sigma is not None and math.isinf(sigma) else sigma,
            "positions_used": len(self.positions),
        }
