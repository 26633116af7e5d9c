"""`adis-gonio trace --json`, as anybody can call it, brought into the challenge's answer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..answers import empty

INADEQUATE = 0.99
"""Probability of something where the trace says that no model explains the residual."""


def answer(directory: Path) -> dict[str, Any]:
    """Trace the session of a directory."""
    import adis_gonio

    return from_trace(adis_gonio.trace(adis_gonio.load_session(directory / "session.csv")).as_dict())


def from_trace(trace: dict[str, Any]) -> dict[str, Any]:
    """The answer that the JSON of `trace` gives.

    A cause's set is that of `sets`; where the document has none, its name, then its `equivalents` and
    the fellows in `confounded`, which get the rest of its probability in equal parts.
    """
    out = empty()
    for found in trace["found"]:
        name, share = found["effect"], _probability(found)
        names, probability = _set(trace, name, share)
        parameters = {
            key: {"value": p["value"], "u": p["u"]}
            for key, p in found["parameters"].items()
            if p.get("u") is not None and math.isfinite(p["u"]) and isinstance(p["value"], int | float)
        }
        out["causes"].append({"names": names, "probability": probability, "parameters": parameters})
        if name == "bias":
            out["base"].update(parameters)
    if trace["unnamed"]:
        out["covariates"] = list(trace["unnamed"]["covariates"])
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


def _set(trace: dict[str, Any], name: str, share: float) -> tuple[list[str], list[float]]:
    for group in trace.get("sets", []):
        if group["names"] and name in group["names"]:
            return list(group["names"]), [min(max(float(p), 0.0), 1.0) for p in group["probability"]]
    others: list[str] = []
    for found in trace["found"]:
        if found["effect"] == name:
            others += [part for text in found.get("equivalents", []) for part in text.split(" + ")]
    for group in trace["confounded"]:
        if name in group:
            others += group
    fellows = [n for n in dict.fromkeys(others) if n not in (name, "bias") and n.replace("_", "").isalpha()]
    rest = (1 - share) / len(fellows) if fellows else 0.0
    return [name, *fellows], [share, *(min(rest, share) for _ in fellows)]


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
