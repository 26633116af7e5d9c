"""The oracle: knows noise, surroundings and the list of true candidates; what is possible at best.

It weighs all models of up to two causes: every name of the catalogue in every way in which it can act,
and, where the session hides something else, that cause's true form. Evidence is ½·2Δ ln L − ½ k ln(rows).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from .answers import empty
from .catalogue import NAMES, WITHIN, Term, terms
from .circumstances import Floats
from .generator import Truth, bias_gain, planted_from, scatter_rows
from .likelihood import Linear, Whitened, base_parameters, scatter_gain

PRIOR = {"nothing": 0.4, "one": 0.4, "two": 0.2}
CLAIM = 0.95
"""A cause is claimed from this probability of something on."""

_FIRST = 25
"""Terms, best first, of which one belongs to every pair that is weighed."""


class Weighing:
    """Posterior over models of up to two terms, for a linearised session."""

    def __init__(self, linear: Linear, candidates: list[Term], scatter: Floats | None = None) -> None:
        self.linear, self.terms = linear, candidates
        self.white = Whitened(linear)
        self.columns = [linear.columns(t) for t in candidates]
        rows = int(linear.fit.sum())
        names = sorted({t.name for t in candidates})
        ways = {n: sum(t.name == n for t in candidates) for n in names}
        count = len(names) + (scatter is not None)
        z = [self.white.project(self.white.white(x)) for x in self.columns]
        starts = np.cumsum([0, *(x.shape[1] for x in z)])
        wide = np.hstack(z) if z else np.zeros((rows, 0))
        size = np.linalg.norm(wide, axis=0)
        wide = wide / np.where(size > 1e-9, size, np.inf)
        gram, score = wide.T @ wide, wide.T @ self.white.left

        index = [np.arange(starts[m], starts[m + 1]) for m in range(len(candidates))]

        def gains(models: list[tuple[int, ...]]) -> list[tuple[float, int]]:
            """2Δ ln L and rank of models, those of as many columns at once."""
            columns = [np.concatenate([index[m] for m in members]) for members in models]
            out: list[tuple[float, int]] = [(0.0, 0)] * len(models)
            for width in {len(x) for x in columns}:
                which = [k for k, x in enumerate(columns) if len(x) == width]
                at = np.array([columns[k] for k in which])
                d, v = np.linalg.eigh(gram[at[:, :, None], at[:, None, :]])
                keep = d > 1e-6
                along = np.einsum("kij,ki->kj", v, score[at]) ** 2 / np.where(keep, d, np.inf)
                for k, g, rank in zip(which, along.sum(axis=1), keep.sum(axis=1), strict=True):
                    out[k] = float(g), int(rank)
            return out

        self.models: list[tuple[int, ...]] = [()]
        logs = [np.log(PRIOR["nothing"])]
        singles = []
        alone = gains([(m,) for m in range(len(candidates))])
        for m, (t, (g, k)) in enumerate(zip(candidates, alone, strict=True)):
            if k == 0:
                continue
            self.models.append((m,))
            logs.append(np.log(PRIOR["one"] / count / ways[t.name]) + (g - k * np.log(rows)) / 2)
            singles.append((logs[-1], m))
        if scatter is not None:
            d, w2 = self.white.scatter(scatter)
            best, size = max((scatter_gain(d, w2, s), s) for s in np.geomspace(0.05, 20, 61))
            self.scattered: Whitened = Whitened(
                replace(linear, covariance=linear.covariance + size * scatter)
            )
            self.models.append((-1,))
            logs.append(np.log(PRIOR["one"] / count) + (best - np.log(rows)) / 2)
        first = {m for _, m in sorted(singles, reverse=True)[:_FIRST]}
        pairs = max(count * (count - 1) / 2, 1)
        both = [
            (one, two)
            for one, two in combinations([m for _, m in singles], 2)
            if candidates[one].name != candidates[two].name and (one in first or two in first)
        ]
        for (one, two), (g, k) in zip(both, gains(both), strict=True):
            prior = PRIOR["two"] / pairs / ways[candidates[one].name] / ways[candidates[two].name]
            self.models.append((one, two))
            logs.append(np.log(prior) + (g - k * np.log(rows)) / 2)
        weight = np.exp(np.array(logs) - max(logs))
        self.weight = weight / weight.sum()

    def name(self, m: int) -> str:
        """Name of a term."""
        return "scatter" if m < 0 else self.terms[m].name

    @property
    def something(self) -> float:
        """Probability that there is anything beside base model and bias."""
        return float(1 - self.weight[0])

    def causes(self) -> list[dict[str, Any]]:
        """Credible set of 95 % of each cause of the most likely names.

        Two causes where that there are two is as sure as a claim must be.
        """
        by_names: dict[frozenset[str], float] = {}
        for model, w in zip(self.models, self.weight, strict=True):
            key = frozenset(self.name(m) for m in model)
            by_names[key] = by_names.get(key, 0) + w
        two = sum(w for key, w in by_names.items() if len(key) == 2)
        count = 2 if two >= CLAIM else 1
        best = max(
            (key for key in by_names if len(key) == count),
            key=lambda key: by_names[key],
            default=frozenset(),
        )
        out = []
        for name in sorted(best):
            rest = best - {name}
            slot = {
                next(iter(key - rest)): w
                for key, w in by_names.items()
                if len(key) == len(best) and key > rest
            }
            total = sum(slot.values())
            names, shares = [], []
            for other, w in sorted(slot.items(), key=lambda item: -item[1]):
                names.append(other)
                shares.append(min(float(w / total), 1.0))
                if sum(shares) >= 0.95:
                    break
            out.append({"names": names, "probability": shares, "parameters": self._parameters(names[0])})
        return sorted(out, key=lambda cause: -cause["probability"][0])

    def _parameters(self, name: str) -> dict[str, dict[str, float]]:
        """Amplitudes of a name in the best model that holds it."""
        holding = [
            (w, model)
            for model, w in zip(self.models, self.weight, strict=True)
            if name in map(self.name, model)
        ]
        _, model = max(holding)
        if -1 in model:
            return {}
        values, covariance = self.white.solve(np.hstack([self.columns[m] for m in model]))
        at = len(self.linear.values)
        out = {}
        for m in model:
            for parameter in self.terms[m].parameters:
                if self.name(m) == name:
                    out[parameter] = {"value": float(values[at]), "u": float(np.sqrt(covariance[at, at]))}
                at += 1
        return out

    def averaged(self) -> tuple[Floats, Floats, Floats]:
        """Base values, their covariance and the residual of all rows, averaged over the models."""
        order = np.argsort(-self.weight)
        order = order[: int(np.searchsorted(np.cumsum(self.weight[order]), 0.995)) + 1][:60]
        share = self.weight[order] / self.weight[order].sum()
        p = len(self.linear.values)
        means, covariances, left = [], [], []
        for k in order:
            members = [m for m in self.models[k] if m >= 0]
            empty_columns = np.zeros((len(self.linear.e), 0))
            columns = np.hstack([empty_columns, *(self.columns[m] for m in members)])
            white = self.scattered if self.models[k] == (-1,) else self.white
            values, covariance = white.solve(columns)
            means.append(values[:p])
            covariances.append(covariance[:p, :p])
            left.append(self.linear.e - np.hstack([self.linear.base, columns]) @ values)
        mean = share @ np.array(means)
        spread = np.array(means) - mean
        covariance = np.einsum("k,kij->ij", share, np.array(covariances)) + (spread.T * share) @ spread
        return self.linear.values + mean, covariance, share @ np.array(left)


def heldout_rms(linear: Linear, residual: Floats, fixture_rad: float) -> float:
    """Rms of the check dwells' residual (rows,), each at the attitude within tolerance that fits best."""
    c = linear.c
    checks = np.flatnonzero(c.check)
    if not c.plane:
        return float(np.sqrt(np.mean(residual[checks] ** 2)))
    left = []
    noise = linear.covariance - fixture_rad**2 * linear.tangent @ linear.tangent.T
    for k in checks:
        rows = [k, k + c.n]
        e, t = residual[rows], linear.tangent[rows, k]
        whole = noise[np.ix_(rows, rows)] + fixture_rad**2 * np.outer(t, t)
        left.append(e - t * (fixture_rad**2 * t @ np.linalg.solve(whole, e)))
    return float(np.sqrt(np.mean(np.square(left))))


def weigh(truth: Truth) -> Weighing:
    """The oracle's posterior of a session."""
    linear = truth.problem()
    candidates = [t for name in NAMES for t in terms(name, linear.c, linear.ideal_g)]
    scatter = None
    if truth.family in ("foreign", "stranger", "scatter"):
        planted = planted_from(truth.planted[0])
        if truth.scatter:
            scatter = scatter_rows(linear, planted)
        else:
            candidates.append(
                Term("stranger", "stranger", ("size",), planted.reading[:, :, None], planted.angle[:, None])
            )
    return Weighing(linear, candidates, scatter)


def answer(truth: Truth) -> dict[str, Any]:
    """The oracle's answer, with `heldout` as {"heldout_rms_mg"}."""
    weighing = weigh(truth)
    out = empty() | {"something": min(max(weighing.something, 0.0), 1.0)}
    causes = weighing.causes() if out["something"] >= CLAIM else []
    if truth.family in ("bias", "recording") or truth.kind in WITHIN:
        causes = _told(truth, weighing)
        out["something"] = causes[0]["probability"][0] if causes else 0.0
    for cause in causes:
        if cause["names"][0] == "stranger":
            out["covariates"] = [group[0] for group in truth.covariates]
        elif cause["names"][0] == "scatter":
            out["causes"].append(cause | {"names": ["reading_scatter", *cause["names"][1:]]})
        else:
            out["causes"].append(cause)
    values, covariance, residual = weighing.averaged()
    out["base"] = base_parameters(weighing.linear.names, values, covariance)
    if weighing.linear.c.check.any():
        rms = heldout_rms(weighing.linear, residual, np.radians(truth.fixture_deg))
        out["heldout"] = {"heldout_rms_mg": rms}
    return out


def _told(truth: Truth, weighing: Weighing) -> list[dict[str, Any]]:
    """Causes that stand apart from the catalogue's columns: told from their gain alone."""
    k, rows = (
        (weighing.linear.c.axes, int(weighing.linear.fit.sum())) if truth.family == "bias" else (1, 1000)
    )
    gain = bias_gain(weighing.linear) if truth.family == "bias" else truth.gain[0]
    share = float(1 / (1 + np.exp(-np.clip((gain - k * np.log(rows)) / 2, -50, 50))))
    names = ["bias"] if truth.family == "bias" else truth.names
    return [{"names": names, "probability": [share], "parameters": {}}] if share >= CLAIM else []
