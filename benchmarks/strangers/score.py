"""Judge what the tool says about a session, and count over many sessions."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from math import sqrt
from statistics import median
from typing import Any

import numpy as np

from .kinds import KINDS, Kind
from .session import Oracle, StrangeSession, noise_alone

CERTAIN = 0.95
ALMOST_SURE = 0.999
UNLIKELY = 1e-3
"""Probability below which noise alone does not leave a residual."""
TOO_LARGE = 1.3
SAME = {"reading": "angle"}
"""Covariates of the tool that are another word for one of the kinds."""
ALWAYS_THERE = {"bias"}
"""Effects that each session has besides its disturbance."""

Document = dict[str, Any]


@dataclass(frozen=True)
class Verdict:
    """One session in numbers; an empty entry if the tool said nothing.

    Attributes
    ----------
    index, kind, strength
        Number of the session in its run, name of its kind, size in standard deviations of a dwell.
    names, wrong
        Names found with their probability, without bias; the unfair names among them.
    covariates, covariate_probability, covariates_right
        Claimed for the unnamed cause; right if each of them truly causes the disturbance.
    adequate, residual_left, fit_residual_left
        The tool's word, and chi-square tests with the true noise: of all dwells, of the dwells of the fit.
    check_mg, promised_mg, check_deg
        Rms errors by the tool: of check dwells, of the other dwells, of the angle of check dwells.
    oracle
        Fits with and without the true shape.
    errors_in_u
        (value − truth)/U of gains and Δφ; empty if the truth is a matter of definition.
    """

    index: int
    kind: str
    strength: float
    names: dict[str, float]
    wrong: dict[str, float]
    covariates: list[str]
    covariate_probability: float
    covariates_right: bool
    adequate: bool
    residual_left: bool
    fit_residual_left: bool
    oracle_residual_left: bool
    check_mg: float
    promised_mg: float
    check_deg: float
    oracle: Oracle
    errors_in_u: dict[str, float]
    seconds: float = 0.0


def judge(
    session: StrangeSession, oracle: Oracle, document: Document, index: int = 0, seconds: float = 0
) -> Verdict:
    """Compare the JSON of `trace` with the truth."""
    found = {entry["effect"]: float(entry["probability"]) for entry in document["found"]}
    names = {name: value for name, value in found.items() if name not in ALWAYS_THERE}
    unnamed = document["unnamed"] or {"covariates": []}
    covariates = list(unnamed["covariates"])
    after = document["error"]["after"]
    check, promised = float(after["heldout_rms_mg"]), float(after["residual_rms_mg"])

    def left(check_mg: float, fit_mg: float) -> bool:
        tests = noise_alone(session.bench, True, check_mg), noise_alone(session.bench, False, fit_mg)
        return min(tests) < UNLIKELY / 2

    return Verdict(
        index=index,
        kind=session.kind.name,
        strength=session.strength,
        names=names,
        wrong={name: value for name, value in names.items() if not is_fair(session.kind, name)},
        covariates=covariates,
        covariate_probability=float(unnamed.get("probability") or 0.0),
        covariates_right=all(SAME.get(name, name) in session.kind.causes for name in covariates),
        adequate=bool(document["adequate"]),
        residual_left=left(check, promised),
        fit_residual_left=noise_alone(session.bench, False, promised) < UNLIKELY,
        oracle_residual_left=left(oracle.check_mg, oracle.fit_mg),
        check_mg=check,
        promised_mg=promised,
        check_deg=float(after["angle_rms_deg"]),
        oracle=oracle,
        errors_in_u=_errors_in_u(session, document["base"]),
        seconds=seconds,
    )


def is_fair(kind: Kind, name: str) -> bool:
    """Whether a name describes a kind fairly; a scatter is fair if it is in the right place."""
    scatter = "fixture_scatter" if kind.enters == "attitude" else "reading_scatter"
    return name in kind.fair or name == scatter


def _errors_in_u(session: StrangeSession, base: Document) -> dict[str, float]:
    """Errors of gains and Δφ in units of U, where the disturbance has no part in them by any definition."""
    kind, bench = session.kind, session.bench
    if kind.enters in ("gain", "misalignment") or "angle" in kind.causes:
        return {}
    x, y = bench.scales
    truth = {
        "scale_x": x,
        "scale_y": y,
        "delta_k": x / y - 1,
        "delta_phi": float(np.degrees(bench.misalignment_rad)),
    }
    errors = {}
    for name, value in truth.items():
        entry = base.get(name)
        if entry and entry["value"] is not None and entry.get("U"):
            errors[name] = (entry["value"] - value) / entry["U"]
    return errors


def wilson(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a rate, by Wilson."""
    if of == 0:
        return 0.0, 1.0
    z = 1.959964
    rate = count / of
    centre = (rate + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * sqrt(rate * (1 - rate) / of + z * z / (4 * of * of))
    return max(0.0, centre - half), min(1.0, centre + half)


Rate = tuple[str, Callable[[Verdict], Iterable[bool]]]


def _one(
    tells: Callable[[Verdict], bool], among: Callable[[Verdict], bool] = lambda _: True
) -> Callable[[Verdict], list[bool]]:
    return lambda verdict: [tells(verdict)] if among(verdict) else []


def _sure_names(verdict: Verdict) -> list[bool]:
    return [name not in verdict.wrong for name, value in verdict.names.items() if value >= ALMOST_SURE]


def _covered(name: str) -> Callable[[Verdict], list[bool]]:
    return lambda verdict: [abs(verdict.errors_in_u[name]) <= 1] if name in verdict.errors_in_u else []


def _surely(verdict: Verdict) -> bool:
    return verdict.covariate_probability > CERTAIN


RATES: tuple[Rate, ...] = (
    ("a wrong name is found", _one(lambda v: bool(v.wrong))),
    ("a wrong name has more than 95 %", _one(lambda v: max(v.wrong.values(), default=0) > CERTAIN)),
    (
        "a fair name is found, where there is one",
        _one(lambda v: len(v.names) > len(v.wrong), lambda v: bool(KINDS[v.kind].fair)),
    ),
    ("names at 99.9 % are fair", _sure_names),
    ("an unnamed cause is found", _one(lambda v: bool(v.covariates))),
    (
        "its covariates are right or not certain",
        _one(lambda v: v.covariates_right or not _surely(v), lambda v: bool(v.covariates)),
    ),
    ("its covariates are right", _one(lambda v: v.covariates_right, lambda v: bool(v.covariates))),
    (
        "covariates above 95 % are right",
        _one(lambda v: v.covariates_right, lambda v: bool(v.covariates) and _surely(v)),
    ),
    (
        "… in sessions that are not adequate",
        _one(lambda v: v.covariates_right, lambda v: bool(v.covariates) and _surely(v) and not v.adequate),
    ),
    ("called adequate", _one(lambda v: v.adequate)),
    ("adequate although a residual is left", _one(lambda v: v.adequate and v.residual_left)),
    ("… in the dwells of the fit", _one(lambda v: v.adequate and v.fit_residual_left)),
    ("not adequate although none is left", _one(lambda v: not v.adequate and not v.residual_left)),
    ("control: the oracle leaves a residual", _one(lambda v: v.oracle_residual_left)),
    ("fit worse than with bias alone", _one(lambda v: v.promised_mg > 1.02 * v.oracle.bias_fit_mg)),
    ("check dwells worse than with bias alone", _one(lambda v: v.check_mg > 1.02 * v.oracle.bias_check_mg)),
    (
        "check angle worse than with bias alone",
        _one(lambda v: v.check_deg > 1.02 * v.oracle.bias_check_deg),
    ),
    (
        "check error above 1.3 times the oracle's",
        _one(lambda v: v.check_mg > TOO_LARGE * v.oracle.check_mg),
    ),
    (
        "check angle above 1.3 times the oracle's",
        _one(lambda v: v.check_deg > TOO_LARGE * v.oracle.check_deg),
    ),
    ("U covers the gain of x", _covered("scale_x")),
    ("U covers the gain of y", _covered("scale_y")),
    ("U covers ΔK", _covered("delta_k")),
    ("U covers Δφ", _covered("delta_phi")),
)
"""Rates of the table: a name, and the outcomes of one session that it counts."""


def rate_table(verdicts: list[Verdict]) -> str:
    """Rates with Wilson intervals, and medians, as text."""
    lines = []
    for name, outcomes in RATES:
        every = [outcome for verdict in verdicts for outcome in outcomes(verdict)]
        count, of = sum(every), len(every)
        low, high = wilson(count, of)
        rate = f"{100 * count / of:5.1f} %" if of else "      –"
        lines.append(f"{name:46s} {count:4d} of {of:4d}  {rate}  [{100 * low:.1f}, {100 * high:.1f}]")
    if verdicts:
        above_oracle = median(v.check_mg / v.oracle.check_mg for v in verdicts)
        promised = median(v.check_mg / v.promised_mg for v in verdicts)
        by_oracle = median(v.oracle.check_mg / v.oracle.fit_mg for v in verdicts)
        lines += [
            f"median of check error / oracle's     {above_oracle:.3f}",
            f"median of check error / promised     {promised:.3f} (oracle {by_oracle:.3f})",
            f"median of seconds a session          {median(v.seconds for v in verdicts):.1f}",
        ]
    return "\n".join(lines)


def badness(verdict: Verdict) -> float:
    """Sort key of the worst sessions: sure and wrong, wrongly adequate, check dwells against bias alone."""
    sure = max([0.0, *verdict.wrong.values()])
    if verdict.covariates and not verdict.covariates_right:
        sure = max(sure, verdict.covariate_probability)
    harm = verdict.check_mg / verdict.oracle.bias_check_mg
    return (sure > CERTAIN) + (verdict.adequate and verdict.residual_left) + harm


def sentence(verdict: Verdict) -> str:
    """What happened in a session, on one line."""
    oracle = verdict.oracle
    said = ", ".join(f"{name} {value:.3f}" for name, value in verdict.names.items()) or "no name"
    if verdict.covariates:
        said += f", unnamed by {' and '.join(verdict.covariates)} {verdict.covariate_probability:.3f}"
    word = "adequate" if verdict.adequate else "not adequate"
    if verdict.residual_left:
        word += ", a residual is left"
    return (
        f"{verdict.index:4d} {verdict.kind} ({verdict.strength:.1f} sigma): {said}; {word}; "
        f"check dwells {verdict.check_mg:.3f} mg, oracle {oracle.check_mg:.3f}, "
        f"bias alone {oracle.bias_check_mg:.3f}"
    )


def verdict_record(verdict: Verdict) -> Document:
    """Verdict as a JSON object."""
    return asdict(verdict)


def verdict_of(record: Document) -> Verdict:
    """Verdict from its JSON object."""
    return Verdict(**{**record, "oracle": Oracle(**record["oracle"])})
