"""What one session knows of every effect: a quadratic form of its log likelihood, a few kB.

With readings whitened by the session's own noise, and the base model, bias and effects of single dwells
projected out, let X be the columns of all candidates and r what is left of the readings. Then

    ln L(a) − ln L(0) = aᵀ Xᵀr − ½ aᵀ XᵀX a

for amplitudes a in their units: score Xᵀr and information XᵀX are all that a population needs of a session.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.fleet.population.columns import NUISANCE, columns_of
from adis_gonio.model.effects import AXES, effect
from adis_gonio.model.measurement import PlanarTurn
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of
from adis_gonio.tracing.linear_problem import orthonormal
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import TraceResult

FORMAT = "adis-gonio population evidence 1"
_STEP = 2.0**-15
"""Step in which directions of columns are kept: 3·10⁻⁵ of a column."""


@dataclass(frozen=True)
class ResidualChi2:
    """χ² of the residual and its degrees of freedom, of one direction of the readings."""

    chi2: float
    dof: float


@dataclass(frozen=True)
class SessionEvidence:
    """Evidence of one session.

    Attributes
    ----------
    keys : tuple of str
        Columns that this session can see (`columns.Column.key`), m of them.
    z : (m,) float
        Score of each in its standard uncertainty: N(0, 1) where the effect is absent.
    length : (m,) float
        1/u of each amplitude alone, in 1/unit.
    directions : (k, m) float
        Unit vectors: products of two columns are the correlations of their scores.
    scatter : tuple of ResidualChi2
        Of the residual beside base and bias, along the turn and across it; one where attitudes are free.
    noise_known : bool
        False where nothing states the uncertainty, so that the residual alone does.
    missing : mapping of str to str
        Effects that cannot be asked for, with the reason.
    digest, source, serial, operator, stage, sensor : str
        Of the session, as in `Provenance`.
    """

    keys: tuple[str, ...]
    z: Floats
    length: Floats
    directions: Floats
    scatter: tuple[ResidualChi2, ...]
    noise_known: bool
    missing: Mapping[str, str] = field(default_factory=dict)
    digest: str = ""
    source: str = ""
    serial: str = ""
    operator: str = ""
    stage: str = ""
    sensor: str = ""

    def estimate(self, key: str) -> tuple[float, float]:
        """Amplitude by least squares with this column alone, and its standard uncertainty, in its unit.

        `KeyError` where the session cannot see the column.
        """
        if key not in self.keys:
            raise KeyError(key)
        k = self.keys.index(key)
        return float(self.z[k] / self.length[k]), float(1 / self.length[k])

    def as_dict(self) -> dict[str, Any]:
        """JSON; directions as base64 of 16-bit integers (k, m), in steps of 2⁻¹⁵."""
        packed = np.clip(np.round(self.directions / _STEP), -32767, 32767).astype("<i2")
        return {
            "format": FORMAT,
            "keys": list(self.keys),
            "z": [float(f"{z:.5g}") for z in self.z],
            "length": [float(f"{x:.6g}") for x in self.length],
            "rank": len(self.directions),
            "directions": base64.b64encode(packed.tobytes()).decode("ascii"),
            "scatter": [[float(f"{s.chi2:.6g}"), float(f"{s.dof:.6g}")] for s in self.scatter],
            "noise_known": self.noise_known,
            "missing": dict(self.missing),
            **{name: getattr(self, name) for name in _TEXTS},
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> SessionEvidence:
        """The evidence of a document.

        Raises
        ------
        DataError
            It is no evidence of this version, or damaged.
        """
        if document.get("format") != FORMAT:
            raise DataError(f"no evidence of a session: its format is {document.get('format')!r}")
        try:
            keys = tuple(str(key) for key in document["keys"])
            packed = np.frombuffer(base64.b64decode(document["directions"]), dtype="<i2")
            made = cls(
                keys=keys,
                z=np.array(document["z"], dtype=float),
                length=np.array(document["length"], dtype=float),
                directions=_unit(packed.reshape(int(document["rank"]), len(keys)) * _STEP),
                scatter=tuple(ResidualChi2(float(chi2), float(dof)) for chi2, dof in document["scatter"]),
                noise_known=bool(document["noise_known"]),
                missing=dict(document["missing"]),
                **{name: str(document[name]) for name in _TEXTS},
            )
        except (KeyError, ValueError, TypeError) as error:
            raise DataError(
                f"damaged evidence of {document.get('source') or 'a session'}: {error}"
            ) from error
        if len(made.z) != len(keys) or len(made.length) != len(keys):
            raise DataError(
                f"damaged evidence of {made.source or 'a session'}: scores and columns differ in number"
            )
        return made


_TEXTS = ("digest", "source", "serial", "operator", "stage", "sensor")


def evidence_of(session: Session, result: TraceResult | None = None) -> SessionEvidence:
    """Evidence of a session: one fit of base model and bias, and its columns; milliseconds.

    Parameters
    ----------
    session : Session
    result : TraceResult, optional
        Its trace, where it was traced: dwells that slipped or stand out are then taken out, scatter is part
        of the noise, and effects that it found are evidence at their size.

    Raises
    ------
    DataError, FitError
        As `adis_gonio.fitting.estimation.readings_of` and the fit.
    """
    fit = _begun(readings_of(session).training) if result is None or not result.fits else result.fits[-1]
    origin = provenance_of(session)
    return _of_fit(
        fit,
        digest=origin.sha256,
        source=origin.source,
        serial=origin.serial,
        operator=origin.operator,
        stage=origin.stage,
        sensor=origin.sensor,
    )


def _begun(data: Readings) -> Fit:
    """Base model and bias."""
    bias = _bias(data)
    return Fit.begin(data).with_terms((bias,), (np.zeros(data.axes),)).refit()


def _bias(data: Readings) -> NamedTerm:
    return NamedTerm("bias", (), 0.0, effect("bias", AXES[: data.axes]))


def _of_fit(fit: Fit, **origin: Any) -> SessionEvidence:
    data = fit.data
    asked, missing = columns_of(data)
    left = fit.declared_misfit
    own: list[Term] = [_bias(data)]
    for k, term in enumerate(fit.terms):
        left = left + fit.added(k)
        if term.name in NUISANCE[1:]:
            own.append(term)
    beside = [fit.white(fit.base_columns), *(fit.white(fit.candidate(term)) for term in own)]
    base = orthonormal(np.concatenate(beside, axis=1))
    target = fit.white(left[:, :, None])[:, 0]
    target = target - base @ (base.T @ target)
    # χ² of the model as it is fitted: a large effect that a trace has found is no scatter.
    rest = fit.residual.ravel()
    rest = rest - base @ (base.T @ rest)

    columns = fit.white(np.concatenate([fit.candidate(term) for term, _ in asked], axis=2))
    keys = [column.key for _, made in asked for column in made]
    before = np.linalg.norm(columns, axis=0)
    columns = columns - base @ (base.T @ columns)
    length = np.linalg.norm(columns, axis=0)
    seen = np.isfinite(length) & (length**2 > limits.independent * before**2) & (length > 0)
    unit = columns[:, seen] / length[seen]
    for name in {key.split("|")[0] for key in keys} - {
        key.split("|")[0] for key, there in zip(keys, seen, strict=True) if there
    }:
        if not name.startswith("~"):
            missing[name] = "lies in the base model and bias"
    return SessionEvidence(
        keys=tuple(key for key, there in zip(keys, seen, strict=True) if there),
        z=unit.T @ target,
        length=length[seen],
        directions=_reduced(unit),
        scatter=_scatter(fit, rest, base),
        noise_known=data.noise_known,
        missing=missing,
        **origin,
    )


def _unit(directions: Floats) -> Floats:
    return np.asarray(directions / np.maximum(np.linalg.norm(directions, axis=0), 1e-12))


def _reduced(unit: Floats) -> Floats:
    """The same products of columns (rows, m) with as few rows (k, m) as there are directions."""
    _, s, vt = np.linalg.svd(unit, full_matrices=False)
    kept = s > 1e-5 * (s[0] if s.size else 1.0)
    return _unit(s[kept, None] * vt[kept])


def _scatter(fit: Fit, rest: Floats, base: Floats) -> tuple[ResidualChi2, ...]:
    """χ² along the turn and across it, with the degrees of freedom that the nuisance parameters leave."""
    data = fit.data
    rows = rest.reshape(len(data), -1)
    held = base.reshape(len(data), -1, base.shape[1])
    if rows.shape[1] != 2 or not isinstance(data.model, PlanarTurn):
        return (ResidualChi2(float((rows**2).sum()), max(fit.equations - base.shape[1], 0.0)),)
    along = (data.own_root @ fit.tangent)[:, :, 0]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return tuple(
        ResidualChi2(
            float(((rows * way).sum(axis=1) ** 2).sum()),
            len(data) - float((np.einsum("nr,nrk->nk", way, held) ** 2).sum()),
        )
        for way in (along, across)
    )
