"""Judgement of a trace against the truth of its blind session.

Right names
    A set of claimed names is right where it is the truth's, or where it holds no more names and leaves less
    than `TELLABLE` of the noncentrality of what was put in: then this session cannot tell the two apart
    (angle between the projected spans, in units of the noise). A name that stands under `confounded`
    counts as found where one of its fellows is such an equivalent.
Wrong names
    A claimed name is wrong unless it was put in, is the leading part of the same cause, or could stand in
    for one of the terms that were put in to within `TELLABLE` with the other terms beside it.
Zero
    Every part has one. A `bias` that is claimed is neither right nor wrong, and is left out of the claims.
Covariate
    The one that drives the term, or one that is a one-to-one function of it in this session (rank
    correlation of at least 0.98: time and order; angle and time in one turn in order).
Held-out error
    As FORMATS.md: reading minus model at the attitude that suits the dwell best within the fixture's
    tolerance, rms over `check` dwells. The oracle fits base, zeros and true columns, shapes known, to the
    other dwells by the same weighted least squares.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from tracing import space
from tracing.blind import Blind
from tracing.lens import TELLABLE, Lens
from tracing.named_truth import NAMES, Term
from tracing.plans import G_MG, Floats

ZERO = "bias"
"""Name of the effect that every part has."""
_ALIASES = (
    ("previous", r"prev|memory"),
    ("temperature", r"temp"),
    ("supply", r"supply|volt"),
    ("approach", r"approach|direction"),
    ("order", r"order|dwell|number"),
    ("time", r"time|^t$"),
    ("reading", r"reading|magnitude|accel|ideal|^a(_?[xy])?$"),
    ("angle", r"angle|theta|θ|psi|ψ|attitude|stage"),
)


def covariate(word: str) -> str:
    """The covariate that a report's word means."""
    return next((name for name, pattern in _ALIASES if re.search(pattern, word.lower())), word)


@dataclass(frozen=True)
class Verdict:
    """What a trace said of a session, judged.

    Attributes
    ----------
    claimed : tuple of str
        Names under `found`, one an entry.
    found : bool
        Every term of the catalogue is among them, or an equivalent of it.
    exact : bool
        Found, and nothing else said (no other name; unnamed only where something nameless was put in).
    wrong : tuple of str
        Names that are wrong.
    unnamed, covariate, form : bool
        Something unnamed reported; with the right covariate; by its form.
    heldout_ratio : float
        Held-out error after, over the oracle's on the same dwells; NaN without check dwells.
    worse, oracle_worse : float
        Held-out error after, and the oracle's, over the error with the zero alone (without it if `trace`
        does not begin with the zero).
    covered : tuple of (str, bool, float)
        For an effect found by its own name: parameter, whether the truth lies within its 95 % interval, and
        the error in standard uncertainties.
    axes_right : bool or None
        Axes of a single effect as put in, where it was found by name.
    """

    truth: tuple[str, ...]
    kind: str
    adequate: bool
    claimed: tuple[str, ...]
    strict: bool
    found: bool
    exact: bool
    wrong: tuple[str, ...]
    unnamed: bool
    said: str
    covariate: bool
    form: bool
    heldout_ratio: float
    fold_ratio: float
    worse: float
    oracle_worse: float
    covered: tuple[tuple[str, bool, float], ...]
    axes_right: bool | None
    confounded: bool
    seconds: float = 0.0
    failure: str = ""


def failed(blind: Blind, failure: str, seconds: float) -> Verdict:
    """Verdict on a tracer that raised: wrong in every respect."""
    return Verdict(
        truth=tuple(term.name for term in blind.terms),
        kind=blind.kind,
        adequate=False,
        claimed=("failure",),
        strict=False,
        found=False,
        exact=False,
        wrong=("failure",),
        unnamed=False,
        said="",
        covariate=False,
        form=False,
        heldout_ratio=np.nan,
        fold_ratio=np.nan,
        worse=np.inf,
        oracle_worse=np.nan,
        covered=(),
        axes_right=None,
        confounded=False,
        seconds=seconds,
        failure=failure,
    )


def judge(blind: Blind, result: Mapping[str, Any], seconds: float = 0.0) -> Verdict:
    """Judge the JSON of `trace` of one session."""
    spatial = isinstance(blind.bench, space.SpaceBench)
    lens = space.SpaceLens(blind.bench) if spatial else Lens(blind.bench)
    claimed = tuple(entry["effect"] for entry in result["found"] if entry["effect"] != ZERO)
    unnamed = result["unnamed"] or _lasting_slip(result)
    nameless = blind.terms[:1] if blind.undeclared else ()
    named = blind.terms[len(nameless) :]
    groups = [tuple(group) for group in result["confounded"]]
    found = all(_present(term, blind, lens, claimed, groups) for term in named)
    wrong = tuple(name for name in claimed if not innocent(name, blind, lens))
    if not blind.undeclared:
        told_apart = {name for group in groups if blind.names & set(group) for name in group}
        honest = found and len(blind.terms) == 1 and set(claimed) <= told_apart
        exact = (is_right_set(blind, lens, claimed) or honest) and unnamed is None
    else:
        exact = found and not wrong and unnamed is not None
    said = [] if unnamed is None else [covariate(word) for word in unnamed["covariates"]]
    form = "" if unnamed is None else str(unnamed["form"])
    before, after = error_before(result), result["error"]["after"]["heldout_rms_mg"]
    oracle, by_folds = space.oracle_rms(blind) if spatial else oracle_rms(blind, lens)
    ratio = after / oracle if after is not None else np.nan
    alone = len(named) == 1 and not nameless and set(claimed) == blind.names
    if spatial and blind.names & {"outlier_dwell"}:
        alone = False  # only the norm of one reading is seen: its three offsets are one number
    return Verdict(
        truth=tuple(term.name for term in blind.terms),
        kind=blind.kind,
        adequate=bool(result["adequate"]),
        claimed=claimed,
        strict=set(claimed) == blind.names and len(claimed) == len(blind.names),
        found=found,
        exact=exact,
        wrong=wrong,
        unnamed=unnamed is not None,
        said="" if unnamed is None else f"{'+'.join(said)}: {form}",
        covariate=bool(nameless) and drives(nameless[0], said, lens),
        form=bool(nameless) and re.search(nameless[0].form, form, re.IGNORECASE) is not None,
        heldout_ratio=np.nan if by_folds else ratio,
        fold_ratio=ratio if by_folds else np.nan,
        worse=after / before if before and after is not None else 1.0,
        oracle_worse=oracle / before if before else np.nan,
        covered=_coverage(named[0], result) if alone else (),
        axes_right=_axes_right(named[0], result) if alone else None,
        confounded=any(blind.names & set(group) for group in groups),
        seconds=seconds,
    )


def error_before(result: Mapping[str, Any]) -> float | None:
    """Held-out error in mg with the zero alone; without it if `trace` does not begin with the zero."""
    first = [step for step in result.get("steps", [])[:1] if step["effect"] == ZERO]
    error: Mapping[str, Any] = [*first, result["error"]["before"]][0]
    return error["heldout_rms_mg"]


def _present(
    term: Term, blind: Blind, lens: Lens, claimed: tuple[str, ...], groups: Sequence[tuple[str, ...]]
) -> bool:
    """Whether a term was found: by name, by an equivalent's, or as confounded with a true equivalent."""
    if term.name in claimed:
        return True
    beside = [lens.columns(other) for other in blind.terms if other is not term]
    target = lens.contribution(term)
    rivals = {name for group in groups if term.name in group for name in group}
    names = (set(claimed) | rivals) & set(NAMES) - {term.name}
    return any(_explains(lens, target, [name], beside) for name in names)


def _explains(lens: Lens, target: Floats, names: list[str], beside: list[Floats]) -> bool:
    return lens.unexplained_by_names(target, names, beside) < TELLABLE


def is_right_set(blind: Blind, lens: Lens, claimed: tuple[str, ...]) -> bool:
    """Whether the claimed names are those put in, or no more names that explain as much."""
    if len(claimed) > len(blind.terms):
        return False
    if set(claimed) == blind.names:
        return True
    if not set(claimed) <= set(NAMES) or not claimed:
        return False
    total = np.sum([lens.contribution(term) for term in blind.terms], axis=0)
    return _explains(lens, total, list(claimed), [])


def innocent(name: str, blind: Blind, lens: Lens) -> bool:
    """Whether a name was put in, or could stand for what was; see *Wrong names*."""
    if name in blind.names or any(name in term.leading for term in blind.terms):
        return True
    if name not in NAMES:
        return False
    for term in blind.terms:
        beside = [lens.columns(other) for other in blind.terms if other is not term]
        if _explains(lens, lens.contribution(term), [name], beside):
            return True
    return False


def _lasting_slip(result: Mapping[str, Any]) -> dict[str, Any] | None:
    """A part that stands elsewhere from a position on is a step of the true angle in time."""
    for one in result.get("positions", []):
        if one["finding"] == "slipped":
            form = f"true angle follows a step before position {one['position']}"
            return {"covariates": ["time"], "form": form}
    return None


def drives(term: Term, said: list[str], lens: Lens) -> bool:
    """Whether the covariates that were reported are those that drive the term, and no others."""
    if not said:
        return False
    either = len(term.covariates) == 1 and "|" in term.covariates[0]
    drivers = term.covariates[0].split("|") if either else term.covariates
    missed = [true for true in drivers if not any(_same(word, true, lens) for word in said)]
    known = (*drivers, *term.also)
    foreign = [word for word in said if not any(_same(word, true, lens) for true in known)]
    return not foreign and (either or not missed)


def _same(word: str, true: str, lens: Lens) -> bool:
    if word == true or {word, true} == {"time", "order"} or (true, word) == ("reading", "angle"):
        return True  # in a plane a reading is a function of the angle, not the reverse
    rows = lens.rows
    values = {
        "time": rows.time_s,
        "order": rows.time_s,
        "angle": rows.angle_rad,
        "temperature": rows.temperature_c,
        "supply": rows.supply_v,
        "previous": rows.previous_rad,
    }
    if word not in values or true not in values or np.ptp(values[word]) == 0 or np.ptp(values[true]) == 0:
        return False
    return bool(abs(spearmanr(values[word], values[true]).statistic) >= 0.98)


def _entry(name: str, result: Mapping[str, Any]) -> Mapping[str, Any]:
    return next(entry for entry in result["found"] if entry["effect"] == name)


def _coverage(term: Term, result: Mapping[str, Any]) -> tuple[tuple[str, bool, float], ...]:
    said = _entry(term.name, result)["parameters"]
    truth = dict(zip(term.reported, term.coefficients, strict=True)) | term.shapes
    scores = []
    for name, entry in said.items():
        if entry.get("u"):
            score = (entry["value"] - truth.get(name, 0.0)) / entry["u"]
            scores.append((name, bool(abs(score) <= 1.959964), float(score)))
    return tuple(scores)


def _axes_right(term: Term, result: Mapping[str, Any]) -> bool | None:
    if term.attitude:
        return None
    axes = {label.rsplit("_", 1)[1][0] for label in term.reported}
    return set(_entry(term.name, result)["axes"]) == axes


def oracle_rms(blind: Blind, lens: Lens | None = None) -> tuple[float, bool]:
    """Held-out rms in mg of the fit that knows the true form, and whether it is by folds (no check dwells).

    Folds leave out one dwell each.
    """
    check = blind.bench.check
    if check.any():
        return _heldout(blind, ~check, check), False
    squares = []
    for k in range(len(check)):
        out = np.arange(len(check)) == k
        squares.append(_heldout(blind, ~out, out) ** 2)
    return float(np.sqrt(np.mean(squares))), True


def _heldout(blind: Blind, fit: np.ndarray, out: np.ndarray) -> float:
    bench, rows = blind.bench, blind.bench.dwells
    sizes = [len(term.coefficients) for term in blind.terms]
    truth = np.concatenate(
        [[bench.alpha], bench.gains, [bench.dphi], bench.zero_mg, *(t.coefficients for t in blind.terms)]
    )
    cuts = np.cumsum([6, *sizes])[:-1]

    def psi_of(values: Floats, ideal: Floats) -> Floats:
        psi = values[0] - rows.angle_rad
        for term, part in zip(blind.terms, np.split(values, cuts)[1:], strict=True):
            if term.attitude:
                psi = psi + np.deg2rad(np.tensordot(part, term.basis(rows, ideal), axes=1))
        return psi

    def model(values: Floats) -> Floats:
        gains, dphi = values[1:3], values[3]
        rough = bench.ideal_mg(values[0] - rows.angle_rad)
        psi = psi_of(values, rough)
        ideal = G_MG * gains * np.stack([np.cos(psi), np.sin(psi + dphi)], axis=-1)
        total = ideal + values[4:6]
        for term, part in zip(blind.terms, np.split(values, cuts)[1:], strict=True):
            if not term.attitude:
                total += np.tensordot(part, term.basis(rows, ideal), axes=1)
        return total

    slope = bench.slope_mg(bench.alpha - rows.angle_rad)
    noise = np.diag(bench.u_mg**2)
    cover = np.deg2rad(bench.fixture_deg) ** 2 * np.einsum("ni,nj->nij", slope, slope) + noise
    white = np.linalg.inv(np.linalg.cholesky(cover))

    values = truth.copy()
    step = 1e-4 * np.concatenate([np.full(4, 1e-2), np.maximum(np.abs(truth[4:]), 1e-9)])
    for _ in range(2):  # the truth is near: Gauss and Newton settle at once
        here = model(values)
        jacobian = np.stack(
            [
                (model(values + np.eye(len(values))[k] * step[k]) - here) / step[k]
                for k in range(len(values))
            ]
        )
        left = np.einsum("nij,nj->ni", white, blind.readings_mg - here)[fit].ravel()
        slanted = np.einsum("nij,knj->kni", white, jacobian)[:, fit].reshape(len(values), -1)
        size = np.linalg.norm(slanted, axis=1)
        seen = size > 1e-9 * size.max()  # a dwell's own term cannot be seen where that dwell is left out
        unit = slanted[seen] / size[seen, None]
        values = np.where(seen, values, 0.0)
        values[seen] += np.linalg.lstsq(unit.T, left, rcond=1e-10)[0] / size[seen]
    left = (blind.readings_mg - model(values))[out]
    return float(np.sqrt(np.mean(best_attitude(left, slope[out], cover[out], bench.fixture_deg) ** 2)))


def best_attitude(left_mg: Floats, slope: Floats, cover: Floats, fixture_deg: float) -> Floats:
    """Residuals (n, 2) at the angle that suits each dwell best within the fixture's tolerance."""
    turn = np.deg2rad(fixture_deg) ** 2 * np.einsum(
        "ni,ni->n", slope, np.linalg.solve(cover, left_mg[..., None])[..., 0]
    )
    return left_mg - turn[:, None] * slope
