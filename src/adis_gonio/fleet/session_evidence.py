"""The evidence of one session for every effect: a quadratic form of the log likelihood, a few kB.

With readings whitened by the session's own noise, and the base model and bias projected out, let X be the
columns of all candidates and r the residual of the readings. Then

    ln L(a) − ln L(0) = aᵀ Xᵀr − ½ aᵀ XᵀX a

for amplitudes a in their units. The score Xᵀr and the information XᵀX are all that a population trace needs
of a session.

An effect of the catalogue has one column for each amplitude, axis by axis. Time constants are on one grid
in seconds for all sessions, since a part's τ does not depend on the length of a session. Unnamed functions
(cosines of the time, harmonics of gravity's direction in the sensor, dependence on the previous position)
have columns too, so that a cause that the catalogue lacks is not given the nearest name. Bias and base
parameters have no columns, since every session has its own. Effects of one dwell have no columns either,
since dwell 7 of one session is not dwell 7 of another.
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.estimation.terms import ROUNDING, NamedTerm, join_columns
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, catalogue
from adis_gonio.model.measurement import PlanarTurn
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of
from adis_gonio.tracing.linear_problem import reduced
from adis_gonio.tracing.named_candidates import cycles_shown
from adis_gonio.tracing.session_blocks import project_off_base

TAUS_S = tuple(float(f"{tau:.3g}") for tau in np.geomspace(10.0, 3160.0, 11))
"""Time constants in s for which a session gives evidence, a quarter of a decade apart.

A course with a time constant between two of them loses less than 1 % of its sum of squares.
"""
MOST_CYCLES = 12
"""Largest number of cycles per turn for which a session gives evidence on a periodic error of the stage."""
HARMONICS = (2, 3, 4, 5, 6)
"""Harmonics of the angle of gravity in the sensor's X-Y plane that describe an unnamed error."""
COURSES = 4
"""Number of cosines over the length of a session that describe an unnamed course in time."""


@dataclass(frozen=True)
class Column:
    """An amplitude of a possible effect, for or against which a session gives evidence.

    Its key is a unique text of the fields, such as `warm_up|tau=316|x|warm_up_x|mg` or `~time|2|x|2_x|mg`
    (an unnamed function).

    Attributes
    ----------
    cause : str
        Name of the effect in the catalogue, or the quantity that an unnamed function depends on.
    named : bool
        True if the catalogue has the cause; False for an unnamed function.
    variant : str
        Form of the effect (not the type of the sensor): its degree, cycles per turn or time constant in s,
        such as `degree=2`, `cycles=5`, `tau=316`; for an unnamed cause the number of the function.
    axes : str
        Axis on which the cause acts; empty for an effect of the stage, which acts on no single axis.
    parameter, unit : str
        Name of the amplitude in the catalogue, and its unit.
    """

    cause: str
    named: bool
    variant: str
    axes: str
    parameter: str
    unit: str

    @property
    def weight(self) -> float:
        """Expected size of the amplitude relative to the first amplitude of its cause.

        It is 1, except for an unnamed function of time, a sum of cosines: in a random walk the amplitude of
        cosine k is proportional to 1/k.
        """
        return 1.0 if self.named or self.cause != "time" else 1 / int(self.parameter.split("_")[0])

    @classmethod
    def of(cls, key: str) -> Column:
        """Make the column from its key; `ValueError` for any other text."""
        cause, variant, axes, parameter, unit = key.split("|")
        return cls(cause.removeprefix("~"), not cause.startswith("~"), variant, axes, parameter, unit)


def columns_of(fit: Fit) -> tuple[list[str], Floats, dict[str, str]]:
    """List the amplitudes of all effects that may act in a session, with their columns.

    Returns
    -------
    keys : list of str
        Keys of the m amplitudes (`Column`).
    change : (n, axes, m) float
        Change of the readings of the fit's session by each amplitude.
    missing : dict of str to str
        Reason for each effect that has no columns.
    """
    data, missing = fit.data, {}
    keys: list[str] = []
    blocks: list[tuple[int | slice, Floats]] = []
    for name, kind in catalogue("accelerometer").items():
        reason = _reason_left_out(kind, data)
        if reason:
            missing[name] = reason
            continue
        for variant, one, shapes in _variants(kind, data):
            term = NamedTerm("", kind.covariates, 0.0, one, shapes)
            # The lower powers of a polynomial have their own columns.
            first = len(term.amplitudes) - 1 if "degree" in kind.choices() else 0
            blocks.append((slice(None), fit.candidate(term)[:, :, first:]))
            axes, parameters = "".join(one.axes), [one.parameters[k] for k in term.amplitudes[first:]]
            keys += [f"{name}|{variant}|{axes}|{q.name}|{q.unit}" for q in parameters]
    ideal_g = data.model.stimulus(fit.ideal, data.conditions)
    for cause, variant, rows in _functions(data.conditions, ideal_g if data.planar else None):
        for axis, letter in enumerate(AXES[: data.axes]):
            gain = variant == "gain"
            blocks.append((axis, rows * ideal_g[:, axis, None] if gain else rows))
            count, unit = rows.shape[1], "mg/g" if gain else "mg"
            keys += [f"~{cause}|{variant}|{letter}|{j}_{letter}|{unit}" for j in range(1, count + 1)]
    return keys, join_columns(blocks, data.mean.shape), missing


def _reason_left_out(kind: type[Effect], data: Readings) -> str:
    """Return the reason why the evidence of a session cannot contain an effect; empty if it can."""
    if kind.prior == "constant":
        return "every session has its own"
    if kind.enters is Enters.SAMPLES or kind.within_dwell:
        return "it acts among the samples of a dwell"
    if "dwell" in kind.choices():
        return "an effect of one dwell belongs to one session"
    lacking = data.conditions.lacks(kind.needs)
    if lacking:
        return f"{', '.join(lacking)} not recorded"
    if kind.enters is Enters.ATTITUDE and not data.planar:
        return "attitudes are free"
    return ""


def _variants(
    kind: type[Effect], data: Readings
) -> Iterator[tuple[str, Effect, tuple[tuple[int, float], ...]]]:
    options: list[dict[str, int]] = [{}]
    if "degree" in kind.choices():
        options = [{"degree": k} for k in (1, 2, 3)]
    elif "cycles" in kind.choices():
        shown = cycles_shown(data.conditions.covariate("angle_rad"), MOST_CYCLES)
        options = [{"cycles": k} for k in shown]
    for axes in [(letter,) for letter in AXES[: data.axes]] if kind.by_axis else [()]:
        for option in options:
            effect = kind(axes, **option)
            variant = ",".join(f"{key}={value}" for key, value in option.items())
            shaped = [(k, p) for k, p in enumerate(effect.parameters) if p.shape]
            if len(shaped) == 1 and shaped[0][1].unit == "s":
                for tau in TAUS_S:
                    yield f"tau={tau:g}", effect, ((shaped[0][0], tau),)
            else:
                yield variant, effect, tuple((k, p.typical) for k, p in shaped)


def _functions(conditions: Conditions, ideal_g: Floats | None) -> Iterator[tuple[str, str, Floats]]:
    """Yield each unnamed function: the quantity that it depends on, its variant, and its values (n, q).

    The variant is `course` for a change of the bias, `gain` for a change of the gain, or the number of a
    harmonic. `ideal_g` (n, axes) are the readings of an ideal sensor in one plane; None in space.
    """
    time = conditions.time_s
    x = (time - time.min()) / max(float(np.ptp(time)), 1e-9)
    waves = np.cos(np.pi * x[:, None] * np.arange(1, COURSES + 1))
    yield "time", "course", waves
    yield "time", "gain", waves[:, :2]
    for name, rows, scale in (
        ("temperature", conditions.temperature_c, 10.0),
        ("supply", conditions.supply_v, 0.1),
    ):
        if rows is not None and np.ptp(rows) > 0:
            # A linear dependence is an effect of the catalogue.
            square = ((rows - rows.mean()) / scale)[:, None] ** 2
            yield name, "course", square
            yield name, "gain", square
    previous = conditions.previous_angle_rad
    if previous is not None and np.isfinite(previous).all():
        pair = np.stack([np.cos(previous), np.sin(previous)], axis=1)
        yield "previous angle", "course", np.where(np.abs(pair).max(axis=0) > ROUNDING, pair, 0.0)
    if ideal_g is not None:
        psi = np.arctan2(ideal_g[:, 1], ideal_g[:, 0])  # direction of gravity in the plane of X and Y
        for n in HARMONICS:
            yield "angle", f"{n}", np.stack([np.cos(n * psi), np.sin(n * psi)], axis=1)


_STEP = 2.0**-15
"""Resolution of the stored directions: 3·10⁻⁵ of the length of a unit vector."""


class ResidualChi2(NamedTuple):
    """χ² of a residual in one direction, along or across the turn, and the degrees of freedom of the χ²."""

    chi2: float
    dof: float


@dataclass(frozen=True)
class SessionEvidence:
    """Evidence of one session on the amplitudes of all possible effects.

    Attributes
    ----------
    keys : tuple of str
        Keys of the m columns (amplitudes) that this session determines, see `Column`.
    z : (m,) float
        Score of each column divided by its standard deviation: N(0, 1) if the effect is absent.
    length : (m,) float
        1/u of each amplitude if it is estimated alone, in 1/unit of the amplitude.
    directions : (k, m) float
        Unit vector of each column; the scalar product of two of them is the correlation of their scores.
    scatter : tuple of ResidualChi2
        χ² of the residual after base model and bias, along the turn and across it; one entry if attitudes
        are free.
    noise_known : bool
        False if the noise is estimated from the residual alone.
    missing : mapping of str to str
        Effects without columns, with the reason.
    digest, source, serial, operator, stage, sensor : str
        Digest of the session's data, its file, and serial number, operator, stage and sensor type; empty if
        unknown.
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

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document of the evidence.

        The directions are base64 of 16-bit integers (k, m) in steps of 2⁻¹⁵.
        """
        packed = np.clip(np.round(self.directions / _STEP), -32767, 32767).astype("<i2")
        return {
            **vars(self),
            "z": [float(f"{z:.5g}") for z in self.z],
            "length": [float(f"{x:.6g}") for x in self.length],
            "directions": base64.b64encode(packed.tobytes()).decode("ascii"),
            "scatter": [[float(f"{x:.6g}") for x in part] for part in self.scatter],
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> SessionEvidence:
        """Restore the evidence from the document of `as_dict`."""
        keys = tuple(document["keys"])
        packed = np.frombuffer(base64.b64decode(document["directions"]), dtype="<i2")
        restored = {
            "keys": keys,
            "z": np.array(document["z"], dtype=float),
            "length": np.array(document["length"], dtype=float),
            "directions": _unit(packed.reshape(len(packed) // max(len(keys), 1), len(keys)) * _STEP),
            "scatter": tuple(ResidualChi2(*part) for part in document["scatter"]),
        }
        return cls(**{**document, **restored})


def evidence_of(session: Session) -> SessionEvidence:
    """Compute the evidence of a session by one fit of base model and bias; takes milliseconds.

    Raises
    ------
    DataError, FitError
        The session has no readings to fit, or the fit fails.
    """
    data = readings_of(session).training
    bias = NamedTerm.offset(AXES[: data.axes])
    fit = Fit.begin(data).with_terms((bias,), (np.zeros(data.axes),)).refit()
    # The bias is projected out, as is the base model.
    base, target = reduced(fit, [bias])
    rest = fit.residual.ravel()
    rest = rest - base @ (base.T @ rest)

    made, change, missing = columns_of(fit)
    columns, length = project_off_base(base, fit.white(change), np.ones(len(made), dtype=np.intp))
    # Columns that lie in the projected space are not determined.
    seen = np.asarray(columns.any(axis=0))
    unit = columns[:, seen]
    # Shorter columns with equal scalar products: XᵀX = V S² Vᵀ, so the rows S Vᵀ have the products.
    _, s, vt = np.linalg.svd(unit, full_matrices=False)
    kept = s > 1e-5 * (s[0] if s.size else 1.0)
    keys = tuple(itertools.compress(made, seen))
    causes, shown = ({key.split("|")[0] for key in some} for some in (made, keys))
    hidden = [cause for cause in causes - shown if not cause.startswith("~")]
    origin = provenance_of(session)
    return SessionEvidence(
        keys=keys,
        z=unit.T @ target,
        length=length[seen],
        directions=_unit(s[kept, None] * vt[kept]),
        scatter=_scatter(fit, rest, base),
        noise_known=data.noise_known,
        missing=missing | dict.fromkeys(hidden, "lies in the base model and bias"),
        digest=origin.sha256,
        **{name: getattr(origin, name) for name in ("source", "serial", "operator", "stage", "sensor")},
    )


def _unit(directions: Floats) -> Floats:
    return np.asarray(directions / np.maximum(np.linalg.norm(directions, axis=0), 1e-12))


def _scatter(fit: Fit, rest: Floats, base: Floats) -> tuple[ResidualChi2, ...]:
    """Return χ² of the residual in two directions of the plane of x and y, with the degrees of freedom.

    The first direction is the one in which the readings move if the attitude changes a little. There the
    residual contains errors of the stage. The second direction is perpendicular to it.

    `rest` is the whitened residual, `base` the whitened columns of base model and bias, which reduce the
    degrees of freedom. A session with free attitudes has one entry. `fit` is the
    fit of the session.
    """
    data = fit.data
    rows = rest.reshape(len(data), -1)
    base_rows = base.reshape(len(data), -1, base.shape[1])
    if rows.shape[1] != 2 or not isinstance(data.model, PlanarTurn):
        return (ResidualChi2(float((rows**2).sum()), max(fit.equations - base.shape[1], 0.0)),)
    # Unit vectors along the turn in the whitened readings, and across it.
    along = (data.own_root @ fit.tangent)[:, :, 0]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return tuple(
        ResidualChi2(
            float(((rows * way).sum(axis=1) ** 2).sum()),
            len(data) - float((np.einsum("nr,nrk->nk", way, base_rows) ** 2).sum()),
        )
        for way in (along, across)
    )
