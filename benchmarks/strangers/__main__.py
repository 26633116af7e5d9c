"""Run the benchmark: `python -m benchmarks.strangers --sessions 60 --seed 1 --jobs 2`."""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import adis_gonio

from .kinds import FAMILIES, KINDS
from .score import Verdict, badness, judge, rate_table, sentence, verdict_of, verdict_record
from .session import consult_oracle, session_of

BULKY = {"detectable", "measurements", "next", "overrides", "rivals"}
"""Parts of the tool's document that the file of results leaves out."""


def trace_session(index: int, seed: int) -> dict[str, Any]:
    """Write a session, trace it as a user does, and judge the document."""
    session = session_of(index, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.csv"
        path.write_text(session.csv, encoding="utf-8")
        start = time.process_time()
        try:
            document = adis_gonio.trace(adis_gonio.load_session(path)).as_dict()
        except Exception as error:
            return {"index": index, "kind": session.kind.name, "failed": f"{type(error).__name__}: {error}"}
    verdict = judge(session, consult_oracle(session), document, index, time.process_time() - start)
    kept = {key: value for key, value in document.items() if key not in BULKY}
    return {"verdict": verdict_record(verdict), "document": kept}


def judge_again(result: dict[str, Any], seed: int) -> dict[str, Any]:
    """Judge a stored document with the present rules."""
    if "failed" in result:
        return result
    index, seconds = result["verdict"]["index"], result["verdict"]["seconds"]
    session = session_of(index, seed)
    verdict = judge(session, consult_oracle(session), result["document"], index, seconds)
    return {**result, "verdict": verdict_record(verdict)}


def run_all(numbers: list[int], seed: int, jobs: int) -> Iterator[dict[str, Any]]:
    """Trace the sessions with these numbers, in order."""
    seeds = [seed] * len(numbers)
    if jobs == 1:
        yield from map(trace_session, numbers, seeds)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(trace_session, numbers, seeds)


def print_summary(results: list[dict[str, Any]], worst: int) -> None:
    """Print the rates over all sessions and by family, failures, and the worst sessions."""
    verdicts = [verdict_of(result["verdict"]) for result in results if "verdict" in result]
    kinds = {verdict.kind for verdict in verdicts}
    print(f"{len(verdicts)} sessions, {len(kinds)} kinds\n{rate_table(verdicts)}")
    for family in FAMILIES:
        print(f"\n{family}\n{rate_table([one for one in verdicts if KINDS[one.kind].family == family])}")
    for result in results:
        if "failed" in result:
            print(f"failed: {result['index']} {result['kind']}: {result['failed']}")
    print("\nworst sessions", *map(sentence, _worst(verdicts, worst)), sep="\n")


def _worst(verdicts: list[Verdict], count: int) -> list[Verdict]:
    return sorted(verdicts, key=badness, reverse=True)[:count]


def write_csv(index: int, seed: int, path: Path) -> None:
    """Write the file of one session."""
    path.write_text(session_of(index, seed).csv, encoding="utf-8")


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.strangers", description=__doc__)
    parser.add_argument("--sessions", type=int, default=60, help="number of sessions")
    parser.add_argument("--seed", type=int, default=1, help="equal seeds give equal sessions")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all verdicts and documents")
    parser.add_argument(
        "--again", type=Path, metavar="FILE", help="judge the documents of such a file again"
    )
    parser.add_argument("--only", type=int, metavar="INDEX", help="trace this session alone")
    parser.add_argument(
        "--csv", type=Path, metavar="FILE", help="with --only: write its samples CSV, trace nothing"
    )
    parser.add_argument("--worst", type=int, default=5, help="sessions to list")
    asked = parser.parse_args()
    if asked.again:
        run = json.loads(asked.again.read_text(encoding="utf-8"))
        print_summary([judge_again(result, run["seed"]) for result in run["results"]], asked.worst)
        return
    if asked.csv:
        write_csv(asked.only or 0, asked.seed, asked.csv)
        return
    results = []
    for result in run_all(
        [asked.only] if asked.only is not None else list(range(asked.sessions)), asked.seed, asked.jobs
    ):
        results.append(result)
        line = sentence(verdict_of(result["verdict"])) if "verdict" in result else f"failed: {result}"
        print(line, file=sys.stderr, flush=True)
        if asked.json:
            document = {"seed": asked.seed, "results": results}
            asked.json.write_text(json.dumps(document), encoding="utf-8")
    print_summary(results, asked.worst)


if __name__ == "__main__":
    main()
