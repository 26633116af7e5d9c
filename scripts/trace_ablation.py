"""What each rule of `trace` is worth: switched off one by one on the same blind sessions.

    python scripts/trace_ablation.py --sessions 300 --ladder 300 --work /tmp/ablation --jobs 2

Sessions: of each kind of tests/tracing (`--sessions`), and of the challenge in benchmarks/blind_residual
(`--ladder`), where effects come down to nothing. A first run records where each rule of
`adis_gonio.tracing.thresholds` would decide otherwise if it were off; each rule is then switched off on
those sessions alone, since the others cannot change. A run that was broken off goes on where it was.
With `--records FILE` what the first run stated is kept for `trace_calibration.py tables`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import multiprocessing
import operator
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.tracing.thresholds import Limits, limits
from blind_residual.generator import Truth, draw
from blind_residual.runners.adis_gonio import from_trace
from blind_residual.scoring import coverage, score
from trace_calibration import RESIDUAL, record_of
from tracing.blind import KINDS
from tracing.rounds import judge_answer, trace_file, write_session

LADDER = "ladder"
RULES = {
    field.name: field.metadata["off"]
    for field in dataclasses.fields(Limits)
    if field.metadata["off"] is not None
}
FIGURES = ("right", "false", "wrong", "covered", "left_out")
decided: set[str] = set()


class Probe:
    """A limit that computes with its switched-off value as well, and notes what depends on it."""

    __array_ufunc__ = None
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, name: str, value: Any, off: Any) -> None:
        self.name, self.value, self.off = name, value, off

    def _plain(self, other: Any) -> Any:
        return other.value if isinstance(other, Probe) else other

    def _made(self, value: Any, off: Any) -> Probe:
        return Probe(self.name, value, off)

    def _compared(self, compare: Callable[[Any, Any], Any], other: Any) -> Any:
        other = self._plain(other)
        said = compare(self.value, other)
        if np.any(said != compare(self.off, other)):
            decided.add(self.name)
        return said

    def __neg__(self) -> Probe:
        return self._made(-self.value, -self.off)

    def _used(self) -> Any:
        decided.add(self.name)
        return self.value

    def __float__(self) -> float:
        return float(self._used())

    def __index__(self) -> int:
        return int(self._used())


def _arithmetic(operation: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    def left(self: Probe, other: Any) -> Probe:
        other = self._plain(other)
        with np.errstate(all="ignore"):
            return self._made(operation(self.value, other), operation(self.off, other))

    def right(self: Probe, other: Any) -> Probe:
        with np.errstate(all="ignore"):
            return self._made(operation(other, self.value), operation(other, self.off))

    return left, right


for word in ("add", "sub", "mul", "truediv", "floordiv", "pow"):
    left, right = _arithmetic(getattr(operator, word))
    setattr(Probe, f"__{word}__", left)
    setattr(Probe, f"__r{word}__", right)
for word in ("lt", "le", "gt", "ge"):
    setattr(Probe, f"__{word}__", partialmethod(Probe._compared, getattr(operator, word)))


def session_path(work: Path, kind: str, index: int) -> Path:
    """Where a session lies."""
    return work / "sessions" / kind / str(index) / "session.csv"


def secret(seed: int) -> str:
    """Of the challenge's sessions."""
    return f"ablation {seed}"


def make(work: Path, kind: str, seed: int, index: int) -> None:
    """Write one session, unless it is there."""
    path = session_path(work, kind, index)
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == LADDER:
        csv, truth = draw(secret(seed), index)
        truth.save(path.with_name("truth.json"))
        path.write_text(csv, encoding="utf-8")
    else:
        write_session(str(path), kind, seed, index)


def traced(work: Path, kind: str, seed: int, index: int, rule: str) -> dict[str, Any]:
    """Figures of one session with a rule off, or with probes (`rule` empty)."""
    make(work, kind, seed, index)
    decided.clear()
    for name, off in RULES.items():
        usual = getattr(Limits(), name)
        setattr(limits, name, off if name == rule else (usual if rule else Probe(name, usual, off)))
    path = session_path(work, kind, index)
    answer = trace_file(str(path))
    depends = sorted(decided)
    if not rule and "failure" in answer:  # a probe in the answer itself
        for name in RULES:
            setattr(limits, name, getattr(Limits(), name))
        answer = trace_file(str(path))
    row: dict[str, Any] = {"kind": kind, "index": index, "rule": rule, "decided": depends}
    if not rule:
        task = (RESIDUAL, secret(seed)) if kind == LADDER else (kind, str(seed))
        row["record"] = record_of(answer, (*task, index))
    return row | (_on_ladder(path, answer) if kind == LADDER else _judged(kind, seed, index, answer))


def _judged(kind: str, seed: int, index: int, answer: dict[str, Any]) -> dict[str, Any]:
    verdict = judge_answer(answer, kind, seed, index)
    strange = kind in {"uncatalogued", "beyond"}
    false = bool(verdict.wrong) or (kind == "none" and (bool(verdict.claimed) or verdict.unnamed))
    return {
        "right": float(verdict.covariate if strange else verdict.exact),
        "false": false,
        "wrong": bool(verdict.wrong),
        "covered": [int(hit) for _, hit, _ in verdict.covered],
        "left_out": None if np.isnan(verdict.worse) else _error(answer),
        "failure": verdict.failure[-300:],
    }


def _error(answer: dict[str, Any]) -> float | None:
    return None if "failure" in answer else answer["error"]["after"]["heldout_rms_mg"]


def _on_ladder(path: Path, answer: dict[str, Any]) -> dict[str, Any]:
    truth = Truth.load(path.with_name("truth.json"))
    if "failure" in answer:
        return {"right": 0.0, "false": True, "wrong": True, "covered": [], "left_out": None} | answer
    record = score(truth, from_trace(answer))
    right = record["right_set"] if truth.names else record.get("covariate", not record["false"])
    inside, of, _ = coverage(list(record["base_z"].values()))
    return {
        "right": float(right or 0.0),
        "false": bool(record["false"] or record.get("fabricated")),
        "wrong": bool(record["wrong"]),
        "covered": [1] * inside + [0] * (of - inside),
        "left_out": _error(answer),
        "failure": "",
    }


def run(
    options: argparse.Namespace, out: Path, jobs: Sequence[tuple[str, int, str]]
) -> list[dict[str, Any]]:
    """Rows of these (kind, index, rule), from the file where they stand in it."""
    rows: dict[tuple[str, int, str], dict[str, Any]] = {}
    if out.exists():
        for line in out.read_text().splitlines():
            row = json.loads(line)
            rows[(row["kind"], row["index"], row["rule"])] = row
    left = [job for job in jobs if job not in rows]
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, fresh) as pool, out.open("a") as file:
        asked = [pool.submit(traced, options.work, kind, options.seed, k, rule) for kind, k, rule in left]
        for job, answer in zip(left, asked, strict=True):
            rows[job] = answer.result()
            file.write(json.dumps(rows[job]) + "\n")
            file.flush()
    return [rows[job] for job in jobs]


def line(rule: str, pairs: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> str:
    """One row of the table: with the rule → without it, over the sessions where it decides."""

    def total(key: str) -> str:
        return "{:g} → {:g}".format(
            *(sum(float(row[key]) for row in side) for side in zip(*pairs, strict=True))
        )

    if not pairs:
        return f"| `{rule}` | {_number(getattr(Limits(), rule))} | 0 | | | | | |"
    hits = [[hit for row in side for hit in row["covered"]] for side in zip(*pairs, strict=True)]
    held = " → ".join(f"{sum(side)}/{len(side)}" for side in hits)
    ratios = [after["left_out"] / before["left_out"] for before, after in pairs if _both(before, after)]
    worse = f"{np.exp(np.mean(np.log(ratios))):.3f}" if ratios else ""
    changed = sum(any(before[key] != after[key] for key in FIGURES) for before, after in pairs)
    return (
        f"| `{rule}` | {_number(getattr(Limits(), rule))} | {len(pairs)} | {changed} | {total('right')} "
        f"| {total('false')} | {total('wrong')} | {held} | {worse} |"
    )


def _both(before: dict[str, Any], after: dict[str, Any]) -> bool:
    return bool(before["left_out"] and after["left_out"])


def _number(value: float) -> str:
    return f"{value:g}"


def table(rows: Iterable[str]) -> str:
    """Markdown."""
    head = "| rule | value | decides in | changes | right | false | wrong name | in 95 % | left out × |"
    return "\n".join([head, "|" + "---|" * 9, *rows])


def numbers() -> str:
    """The numbers of the trace with their origins, as Markdown."""
    rows = ["| number | value | off | origin | what it is |", "|---|---|---|---|---|"]
    for field in dataclasses.fields(Limits):
        off = field.metadata["off"]
        shown = "" if off is None else _number(off).replace("inf", "∞")
        words = f"{field.metadata['origin']} | {field.metadata['why']}"
        rows.append(f"| `{field.name}` | {_number(field.default)} | {shown} | {words} |")
    return "\n".join(rows)


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=300, help="of each kind (default 300)")
    parser.add_argument("--ladder", type=int, default=300, help="of the challenge (default 300)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rules", default="", help="names, by default every rule")
    parser.add_argument("--work", type=Path, default=Path("/tmp/ablation"), help="sessions and answers")
    parser.add_argument("--records", type=Path, help="write there what the first run stated")
    parser.add_argument("--numbers", action="store_true", help="only print the table of the numbers")
    options = parser.parse_args()
    if options.numbers:
        print(numbers())
        return 0
    wanted = [rule for rule in options.rules.split(",") if rule] or list(RULES)
    unknown = [rule for rule in wanted if rule not in RULES]
    if unknown:
        parser.error(f"{unknown[0]} is no rule; known: {', '.join(RULES)}")

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    options.work /= str(options.seed)  # sessions and answers of another seed are others
    options.work.mkdir(parents=True, exist_ok=True)
    out = options.work / "answers.jsonl"
    every = [(kind, k, "") for kind in KINDS for k in range(options.sessions)]
    every += [(LADDER, k, "") for k in range(options.ladder)]
    usual = run(options, out, every)
    print(f"{len(usual)} sessions with every rule", file=sys.stderr)
    if options.records:
        options.records.write_text("".join(json.dumps(row["record"]) + "\n" for row in usual))
    lines = []
    for rule in wanted:
        concerned = [row for row in usual if rule in row["decided"]]
        without = run(options, out, [(row["kind"], row["index"], rule) for row in concerned])
        lines.append(line(rule, list(zip(concerned, without, strict=True))))
        print(lines[-1], file=sys.stderr)
    print(table(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
