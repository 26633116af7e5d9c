"""`adis-gonio trace --json`, as anybody can call it, brought into the challenge's answer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..answers import empty

NAMELESS = "unnamed: "
"""How `sets` marks a function without a name, before its covariates."""
WITHIN = ("tone", "settling", "noise_change", "saturation", "quantization")
SCATTER = ("reading_scatter", "fixture_scatter")
INADEQUATE = 0.99
"""Probability of something where the trace says that no model explains the residual."""


def answer(directory: Path) -> dict[str, Any]:
    """Trace the session of a directory."""
    import adis_gonio

    return from_trace(adis_gonio.trace(adis_gonio.load_session(directory / "session.csv")).as_dict())


def from_trace(trace: dict[str, Any]) -> dict[str, Any]:
    """The answer that the JSON of `trace` gives.

    A cause's set is that of `sets`. Where functions without a name have most of its probability it is a
    covariate.
    """
    out = empty()
    found_by = {found["effect"]: found for found in trace["found"]}
    for group in trace.get("sets", []):
        pairs = list(zip(group["names"], group["probability"], strict=True))
        if "bias" in group["names"]:  # nearly every session has one: a cause that may be it is the bias
            out["base"].update(_values(found_by.get("bias")))
            share = group["probability"][group["names"].index("bias")]
            out["causes"].append({"names": ["bias"], "probability": [share], "parameters": {}})
            continue
        names = [(name, p) for name, p in pairs if not name.startswith(NAMELESS)]
        if sum(p for _, p in names) < 0.5:
            first = next(name for name, _ in pairs if name.startswith(NAMELESS))
            out["covariates"] += first.removeprefix(NAMELESS).split(" and ")
            continue
        cause = {"names": [name for name, _ in names], "probability": [p for _, p in names]}
        out["causes"].append(cause | {"parameters": _values(found_by.get(group["names"][0]))})
    alone = [f for f in trace["found"] if f["effect"] in (*WITHIN, *SCATTER)]
    for found in alone:  # within the dwells, and variances: no set of names is weighed for these
        cause = {"names": [found["effect"]], "probability": [_probability(found)]}
        out["causes"].append(cause | {"parameters": _values(found)})
    if trace["unnamed"]:
        out["covariates"] = list(dict.fromkeys([*out["covariates"], *trace["unnamed"]["covariates"]]))
    out["something"] = _something(trace)
    base = {k: v for k, v in trace.get("base", {}).items() if isinstance(v.get("u"), int | float)}
    for key in ("delta_k", "delta_phi"):
        if key in base:
            out["base"][key] = {"value": base[key]["value"], "u": base[key]["u"]}
    if "delta_k" not in base and "delta_phi" in base and {"scale_x", "scale_y"} <= set(base):
        x, y = base["scale_x"], base["scale_y"]
        ratio = x["value"] / y["value"]
        u = ratio * math.hypot(x["u"] / x["value"], y["u"] / y["value"])
        out["base"]["delta_k"] = {"value": ratio - 1, "u": u}
    out["notes"] = {
        "adequate": trace.get("adequate"),
        "chi2_per_dof": trace["error"]["after"].get("chi2_per_dof"),
        "confounded": trace["confounded"],
        "unnamed": trace["unnamed"],
        "rivals": trace.get("rivals", [])[:4],
        "reasons": trace.get("reasons", {}),
    }
    rms = trace["error"]["after"]["heldout_rms_mg"]
    out["heldout"] = {} if rms is None else {"heldout_rms_mg": rms}
    return out


def _probability(finding: dict[str, Any]) -> float:
    """Probability of a finding; where it states none (effects within the dwells), one less its p-value."""
    share = finding.get("probability")
    if share is None:
        share = 1 - (finding.get("p_value") or 0.0)
    return min(max(float(share), 0.0), 1.0)


def _something(trace: dict[str, Any]) -> float:
    """Probability of anything beside the bias: of the rivals named and of what was claimed.

    A trace that says that its model is not adequate says that there is something, at `INADEQUATE`.
    """
    claimed = [_probability(f) for f in trace["found"] if f["effect"] != "bias"]
    claimed += [_probability(trace["unnamed"])] if trace["unnamed"] else []
    rivals = trace.get("rivals", [])
    total = sum(r["probability"] for r in rivals)
    if total > 0:
        other = sum(
            r["probability"]
            for r in rivals
            if not all(t.startswith("bias[") and "~" not in t for t in r["terms"])
        )
        claimed.append(other / total)
    if trace.get("adequate") is False:
        claimed.append(INADEQUATE)
    return min(max(claimed, default=0.0), 1.0)


def _values(found: dict[str, Any] | None) -> dict[str, Any]:
    """Values of a finding that have an uncertainty."""
    parameters = {} if found is None else found["parameters"]
    return {
        key: {"value": p["value"], "u": p["u"]}
        for key, p in parameters.items()
        if p.get("u") is not None and math.isfinite(p["u"]) and isinstance(p["value"], int | float)
    }
