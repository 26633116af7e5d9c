"""Scores of answers against truths."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from .catalogue import WITHIN
from .generator import BINS, Truth

SCATTER_NAMES = frozenset({"reading_scatter", "fixture_scatter"})
CONFIDENT = 0.95
Z95 = 1.959964

Record = dict[str, Any]


def wilson(hits: float, of: int) -> tuple[float, float]:
    """95 % interval of a share, Wilson's."""
    if of == 0:
        return 0.0, 1.0
    p, z2 = hits / of, Z95**2
    middle = (p + z2 / (2 * of)) / (1 + z2 / of)
    half = Z95 / (1 + z2 / of) * math.sqrt(p * (1 - p) / of + z2 / (4 * of * of))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def gain_bin(gain: Sequence[float]) -> str:
    """Rung of the ladder of the smallest gain: `<4`, `4-10`, …, `>100`, or `-` where nothing is hidden."""
    if not gain:
        return "-"
    g = min(gain)
    if g < BINS[0][0]:
        return "<4"
    for low, high in BINS[:-1]:
        if low <= g < high:
            return f"{low:g}-{high:g}"
    return f">{BINS[-1][0]:g}"


BIN_NAMES = ("<4", *(f"{low:g}-{high:g}" for low, high in BINS[:-1]), f">{BINS[-1][0]:g}", "-")


def score(
    truth: Truth, answer: dict[str, Any], oracle: dict[str, Any] | None = None, seconds: float = 0.0
) -> Record:
    """One session's score.

    Parameters
    ----------
    truth : Truth
    answer : dict
        A checked answer (answers.py).
    oracle : dict, optional
        The oracle's answer to the same session.
    seconds : float
        Processor time of the answer.

    Returns
    -------
    dict
        `claims` names and covariates claimed beside the bias; `right_top`, `right_set` shares of the
        true names that head a set, or lie in one; `false` something claimed where nothing is hidden;
        `wrong` a name whose set holds no true name, nor one that the catalogue has had since;
        `wrong_confident` one of more than 95 %;
        `fabricated` a name or a covariate where only scatter is; `covariate` (strangers) every group of
        words hit, without a name, or the name that the catalogue has had since; …
    """
    causes = [c for c in answer["causes"] if c["names"][0] != "bias"]
    scatter_named = [c for c in causes if c["names"][0] in SCATTER_NAMES]
    named = [c for c in causes if c["names"][0] not in SCATTER_NAMES]
    words = set(answer["covariates"])
    nothing = truth.family in ("nothing", "bias")
    truths = set(truth.names)
    right_names = truths | set(truth.since)
    wrong = [
        c
        for c in causes
        if not right_names & set(c["names"]) and not (truth.scatter and c in scatter_named)
    ]
    record: Record = {
        "id": truth.id, "family": truth.family, "kind": truth.kind, "plane": truth.plane,
        "dwells": len(truth.start_s),
        "gain": truth.gain, "bin": gain_bin(truth.gain), "truth": sorted(right_names),
        "claims": [c["names"] for c in causes], "tops": [c["names"][0] for c in named],
        "covariates": sorted(words), "something": answer["something"], "seconds": seconds,
        "confident": [c["probability"][0] for c in causes], "notes": answer["notes"],
    }  # fmt: skip
    hidden = "nothing" not in truth.family
    record["hidden"] = hidden and truth.family != "bias"
    record["false"] = nothing and bool(causes or words)
    record["wrong"] = bool(wrong)
    record["wrong_names"] = [c["names"][0] for c in wrong]
    record["wrong_confident"] = any(c["probability"][0] > CONFIDENT for c in wrong)
    if truths:
        tops = {c["names"][0] for c in causes}
        sets = [set(c["names"]) for c in causes]
        record["right_top"] = len(truths & tops) / len(truths)
        record["right_set"] = sum(any(t in s for s in sets) for t in truths) / len(truths)
        record["exact"] = record["right_set"] == 1 and not wrong
        holding = [len(c["names"]) for c in causes if truths & set(c["names"])]
        record["set_size"] = float(np.mean(holding)) if holding else None
    if truth.family == "bias":
        record["right_top"] = record["right_set"] = float(
            any("bias" in c["names"] for c in answer["causes"])
        )
    if truth.scatter:
        allowed = {word for group in truth.covariates for word in group}
        record["fabricated"] = bool(named or words - allowed)
        record["scatter_named"] = bool(scatter_named)
    elif truth.covariates:
        named_since = bool(causes) and not wrong
        hit = [bool(words & set(group)) for group in truth.covariates]
        record["covariate"] = named_since or (not causes and all(hit))
        record["covariate_some"] = named_since or any(hit)
    record["detected"] = bool(causes or words) if record["hidden"] else None
    record["base_z"] = {
        key: (answer["base"][key]["value"] - value) / max(answer["base"][key]["u"], 1e-300)
        for key, value in truth.base.items()
        if key in answer["base"]
    }
    right = [c for c in causes if truths & {c["names"][0]}]
    record["amplitude_z"] = {
        key: (pair["value"] - truth.parameters[key]) / max(pair["u"], 1e-300)
        for c in right
        for key, pair in c["parameters"].items()
        if key in truth.parameters and truth.kind not in WITHIN
    }
    record["heldout_mg"] = answer["heldout"].get("heldout_rms_mg")
    if oracle is not None:
        base = oracle["heldout"].get("heldout_rms_mg")
        if base and record["heldout_mg"] is not None:
            record["heldout_ratio"] = record["heldout_mg"] / base
        size = [len(c["names"]) for c in oracle["causes"] if truths & set(c["names"])]
        record["oracle_set_size"] = float(np.mean(size)) if size else None
        record["oracle_right_set"] = bool(truths) and all(
            any(t in c["names"] for c in oracle["causes"]) for t in truths
        )
    return record


def brier(pairs: Iterable[tuple[float, bool]]) -> float:
    """Mean square of probability minus outcome."""
    values = [(p - bool(y)) ** 2 for p, y in pairs]
    return float(np.mean(values)) if values else math.nan


def log_score(pairs: Iterable[tuple[float, bool]]) -> float:
    """Mean −ln of the probability that was given to what happened, no less than 10⁻⁶ of it."""
    values = [-math.log(max(p if y else 1 - p, 1e-6)) for p, y in pairs]
    return float(np.mean(values)) if values else math.nan


def reliability(
    pairs: Iterable[tuple[float, bool]], edges: Sequence[float] = (0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0)
) -> list[tuple[str, int, float, float]]:
    """Rows of (range, number, mean probability, share that was so)."""
    pairs = list(pairs)
    rows = []
    for low, high in pairwise(edges):
        inside = [(p, y) for p, y in pairs if low <= p < high or (high == edges[-1] and p == high)]
        if inside:
            p, y = np.array(inside, dtype=float).T
            rows.append((f"{low:g}-{high:g}", len(inside), float(p.mean()), float(y.mean())))
    return rows


def name_pairs(records: Iterable[Record]) -> list[tuple[float, bool]]:
    """Probability of each leading name against whether it is a true one."""
    return [
        (p, names[0] in r["truth"])
        for r in records
        for p, names in zip(r["confident"], r["claims"], strict=True)
        if names[0] not in SCATTER_NAMES
    ]


def coverage(zs: Iterable[float]) -> tuple[int, int, float]:
    """Number within 1.96 u, number, and rms of z."""
    z = np.array(list(zs))
    return int(np.sum(np.abs(z) <= Z95)), len(z), float(np.sqrt(np.mean(z**2))) if len(z) else math.nan


def share(records: Iterable[Record], key: str | Callable[[Record], Any]) -> tuple[float, int]:
    """Sum of a field and number of the records that have it."""
    get = key if callable(key) else lambda r: r.get(key)
    values = [float(v) for r in records if (v := get(r)) is not None]
    return sum(values), len(values)
