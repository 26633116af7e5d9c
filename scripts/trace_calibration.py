"""Whether what `trace` states is so: probabilities, sets of names and uncertainties against the truth.

    python scripts/trace_calibration.py run records.jsonl --sessions 240 --space 100 --residual 300 --jobs 2
    python scripts/trace_calibration.py tables records.jsonl --picture docs/pictures/reliability.svg

`run` writes sessions of all kinds (tests/tracing: `none`, `one`, `two`, `uncatalogued`, `beyond`, in one
plane and in space; with `--residual` also those of benchmarks/blind_residual), traces each from its file
and appends one JSON line a session; run again with the same arguments it goes on where it was broken off.
`tables` prints Markdown and draws the reliability diagram.

Statements, all read from the JSON of `trace`:

* *a name is found*: `probability` of each entry of `found` that the session's means show;
* *a name of a set*: `probability` × `present` of each name in `sets`; *the names of a set* is their sum
  where a name leads it;
* *what has no name depends on*: `probability` of `unnamed`, for its covariates;
* *there is something*: 1 less the share of `rivals` that have no cause, or the greatest `probability` or
  `present` of what was claimed, whichever is more;
* *verdicts*: the figures of `trace_statistics.py`, of the same sessions;
* *intervals*: value ± U, the 95 % interval; scores z are in units of U/1.96.

Every session has a bias, so that a claimed bias, and a set that holds it, is no statement. A name is true
where it was put in. Where it only stands for what was put in as well as this session can tell
(tests/tracing/verdict.py: *innocent*), that is counted beside it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from adis_gonio.base.uncertainty import NORMAL_95, wilson
from blind_residual import generator
from trace_statistics import figures
from tracing import blind as planar, space
from tracing.blind import KINDS, Blind
from tracing.lens import Lens
from tracing.named_truth import Term
from tracing.rounds import crew, judge_answer, trace_file, write_session
from tracing.space import SPACE
from tracing.verdict import ZERO, Verdict, covariate, drives, innocent

RESIDUAL = "residual"
NAMELESS = "unnamed: "
WITHIN = {"tone", "settling", "noise_change", "saturation", "quantization"}
SCATTER = {"reading_scatter", "fixture_scatter"}
EDGES = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Bins of stated probability; closer where the statements are."""
Z95 = 1.959964

Record = dict[str, Any]
Task = tuple[str, str, int]
"""Kind, seed or secret, number."""


# -- sessions ------------------------------------------------------------------------------------------


def tasks_of(options: argparse.Namespace) -> list[Task]:
    """All sessions that are asked for."""
    wanted = [(kind, str(options.seed), k) for k in range(options.sessions) for kind in KINDS]
    wanted += [(SPACE + kind, str(options.seed), k) for k in range(options.space) for kind in KINDS]
    return wanted + [(RESIDUAL, options.secret, k) for k in range(options.residual)]


def write_task(path: str, task: Task) -> str:
    """The session of a task as a file."""
    kind, seed, number = task
    if kind == RESIDUAL:
        csv, _ = generator.draw(seed, number)
        Path(path).write_text(csv, encoding="utf-8")
        return path
    return write_session(path, kind, int(seed), number)


def record_of(answer: Mapping[str, Any], task: Task) -> Record:
    """What was stated of a session, beside its truth, which is drawn again."""
    kind, seed, number = task
    record: Record = {"kind": kind, "seed": seed, "number": number, "seconds": answer["seconds"]}
    if "failure" in answer:
        return record | {"failure": answer["failure"]}
    record |= _of_residual(answer, seed, number) if kind == RESIDUAL else _of_blind(answer, task)
    record["something"] = something(answer)
    record["found"] = [
        [found["effect"], found["probability"]]
        for found in answer["found"]
        if found["effect"] not in WITHIN | {ZERO}
    ]
    record["sets"] = sets_beside_zero(answer)
    record["unnamed"] = answer["unnamed"]
    record["adequate"] = answer["adequate"]
    return record


def sets_beside_zero(answer: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Sets of causes that the zero is not among."""
    return [one for one in answer["sets"] if ZERO not in one["names"]]


def something(answer: Mapping[str, Any]) -> float:
    """Probability that there is a cause beside the zero."""
    claimed = [f["probability"] for f in answer["found"] if f["effect"] != ZERO]
    claimed += [one["present"] for one in sets_beside_zero(answer)]
    without = 0.0
    total = 0.0
    for rival in answer["rivals"]:
        total += rival["probability"]
        named = [term.split("[")[0] for term in rival["terms"] if "~" not in term]
        if len(named) == len(rival["terms"]) and set(named) <= {ZERO}:
            without += rival["probability"]
    if total > 0:
        claimed.append(1 - without / total)
    return float(min(max(claimed, default=0.0), 1.0))


def _of_blind(answer: Mapping[str, Any], task: Task) -> Record:
    kind, seed, number = task
    spatial = kind.startswith(SPACE)
    blind, _ = (space if spatial else planar).draw(kind, int(seed), number)
    lens = space.SpaceLens(blind.bench) if spatial else Lens(blind.bench)
    said = {name for one in answer["sets"] for name in one["names"]}
    said |= {found["effect"] for found in answer["found"]}
    named = blind.terms[1 if blind.undeclared else 0 :]
    return {
        "verdict": asdict(judge_answer(dict(answer), kind, int(seed), number)),
        "truth": sorted(blind.names),
        "hidden": bool(blind.terms),
        "nameless": blind.terms[0].name if blind.undeclared else None,
        "driven": blind.undeclared
        and drives(blind.terms[0], [covariate(word) for word in _covariates(answer)], lens),
        "innocent": sorted(
            name for name in said - blind.names if blind.terms and innocent(name, blind, lens)
        ),
        "base_z": _zs(answer["base"], _base_of(blind, spatial)),
        "effect_z": _effect_zs(answer, named, spatial),
    }


def _covariates(answer: Mapping[str, Any]) -> list[str]:
    """What the trace says that the unnamed rest depends on."""
    return [] if answer["unnamed"] is None else answer["unnamed"]["covariates"]


def _base_of(blind: Blind, spatial: bool) -> dict[str, float]:
    """True base parameters by name, as `trace` states them."""
    bench = blind.bench
    if not spatial:
        x, y = bench.gains
        return {
            "scale_x": x,
            "scale_y": y,
            "delta_k": x / y - 1,
            "delta_phi": float(np.degrees(bench.dphi)),
        }
    gains = np.linalg.norm(bench.matrix, axis=1)
    axes = bench.matrix / gains[:, None]
    out = {f"scale_{letter}": float(gain) for letter, gain in zip("xyz", gains, strict=True)}
    for i, j in ((0, 1), (0, 2), (1, 2)):  # a skew is 90° minus the angle between two axes
        out[f"skew_{'xyz'[i]}{'xyz'[j]}"] = float(np.degrees(np.arcsin(axes[i] @ axes[j])))
    return out


def _zs(stated: Mapping[str, Any], truth: Mapping[str, float]) -> dict[str, float]:
    """Errors in stated uncertainties of the values that both have."""
    return {
        name: float((stated[name]["value"] - value) / (stated[name]["U"] / NORMAL_95))
        for name, value in truth.items()
        if name in stated and stated[name]["u"]
    }


def _effect_zs(answer: Mapping[str, Any], named: Sequence[Term], spatial: bool) -> dict[str, float]:
    """Errors of the parameters of effects that were found by their own name."""
    out = {}
    for term in named:
        if spatial and term.name == "outlier_dwell":
            continue  # only the norm of one reading is seen: its three offsets are one number
        for found in answer["found"]:
            if found["effect"] == term.name:
                truth = dict(zip(term.reported, term.coefficients, strict=True)) | term.shapes
                stated = found["parameters"]
                out |= _zs(stated, {name: truth.get(name, 0.0) for name in stated})
    return out


def _of_residual(answer: Mapping[str, Any], secret: str, number: int) -> Record:
    _, truth = generator.draw(secret, number)
    names = set(truth.names)
    effects = {}
    for found in answer["found"]:
        if found["effect"] in names - WITHIN:
            effects |= _zs(found["parameters"], truth.parameters)
    return {
        "kind": f"{RESIDUAL} {truth.family}",
        "what": truth.kind,
        "gain": truth.gain,
        "truth": [*truth.names, *(sorted(SCATTER) if truth.scatter else ())],
        "hidden": truth.family not in ("nothing", "bias"),
        "nameless": truth.kind if truth.family in ("foreign", "stranger", "scatter") else None,
        "driven": bool(truth.covariates)
        and all(set(group) & set(_covariates(answer)) for group in truth.covariates),
        "innocent": [],
        "base_z": _zs(
            answer["base"], {k: truth.base[k] for k in ("delta_k", "delta_phi") if k in truth.base}
        ),
        "effect_z": effects,
    }


def run(options: argparse.Namespace) -> int:
    """Trace what the file does not hold yet."""
    done = {_task(record) for record in records_of(options.records)} if options.records.exists() else set()
    left = [task for task in tasks_of(options) if task not in done]
    print(f"{len(done)} sessions are there, {len(left)} to do", file=sys.stderr)
    waiting = iter(left)
    with crew(options.jobs) as (bench, tracing), options.records.open("a", encoding="utf-8") as file:
        while batch := list(islice(waiting, 4 * options.jobs)):
            with tempfile.TemporaryDirectory(prefix="calibration-") as folder:
                paths = [str(Path(folder) / f"session_{k}.csv") for k in range(len(batch))]
                answers = list(tracing.map(trace_file, list(bench.map(write_task, paths, batch))))
                for record in bench.map(record_of, answers, batch):
                    file.write(json.dumps(record) + "\n")
                file.flush()
    return 0


def records_of(path: Path) -> list[Record]:
    """All lines of a file; a last one that was cut off is left out."""
    out = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            out.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return out


def _task(record: Record) -> Task:
    kind = RESIDUAL if record["kind"].startswith(RESIDUAL) else record["kind"]
    return kind, record["seed"], record["number"]


# -- statistics ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bin:
    """Statements of about one probability: their number, its mean, how many were so."""

    low: float
    high: float
    count: int
    mean: float
    hits: int


Pairs = Sequence[tuple[float, bool]]


def bins_of(pairs: Pairs) -> list[Bin]:
    """Statements (probability, whether so) by stated probability; empty bins are left out."""
    out = []
    p = np.array([pair[0] for pair in pairs])
    so = np.array([pair[1] for pair in pairs], dtype=bool)
    for k, (low, high) in enumerate(pairwise(EDGES)):
        inside = (p >= low) & ((p < high) | (k == len(EDGES) - 2))
        if inside.any():
            out.append(Bin(low, high, int(inside.sum()), float(p[inside].mean()), int(so[inside].sum())))
    return out


def calibration_error(bins: Sequence[Bin]) -> float:
    """Expected calibration error: mean |stated − observed| over bins, weighted by their counts."""
    total = sum(b.count for b in bins)
    return sum(abs(b.mean * b.count - b.hits) for b in bins) / total


def brier(pairs: Pairs) -> float:
    """Mean square of probability less outcome."""
    return float(np.mean([(p - so) ** 2 for p, so in pairs]))


def log_score(pairs: Pairs) -> float:
    """Mean −ln of the probability that was given to what was so, that probability at least 10⁻⁶."""
    return float(np.mean([-math.log(max(p if so else 1 - p, 1e-6)) for p, so in pairs]))


def found_pairs(records: Iterable[Record], lenient: bool = False) -> list[tuple[float, bool]]:
    """Every found name with its probability, and whether it was put in (or innocent)."""
    return [(p, _true(r, name, lenient)) for r in records for name, p in r["found"]]


def set_pairs(records: Iterable[Record], lenient: bool = False) -> list[tuple[float, bool]]:
    """Every name of every set with its probability, and whether it was put in."""
    return [
        (p * one["present"], _true(r, name, lenient))
        for r in records
        for one in r["sets"]
        for name, p in zip(one["names"], one["probability"], strict=True)
        if _is_name(name)
    ]


def claim_pairs(records: Iterable[Record]) -> list[tuple[float, bool]]:
    """Every set that a name leads: the probability of its names together, and whether one was put in."""
    out = []
    for record in records:
        for one in record["sets"]:
            named = {n: p for n, p in zip(one["names"], one["probability"], strict=True) if _is_name(n)}
            if _is_name(one["names"][0]):
                so = any(_true(record, name, False) for name in named)
                out.append((sum(named.values()) * one["present"], so))
    return out


def driver_pairs(records: Iterable[Record]) -> list[tuple[float, bool]]:
    """Every unnamed rest that states a probability, and whether what is hidden depends on what it says."""
    stated = [(r["unnamed"], r["driven"]) for r in records if r["unnamed"]]
    return [(unnamed["probability"], so) for unnamed, so in stated if unnamed["probability"] is not None]


def something_pairs(records: Iterable[Record]) -> list[tuple[float, bool]]:
    """Every session's probability of something, and whether it hides anything."""
    return [(r["something"], r["hidden"]) for r in records]


def _is_name(word: str) -> bool:
    return not word.startswith(NAMELESS)


def _true(record: Record, name: str, lenient: bool) -> bool:
    return name in record["truth"] or (lenient and name in record["innocent"])


def holds(record: Record, one: Mapping[str, Any], lenient: bool = False) -> bool:
    """Whether a set holds a cause that is there: its name, or a function without one where one is."""
    if any(_true(record, name, lenient) for name in one["names"]):
        return True
    return record["nameless"] is not None and not all(map(_is_name, one["names"]))


STATEMENTS: dict[str, Callable[[Sequence[Record]], list[tuple[float, bool]]]] = {
    "a name is found": found_pairs,
    "the same, or innocent": partial(found_pairs, lenient=True),
    "a name of a set": set_pairs,
    "the names of a set": claim_pairs,
    "what has no name depends on": driver_pairs,
    "there is something": something_pairs,
}
SHOWN = ("a name is found", "a name of a set", "there is something")
"""Statements with a table of their own and a panel in the diagram."""


# -- tables --------------------------------------------------------------------------------------------


def share(hits: float, n: int) -> str:
    """A rate with its Wilson interval."""
    if not n:
        return "–"
    low, high = wilson(hits, n)
    return f"{hits / n:.1%} ({low:.1%}–{high:.1%})"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def reliability_table(pairs: Pairs) -> str:
    """Bins of stated probability."""
    rows = [
        (f"{b.low:.0%} – {b.high:.0%}", str(b.count), f"{b.mean:.1%}", share(b.hits, b.count))
        for b in bins_of(pairs)
    ]
    return table(("stated", "statements", "mean", "so"), rows)


def scores_table(records: Sequence[Record]) -> str:
    """One line a sort of statement, of the kinds of tests/tracing, of blind_residual, and of all."""
    worlds = {
        "blind kinds": [r for r in records if not r["kind"].startswith(RESIDUAL)],
        "blind_residual": [r for r in records if r["kind"].startswith(RESIDUAL)],
        "all": list(records),
    }
    rows = []
    for world, chosen in worlds.items():
        for what, pairs_of in STATEMENTS.items():
            if pairs := pairs_of(chosen):
                rows.append((world, what, *_scores(pairs)))
    head = (
        "sessions",
        "statement",
        "number",
        "mean stated",
        "so",
        "calibration error",
        "Brier",
        "log score",
    )
    return table(head, rows)


def _scores(pairs: Pairs) -> tuple[str, ...]:
    return (
        str(len(pairs)),
        f"{np.mean([p for p, _ in pairs]):.1%}",
        share(sum(so for _, so in pairs), len(pairs)),
        f"{calibration_error(bins_of(pairs)):.1%}",
        f"{brier(pairs):.4f}",
        f"{log_score(pairs):.4f}",
    )


def groups_of(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Records by kind, then all."""
    groups: dict[str, list[Record]] = defaultdict(list)
    every = list(records)
    for record in every:
        groups[record["kind"]].append(record)
    return dict(sorted(groups.items(), key=lambda item: _rank(item[0]))) | {"all": every}


def _rank(kind: str) -> tuple[int, int, str]:
    plain = kind.removeprefix(SPACE)
    return (
        kind.startswith(RESIDUAL) * 2 + kind.startswith(SPACE),
        KINDS.index(plain) if plain in KINDS else 0,
        kind,
    )


def sets_table(groups: Mapping[str, list[Record]]) -> str:
    """Coverage of the sets that claim a name, and their sizes."""
    rows = []
    for kind, records in groups.items():
        sets = [(r, one) for r in records for one in r["sets"] if _is_name(one["names"][0])]
        if sets:
            level = float(np.mean([sum(one["probability"]) for _, one in sets]))
            sizes = [len(one["names"]) for _, one in sets]
            rows.append(
                (
                    kind,
                    str(len(sets)),
                    f"{level:.1%}",
                    share(sum(holds(r, one) for r, one in sets), len(sets)),
                    share(sum(holds(r, one, True) for r, one in sets), len(sets)),
                    f"{np.mean(sizes):.2f} ({max(sizes)})",
                    f"{np.mean([size == 1 for size in sizes]):.0%}",
                )
            )
    head = ("kind", "sets led by a name", "mean level", "hold the cause", "or its like", "size (largest)")
    return table((*head, "of one name"), rows)


def coverage_table(groups: Mapping[str, list[Record]]) -> str:
    """Coverage of 95 % intervals by kind and parameter."""
    sorts: dict[str, Callable[[Record], Iterable[float]]] = {
        "ΔK": partial(_of, ("delta_k",)),
        "Δφ": partial(_of, ("delta_phi",)),
        "gains": partial(_of, ("scale_x", "scale_y", "scale_z")),
        "skews": partial(_of, ("skew_xy", "skew_xz", "skew_yz")),
        "effects": lambda r: r["effect_z"].values(),
    }
    rows = []
    for kind, records in groups.items():
        for what, get in sorts.items():
            z = np.array([value for r in records for value in get(r)])
            if len(z):
                inside = int((np.abs(z) <= Z95).sum())
                rms = math.sqrt(float(np.mean(z**2)))
                rows.append(
                    (kind, what, str(len(z)), share(inside, len(z)), f"{rms:.2f}", f"{np.abs(z).max():.1f}")
                )
    return table(("kind", "value", "number", "within U", "rms of z", "largest"), rows)


def _of(names: Sequence[str], record: Record) -> Iterator[float]:
    yield from (record["base_z"][name] for name in names if name in record["base_z"])


def wrong_table(groups: Mapping[str, list[Record]]) -> str:
    """Names that were neither put in nor could stand for what was, by kind."""
    rows = []
    for kind, records in groups.items():
        wrong = [r for r in records if wrong_names(r)]
        told = "; ".join(
            f"{r['number']} {r.get('what') or r['nameless'] or '+'.join(r['truth']) or 'nothing'} → "
            f"{', '.join(wrong_names(r))}"
            for r in wrong
        )
        rows.append((kind, share(len(wrong), len(records)), told if kind != "all" else ""))
    return table(("kind", "sessions with a wrong name", "which"), rows)


def verdicts_table(groups: Mapping[str, list[Record]]) -> str:
    """The figures of `trace_statistics.py`, of the same sessions."""
    rows = []
    for kind, records in groups.items():
        verdicts = [Verdict(**record["verdict"]) for record in records if "verdict" in record]
        if not verdicts or kind == "all":
            continue
        for line in figures(kind.removeprefix(SPACE), verdicts):
            met = {None: "", True: line.target, False: f"{line.target}: **not met**"}[line.met]
            rows.append((kind, line.what, " ".join(line.value.split()), met))
        if any(record["truth"] for record in records):
            held = share(sum(map(_said, records)), len(records))
            rows.append((kind, "every true name is found or in a set", held, ""))
    return table(("kind", "figure", "measured", "target"), rows)


def _said(record: Record) -> bool:
    """Whether all true names stand somewhere in what was said."""
    said = {name for name, _ in record["found"]} | {name for one in record["sets"] for name in one["names"]}
    return set(record["truth"]) <= said


def wrong_names(record: Record, least: float = 0.0) -> list[str]:
    """Found names that are wrong, with their probability, from a least one on."""
    return [
        f"{name} {p:.3f}" for name, p in record["found"] if p >= least and not _true(record, name, True)
    ]


LEAST = (0.0, 0.6, 0.7, 0.8, 0.9, 0.95)


def believed_table(groups: Mapping[str, list[Record]]) -> str:
    """Sessions with a wrong name, and true names found, where a name is believed from a probability on."""
    rows = []
    for kind, records in groups.items():
        hidden = [name for record in records for name in record["truth"]]
        if not hidden or kind == "all":
            continue
        cells = []
        for least in LEAST:
            wrong = sum(bool(wrong_names(record, least)) for record in records)
            found = sum(
                p >= least and name in record["truth"] for record in records for name, p in record["found"]
            )
            cells.append(f"{100 * wrong / len(records):.1f}; {100 * found / len(hidden):.0f}")
        rows.append((kind, *cells))
    heads = ("as stated", *(f"from {least:.0%}" for least in LEAST[1:]))
    return table(("wrong, %; found, %", *heads), rows)


def tables(options: argparse.Namespace) -> int:
    """Print all tables and draw the diagram."""
    every = records_of(options.records)
    records = [r for r in every if "failure" not in r]
    if not records:
        print(f"{options.records}: no session in it", file=sys.stderr)
        return 1
    groups = groups_of(records)
    counts = ", ".join(f"{kind} {len(rs)}" for kind, rs in groups.items())
    print(f"Sessions: {counts}; seeds {', '.join(sorted({r['seed'] for r in records}))}.", end=" ")
    print(f"`trace` raised in {len(every) - len(records)}.\n\n### Scores\n\n{scores_table(records)}")
    for what in SHOWN:
        if pairs := STATEMENTS[what](records):
            print(f"\n### Reliability: {what}\n\n{reliability_table(pairs)}")
    print(f"\n### Sets\n\n{sets_table(groups)}\n\n### Intervals\n\n{coverage_table(groups)}")
    print(f"\n### Wrong names\n\n{wrong_table(groups)}")
    print(f"\n### Names believed from a probability on\n\n{believed_table(groups)}")
    print(f"\n### Verdicts\n\n{verdicts_table(groups)}")
    if options.picture:
        draw(options.picture, {what: pairs for what in SHOWN if (pairs := STATEMENTS[what](records))})
    return 0


COLOURS = ("#0b5cad", "#b8500c", "#2d7a2d")


def draw(path: Path, statements: Mapping[str, Pairs]) -> None:
    """Reliability diagram: stated against observed, and below how often each was stated."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    style = {"svg.fonttype": "none", "svg.hashsalt": "reliability", "font.size": 10, "axes.titlesize": 11}
    with mpl.rc_context(style):
        figure, axes = plt.subplots(
            2,
            len(statements),
            figsize=(3.3 * len(statements), 4.6),
            sharex=True,
            sharey="row",
            squeeze=False,
            height_ratios=(4, 1),
            layout="constrained",
        )
        for column, colour, (what, pairs) in zip(axes.T, COLOURS, statements.items(), strict=False):
            _draw_one(column, colour, what, bins_of(pairs))
        axes[0, 0].set_ylabel("were so, %")
        axes[1, 0].set_ylabel("number")
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=110)
        plt.close(figure)


def _draw_one(axes: Sequence[Any], colour: str, what: str, bins: Sequence[Bin]) -> None:
    shares, counts = axes
    stated = 100 * np.array([b.mean for b in bins])
    seen = 100 * np.array([b.hits / b.count for b in bins])
    low, high = 100 * np.array([wilson(b.hits, b.count) for b in bins]).T
    off = np.maximum([seen - low, high - seen], 0)
    shares.plot([0, 100], [0, 100], color="#6b6b6b", linewidth=1, linestyle=(0, (3.5, 2.7)))
    shares.errorbar(stated, seen, off, fmt="o", color=colour, markersize=5, linewidth=1.2, capsize=2)
    shares.set(
        xlim=(-4, 104), ylim=(-4, 104), title=what, xticks=range(0, 101, 20), yticks=range(0, 101, 20)
    )
    error = f"calibration error {calibration_error(bins):.1%}"
    shares.text(0.04, 0.95, error, transform=shares.transAxes, va="top", fontsize=9)
    edges = 100 * np.array([[b.low, b.high] for b in bins])
    counts.bar(
        edges[:, 0], [b.count for b in bins], np.diff(edges)[:, 0], align="edge", color=colour, alpha=0.6
    )
    counts.set(yscale="log", xlabel="stated, %")
    for ax in axes:
        ax.grid(color="#dddddd", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)


def main() -> int:
    """Run, or print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    runs = commands.add_parser("run", help="trace sessions and append a line of each to a file")
    runs.add_argument("--sessions", type=int, default=0, help="of each kind in one plane")
    runs.add_argument("--space", type=int, default=0, help="of each kind in space")
    runs.add_argument("--residual", type=int, default=0, help="of benchmarks/blind_residual")
    runs.add_argument("--seed", type=int, default=1, help="of the kinds in plane and space")
    runs.add_argument("--secret", default="train", help="of blind_residual")
    runs.add_argument("--jobs", type=int, default=2)
    shown = commands.add_parser("tables", help="print Markdown of such a file")
    shown.add_argument("--picture", type=Path, help="draw the reliability diagram (SVG)")
    for command in (runs, shown):
        command.add_argument("records", type=Path)
    options = parser.parse_args()
    return run(options) if options.command == "run" else tables(options)


if __name__ == "__main__":
    sys.exit(main())
