"""The leaderboard in Markdown."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from . import scoring
from .harness import ChallengeError, records
from .runners import SEES_CHECK_READINGS
from .scoring import Record

HIDDEN = ("catalogue", "two", "within", "foreign", "stranger", "scatter", "recording")


def write(truths: Path, answered: Path, names: list[str], output: Path, lines: Path | None = None) -> None:
    """Score entrants and write their tables; the oracle's answers must be there.

    Parameters
    ----------
    truths, answered : Path
        Directories of truths and of answers.
    names : list of str
        Entrants.
    output : Path
        Markdown.
    lines : Path, optional
        One JSON line a session and entrant.
    """
    by_oracle = answered / "oracle.jsonl"
    if not by_oracle.exists():
        raise ChallengeError(f"{by_oracle}: no such file; run the oracle first")
    found = {}
    for name in names:
        if not (answered / f"{name}.jsonl").exists():
            raise ChallengeError(f"{answered / name}.jsonl: no such file; run {name} first")
        found[name] = records(truths, answered / f"{name}.jsonl", by_oracle)
    output.write_text(page(found), encoding="utf-8")
    if lines is not None:
        with lines.open("w", encoding="utf-8") as file:
            for name, rows in found.items():
                for row in rows:
                    file.write(json.dumps({"entrant": name} | row) + "\n")


def percent(records: Iterable[Record], key: str | Callable[[Record], object]) -> str:
    """Share with its Wilson interval: `97 % (92–99), 60 of 62`."""
    hits, of = scoring.share(records, key)
    if not of:
        return "–"
    low, high = scoring.wilson(hits, of)
    return f"{hits / of:.0%} ({low:.0%}–{high:.0%}), {hits:g} of {of}".replace("%", " %").replace(
        " %–", "–"
    )


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _median(values: list[float]) -> str:
    return f"{np.median(values):.2f}" if values else "–"


def page(found: dict[str, list[Record]]) -> str:
    """All tables."""
    some = len(next(iter(found.values())))
    parts = [
        "# Leaderboard of the blind residual challenge",
        f"{some} sessions. Shares with Wilson's 95 % intervals. Columns are explained in README.md.",
        "## All kinds",
        _table(
            ["entrant", "right set (gain ≥ 16)", "something false (nothing hidden)", "wrong name",
             "wrong at > 95 %", "covariate, no name", "fabricated on scatter", "left out ÷ oracle's",
             "Brier", "log score", "CPU s, median", "failed"],
            [_summary(name, rows) for name, rows in found.items()],
        ),
        "† states its own error on the check dwells, whose readings it sees.",
        "## Right names by gain (a set that holds the true name; every true name counts)",
        _by_bin(found, ("catalogue", "two", "within", "bias"), "right_set"),
        "## True name on top",
        _by_bin(found, ("catalogue", "two", "within", "bias"), "right_top"),
        "## Size of the sets that hold the truth, over the oracle's (where both do)",
        _sizes(found),
        "## Right covariate and no name, foreign and strangers, by gain",
        _by_bin(found, ("foreign", "stranger"), "covariate"),
        "## A wrong name, by family",
        _by_family(found, "wrong"),
        "## A wrong name at more than 95 %, by family",
        _by_family(found, "wrong_confident"),
        "## Something seen, by gain, all families that hide something",
        _by_bin(found, HIDDEN, "detected"),
        "## Left out ÷ oracle's on the same dwells, by family: median (90 % quantile)",
        _heldout(found),
        "## 95 % intervals that hold the truth",
        _coverage(found),
    ]  # fmt: skip
    for name, rows in found.items():
        parts += [
            f"## {name}",
            "Commonest wrong names by kind:",
            _wrong(rows),
            "Reliability, probability of something:",
        ]
        parts.append(_reliability(_something(rows)))
        parts += ["Reliability, leading names:", _reliability(scoring.name_pairs(rows))]
    return "\n\n".join(parts) + "\n"


def _something(rows: list[Record]) -> list[tuple[float, bool]]:
    return [(r["something"], r["hidden"]) for r in rows if r["family"] != "bias"]


def _summary(name: str, rows: list[Record]) -> list[str]:
    clear = [r for r in rows if r["family"] in ("catalogue", "two") and min(r["gain"]) >= 16]
    ratios = [r["heldout_ratio"] for r in rows if r.get("heldout_ratio") is not None]
    mark = " †" if name in SEES_CHECK_READINGS else ""
    return [
        name,
        percent(clear, "right_set"),
        percent([r for r in rows if r["family"] == "nothing"], "false"),
        percent(rows, "wrong"),
        percent(rows, "wrong_confident"),
        percent(rows, "covariate"),
        percent(rows, "fabricated"),
        _median(ratios) + mark,
        f"{scoring.brier(_something(rows)):.3f}",
        f"{scoring.log_score(_something(rows)):.3f}",
        _median([r["seconds"] for r in rows]),
        str(sum(bool(r["error"]) for r in rows)),
    ]


def _by_bin(found: dict[str, list[Record]], families: tuple[str, ...], key: str) -> str:
    rows = []
    for name, records_ in found.items():
        chosen = [r for r in records_ if r["family"] in families]
        rows.append(
            [name, *(percent([r for r in chosen if r["bin"] == b], key) for b in scoring.BIN_NAMES[:-1])]
        )
    return _table(["entrant", *scoring.BIN_NAMES[:-1]], rows)


def _by_family(found: dict[str, list[Record]], key: str) -> str:
    families = ("nothing", "bias", *HIDDEN)
    rows = [
        [name, *(percent([r for r in rows if r["family"] == f], key) for f in families)]
        for name, rows in found.items()
    ]
    return _table(["entrant", *families], rows)


def _sizes(found: dict[str, list[Record]]) -> str:
    rows = []
    for name, records_ in found.items():
        both = [r for r in records_ if r.get("set_size") and r.get("oracle_set_size")]
        ratio = [r["set_size"] / r["oracle_set_size"] for r in both]
        mean = sum(r["set_size"] for r in both) / max(sum(r["oracle_set_size"] for r in both), 1e-9)
        rows.append([name, str(len(both)), f"{mean:.2f}" if both else "–", _median(ratio)])
    return _table(["entrant", "sessions", "mean size ÷ mean size", "median of the ratios"], rows)


def _heldout(found: dict[str, list[Record]]) -> str:
    families = ("nothing", *HIDDEN)
    rows = []
    for name, records_ in found.items():
        cells = []
        for family in families:
            r = [
                x["heldout_ratio"]
                for x in records_
                if x["family"] == family and x.get("heldout_ratio") is not None
            ]
            cells.append(f"{np.median(r):.2f} ({np.quantile(r, 0.9):.2f})" if r else "–")
        rows.append([name, *cells])
    return _table(["entrant", *families], rows)


def _coverage(found: dict[str, list[Record]]) -> str:
    rows = []
    for name, records_ in found.items():
        for part in ("nothing", "catalogue", "two", "foreign", "stranger", "scatter"):
            cells = []
            for keys in (("delta_k",), ("delta_phi",), ("bias_x", "bias_y", "bias_z")):
                z = [
                    v for r in records_ if r["family"] == part for k, v in r["base_z"].items() if k in keys
                ]
                cells.append(_covered(z))
            z = [v for r in records_ if r["family"] == part for v in r["amplitude_z"].values()]
            rows.append([name, part, *cells, _covered(z)])
    return _table(["entrant", "family", "ΔK", "Δφ", "bias", "amplitudes of right names"], rows)


def _covered(z: list[float]) -> str:
    if not z:
        return "–"
    hits, of, rms = scoring.coverage(z)
    low, high = scoring.wilson(hits, of)
    return f"{hits / of:.0%} ({low:.0%}–{high:.0%}) of {of}, rms z {rms:.2g}".replace("%", " %").replace(
        " %–", "–"
    )


def _wrong(rows: list[Record]) -> str:
    by_kind: dict[str, Counter[str]] = {}
    total = Counter(r["kind"] for r in rows)
    for r in rows:
        for name in set(r["wrong_names"]):
            by_kind.setdefault(r["kind"], Counter())[name] += 1
    order = sorted(by_kind, key=lambda k: (-by_kind[k].total(), k))
    body = [[k, str(total[k]), ", ".join(f"{n} {c}" for n, c in by_kind[k].most_common())] for k in order]
    return _table(["kind", "sessions", "wrong names"], body) if body else "none"


def _reliability(pairs: list[tuple[float, bool]]) -> str:
    rows = [[a, str(n), f"{p:.3f}", f"{y:.3f}"] for a, n, p, y in scoring.reliability(pairs)]
    return _table(["stated", "number", "mean stated", "was so"], rows) if rows else "none"
