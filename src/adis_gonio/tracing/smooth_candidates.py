"""Smooth candidates: Gaussian processes in covariates, for a residual that follows no formula.

A Gaussian process with kernel k is a linear term with one column for each feature of its kernel, φ(u)·φ(u′)
= k(u, u′), and a normal prior on the amplitudes (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, sections 2.1 and 5.4). The evidence chooses the length scale and the amplitude of the
process, so it bends only as much as the readings require. Outside the range of the readings it returns to a
straight line, while a polynomial diverges.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm, Where
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.tracing.named_candidates import choices_of_axes
from adis_gonio.tracing.thresholds import limits

LENGTHS = (0.1, 0.18, 0.32, 0.56, 1.0)
"""Correlation lengths ℓ of a kernel that are tried, in units of the covariate's range."""
RING = (0.25, 0.4, 0.65, 1.0)
"""Widths w of the periodic kernel exp(−2 sin²(Δ/2)/w²) that are tried."""
AMPLITUDES = (2.0, 4.0, 8.0, 16.0)
"""Prior standard deviations of a process that are tried, in standard uncertainties of a reading."""

_HARMONICS = 16
_BEYOND = 0.1
"""Fraction of its fitted range by which a covariate counts beyond this range; it is clipped there."""

Get = Callable[[Conditions], Floats]


def processes(data: Readings) -> list[NamelessTerm]:
    """Return all Gaussian processes to try in a session, as candidates for an unnamed function.

    There is one for each place in the model, covariate, length and amplitude. Its basis functions are the
    kernel's features, and its attribute `prior_sd` is the amplitude of the process.
    """
    reading_u = float(np.sqrt(data.variance_of_mean.mean()))
    subsets = choices_of_axes(range(data.axes))
    made: list[NamelessTerm] = []
    for basis, placed in _bases(data):
        for where in placed:
            if where == "angle" and not data.planar:
                continue
            for axes in [()] if where == "angle" else subsets:
                term = NamelessTerm("", basis.covariates, 0.0, where, axes, basis)
                made.append(replace(term, stimulus=data.model.stimulus))
    members = Counter(term.covariates for term in made)
    weight = {c: limits.pair_weight if len(c) > 1 or c == ("previous_angle",) else 1.0 for c in members}
    total = sum(weight.values())
    out = []
    for term, amplitude in itertools.product(made, AMPLITUDES):
        share = (
            limits.nameless_share
            * weight[term.covariates]
            / total
            / members[term.covariates]
            / len(AMPLITUDES)
        )
        label = f"{term.where}[{''.join('xyz'[k] for k in term.axes)}]~{term.basis.form} ({amplitude:g} u)"
        out.append(replace(term, prior_sd=amplitude * reading_u, cost=-math.log(share), label=label))
    return out


def evidence(
    fit: Fit,
    beside: Floats,
    target: Floats,
    candidates: Sequence[NamelessTerm],
    inflation: float = 1.0,
) -> Floats:
    """Return for each of m processes its log evidence plus the log of its prior probability, (m,) in nats.

    `candidates` are the processes, each a possible unnamed function.

    Parameters
    ----------
    fit : Fit
        Fit about which the processes are linear.
    beside : (rows, k) float
        Orthonormal whitened columns of the other terms of the model; their amplitudes have flat priors.
    target : (rows,) float
        Whitened readings minus their projection on `beside`.
    inflation : float
        Factor on the measured noise variance.
    """
    scores = np.zeros(len(candidates))
    spectra: dict[tuple[int, Where, tuple[int, ...]], tuple[Floats, Floats]] = {}
    for k, term in enumerate(candidates):
        key = (id(term.basis), term.where, term.axes)
        if key not in spectra:
            # Processes that differ in amplitude only share the spectrum of their whitened features.
            white = fit.white(fit.candidate(term))
            white = white - beside @ (beside.T @ white)
            values, vectors = np.linalg.eigh(white.T @ white)
            spectra[key] = np.maximum(values, 0.0), (vectors.T @ (white.T @ target)) ** 2
        values, scores2 = spectra[key]
        assert term.prior_sd is not None
        # ½ Σ (s²/(1 + s²λ) · score² − ln(1 + s²λ)) over the eigenvalues λ.
        prior = term.prior_sd**2 / inflation
        grown = 1 + prior * values
        scores[k] = 0.5 * float((prior * scores2 / inflation / grown - np.log(grown)).sum()) - term.cost
    return scores


def _bases(data: Readings) -> Iterator[tuple[Basis, tuple[Where, ...]]]:
    """Yield basis functions for every kernel, each with the places in the model that they may enter."""
    c = data.conditions
    scalars, rings = _lines_and_rings(c, data.model.driven_by)
    for name, get in scalars.items():
        for length in LENGTHS:
            basis = Basis(f"a smooth function of {name}", (name,), _line(get, get(c), length))
            yield basis, ("bias", "gain", "misalignment", "angle")
    for name, get in rings.items():
        for width in RING:
            basis = Basis(f"a smooth function of {name.replace('_', ' ')}", (name,), _ring(get, width))
            yield basis, ("bias", "angle")
    for length in LENGTHS[1:] if "reading" in data.model.driven_by else ():
        form = "a smooth function of the reading"
        yield Basis(form, ("reading",), by_axis=_of_reading(length)), ("bias",)
    slow = [item for item in scalars.items() if not item[0].startswith("force")]
    for (one, f), (two, g) in itertools.combinations(slow, 2):
        for length in LENGTHS[2::2]:
            both = _product(_line(f, f(c), length), _line(g, g(c), length))
            form = f"a smooth function of {one} and {two}"
            yield Basis(form, (one, two), both), ("bias", "gain", "angle")


def _lines_and_rings(c: Conditions, driven_by: Sequence[str]) -> tuple[dict[str, Get], dict[str, Get]]:
    """Return two groups of covariates by name: covariates on a line, and covariates that are angles.

    `driven_by` are the covariates that drive the measurement, such as the force for gyros.
    """
    lines: dict[str, Get] = {"time": lambda k: k.time_s}
    if "force" in driven_by and c.force_g is not None:
        lines |= {f"force_{letter}": _component(axis) for axis, letter in enumerate(AXES)}
    fields = {"temperature": "temperature_c", "supply": "supply_v", "line_frequency": "line_hz"}
    lines |= {name: _recorded(own) for name, own in fields.items() if getattr(c, own) is not None}
    fields = {"angle": "angle_rad", "previous_angle": "previous_angle_rad"}
    rings = {name: _recorded(own) for name, own in fields.items() if getattr(c, own) is not None}
    return {name: get for name, get in lines.items() if np.ptp(get(c)) > 0}, rings


def _recorded(name: str) -> Get:
    return lambda k: k.covariate(name)


def _component(axis: int) -> Get:
    return lambda k: k.covariate("force_g")[:, axis]


def _inducing(low: float, high: float, length: float) -> Callable[[Floats], Floats]:
    """Return a function of values (n,) that gives basis functions (n, k) for the kernel exp(−½ Δ²/ℓ²).

    ℓ is `length`. Nyström's method uses k points, at most 0.6 ℓ apart, from `low` to `high`.
    """
    points = np.linspace(low, high, max(int(np.ceil((high - low) / (0.6 * length))) + 1, 4))

    def kernel(u: Floats) -> Floats:
        return np.asarray(np.exp(-0.5 * ((u[:, None] - points) / length) ** 2))

    # Features K(u, points) L⁻ᵀ with K(points, points) = L Lᵀ reproduce the kernel.
    root = np.linalg.cholesky(kernel(points) + 1e-6 * np.eye(len(points)))
    return lambda u: np.asarray(np.linalg.solve(root, kernel(u).T).T)


def _line(get: Get, seen: Floats, length: float) -> Get:
    """Return basis functions (n, k) for a constant, a line and the kernel exp(−½ Δ²/ℓ²) of a covariate.

    `get` returns the covariate, `seen` are its values in the fitted dwells, ℓ is `length` in units of their
    range. The covariate is clipped shortly beyond this range.
    """
    low, size = float(seen.min()), float(np.ptp(seen))
    curve = _inducing(-_BEYOND, 1 + _BEYOND, length)

    def features(conditions: Conditions) -> Floats:
        u = np.clip((get(conditions) - low) / size, -_BEYOND, 1 + _BEYOND)
        return np.column_stack([np.ones(len(u)), 2 * u - 1, curve(u)])

    return features


def _product(one: Get, two: Get) -> Get:
    """Return the basis functions of the product of two kernels, from the basis functions of each kernel."""

    def features(conditions: Conditions) -> Floats:
        left, right = one(conditions), two(conditions)
        return (left[:, :, None] * right[:, None, :]).reshape(len(left), -1)

    return features


def _ring(get: Get, width: float) -> Get:
    """Return basis functions (n, k) for the periodic kernel exp(−2 sin²(Δ/2)/w²) of an angle.

    Its Fourier coefficients are modified Bessel functions I_k(1/w²). `get` returns the angle in rad, w is
    `width`.
    """
    order = np.arange(_HARMONICS + 1)
    weight = special.ive(order, 1 / width**2) * np.where(order == 0, 1.0, 2.0)
    order, root = order[weight > 1e-4], np.sqrt(weight[weight > 1e-4])

    def features(conditions: Conditions) -> Floats:
        turned = get(conditions)[:, None] * order
        return np.concatenate([root * np.cos(turned), root[1:] * np.sin(turned[:, 1:])], axis=1)

    return features


def _of_reading(length: float) -> Callable[[Floats, int], Floats]:
    """Return basis functions (n, k) for the kernel 1 + exp(−½ Δ²/ℓ²) of each axis's own reading in g.

    ℓ is `length` times the range of the reading, 2 g.
    """
    curve = _inducing(-1.1, 1.1, 2 * length)

    def features(ideal: Floats, axis: int) -> Floats:
        return np.column_stack([np.ones(len(ideal)), curve(np.clip(ideal[:, axis], -1.1, 1.1))])

    return features
