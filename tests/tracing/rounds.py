"""Blind rounds: one process writes the files, another traces them and sees nothing else, a third judges.

Sessions come from their seed, so that the judge draws the truth again instead of being told.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tracing import blind as planar, space
from tracing.blind import Blind
from tracing.verdict import Verdict, failed, judge

Tracer = Callable[[str], dict[str, Any]]


def write_session(path: str, kind: str, seed: int, index: int) -> str:
    """Write one session to `path`; what it hides stays in this process."""
    world = space if kind.startswith(space.SPACE) else planar
    world.write(Path(path), *_draw(kind, seed, index))
    return path


def _draw(kind: str, seed: int, index: int) -> tuple[Blind, Any]:
    return (space if kind.startswith(space.SPACE) else planar).draw(kind, seed, index)


def trace_file(path: str) -> dict[str, Any]:
    """The product's answer to a file, as its JSON says it; an exception becomes {"failure": …}."""
    from adis_gonio import load_session, trace  # only the tracing process loads the product

    begin = time.perf_counter()
    try:
        result: dict[str, Any] = json.loads(json.dumps(trace(load_session(Path(path))).as_dict()))
    except Exception:  # any failure is an answer, and counts as a wrong one
        result = {"failure": traceback.format_exc()}
    result["seconds"] = time.perf_counter() - begin
    return result


def judge_answer(answer: dict[str, Any], kind: str, seed: int, index: int) -> Verdict:
    """Draw the truth again and judge; a tracer that raised is wrong in every respect."""
    blind, _ = _draw(kind, seed, index)
    if "failure" in answer:
        where = f"{kind} {seed}/{index} ({blind.bench.setting})"
        return failed(blind, f"{where}:\n{answer['failure']}", answer["seconds"])
    return judge(blind, answer, answer["seconds"])


@contextmanager
def crew(jobs: int) -> Iterator[tuple[ProcessPoolExecutor, ProcessPoolExecutor]]:
    """Processes that write and judge, and others that trace."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, fresh) as bench, ProcessPoolExecutor(jobs, fresh) as tracer:
        yield bench, tracer


def rounds(
    kind: str,
    indices: Sequence[int],
    seed: int,
    pools: tuple[ProcessPoolExecutor, ProcessPoolExecutor],
    tracer: Tracer = trace_file,
) -> list[Verdict]:
    """Verdicts of the sessions of a kind, in the order of `indices`."""
    bench, tracing = pools
    with tempfile.TemporaryDirectory(prefix="blind-") as folder:
        paths = [str(Path(folder) / f"session_{k}.csv") for k in range(len(indices))]
        draw_one = partial(_star, write_session, kind, seed)
        written = list(bench.map(draw_one, paths, indices, chunksize=4))
        answers = list(tracing.map(tracer, written, chunksize=2))
    return list(bench.map(partial(_star, judge_answer, kind, seed), answers, indices, chunksize=4))


def _star(function: Callable[..., Any], kind: str, seed: int, first: Any, index: int) -> Any:
    return function(first, kind, seed, index)
