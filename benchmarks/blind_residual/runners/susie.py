"""Sum of single effects, a small IBSS (Wang, Sarkar, Carbonetto and Stephens 2020)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..circumstances import Floats
from .common import Prepared, tuned

EFFECTS = 4
SWEEPS = 60


def single_effect(score: Floats, prior: Floats, noise: float) -> tuple[Floats, Floats, float, float]:
    """One effect of one column of length 1.

    Parameters
    ----------
    score : (K,) float
        xᵀr.
    prior : (K,) float
        Prior weights.
    noise : float
        Variance of the noise.

    Returns
    -------
    alpha, mean : (K,) float
        Posterior weights and means given each column.
    log_bf : float
        ln Bayes factor against no effect.
    size : float
        Prior variance that maximises it.
    """
    best = (-np.inf, 0.0, prior, np.zeros_like(score))
    for size in noise * np.geomspace(2, 2000, 15):
        shrink = size / (size + noise)
        log_bf = 0.5 * np.log(1 - shrink) + 0.5 * shrink * score**2 / noise
        top = log_bf.max()
        weight = prior * np.exp(log_bf - top)
        total = top + np.log(weight.sum())
        if total > best[0]:
            best = (total, size, weight / weight.sum(), shrink * score)
    return best[2], best[3], float(best[0]), float(best[1])


def susie(x: Floats, y: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Weights (EFFECTS, K) of the single effects and their ln Bayes factors (EFFECTS,)."""
    k = x.shape[1]
    alpha, mean = np.full((EFFECTS, k), 1.0 / k), np.zeros((EFFECTS, k))
    factors = np.zeros(EFFECTS)
    noise = 1.0
    for _ in range(SWEEPS):
        before = alpha.copy()
        for j in range(EFFECTS):
            others = x @ ((alpha * mean).sum(axis=0) - alpha[j] * mean[j])
            alpha[j], mean[j], factors[j], _ = single_effect(x.T @ (y - others), prior, noise)
            if factors[j] <= 0:
                mean[j] = 0
        left = y - x @ (alpha * mean).sum(axis=0)
        noise = max(1.0, float(left @ left) / max(len(y) - EFFECTS, 1))
        if np.abs(alpha - before).max() < 1e-4:
            break
    return alpha, factors


def answer(directory: Path) -> dict[str, Any]:
    """Credible sets of names; those whose Bayes factor passes the tuned limit are claimed."""
    prepared = Prepared(directory)
    names = [f.name for f in prepared.features]
    count = {n: names.count(n) for n in names}
    prior = np.array([1 / count[n] for n in names])
    alpha, factors = susie(prepared.x, prepared.y, prior / prior.sum())
    sets, chosen = [], []
    for j in np.argsort(-factors):
        if 2 * factors[j] < tuned("susie")["gain"]:
            continue
        share: dict[str, float] = {}
        for n, a in zip(names, alpha[j], strict=True):
            share[n] = share.get(n, 0.0) + float(a)
        order = sorted(share, key=lambda n: -share[n])
        top = order[0]
        k = int(np.argmax(np.where([n == top for n in names], alpha[j], -1)))
        if k not in chosen:
            chosen.append(k)
        if top.startswith("~") or any(s["names"][0] == top for s in sets):
            continue
        kept: list[str] = []
        while sum(share[n] for n in kept) < 0.95:
            kept.append(order[len(kept)])
        sets.append({"names": kept, "probability": [min(share[n], 1.0) for n in kept]})
    out = prepared.answer(chosen, sets)
    best = float(np.max(factors)) - np.log(10)
    out["something"] = float(1 / (1 + np.exp(-np.clip(best, -50, 50))))
    return out
