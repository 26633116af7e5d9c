"""Sessions on disk, runners over them, scores out of them."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from . import answers, oracle, scoring
from .generator import Truth, draw
from .runners import SEES_CHECK_READINGS, runner

TIMEOUT_S = 600


class ChallengeError(Exception):
    """Something that the user of the benchmark has to put right; one line."""


def make(
    secret: str, count: int, sessions: Path, truths: Path, first: int = 0, family: str | None = None
) -> None:
    """Write `count` sessions, each in a directory of its own, and their truths elsewhere."""
    if truths.resolve().is_relative_to(sessions.resolve()):
        raise ChallengeError(f"{truths}: the truth must not lie within {sessions}, where runners run")
    truths.mkdir(parents=True, exist_ok=True)
    for number in range(first, first + count):
        csv, truth = draw(secret, number, family)
        folder = sessions / truth.id
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "session.csv").write_text(csv, encoding="utf-8")
        truth.save(truths / f"{truth.id}.json")


def blind(csv: str) -> str:
    """A samples CSV without what the check dwells read.

    In the plane their acceleration cells are empty. In space, where a pose is not declared, one cell of
    a row is: the largest of the three, as the mean of the dwell says; column `hidden_sign` holds its
    sign. Each check dwell keeps one row, its mean.
    """
    lines = csv.splitlines()
    at = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    head = lines[at].split(",")
    axes = [head.index(name) for name in ("ax", "ay", "az") if name in head]
    use = head.index("use")
    space = any(line.replace(" ", "") == "#plane:none" for line in lines[:at])
    out = [*lines[:at], lines[at] + (",hidden_sign" if space else "")]
    rows = [line.split(",") for line in lines[at + 1 :]]
    done = set()
    for row in rows:
        if row[use] != "check":
            out.append(",".join(row) + ("," if space else ""))
            continue
        position = row[head.index("position")]
        if position in done:
            continue
        done.add(position)
        dwell = [r for r in rows if r[head.index("position")] == position]
        mean = np.array([[float(r[i]) for i in axes] for r in dwell]).mean(axis=0)
        row = list(row)
        hidden = range(len(axes)) if not space else [int(np.argmax(np.abs(mean)))]
        for k, i in enumerate(axes):
            row[i] = "" if k in hidden else f"{mean[k]:.5f}"
        out.append(",".join(row) + (f",{np.sign(mean[hidden[0]]):+.0f}" if space else ""))
    return "\n".join(out) + "\n"


def heldout_of(truth: Truth, stated: dict[str, Any]) -> dict[str, float]:
    """`heldout_rms_mg` of predictions {position: {"ax": mg, …}}; as stated where a runner may state it."""
    if not stated or "heldout_rms_mg" in stated:
        return stated
    linear = truth.problem()
    c = linear.c
    residual = np.zeros((c.n, c.axes))
    measured = np.array(truth.readings_mg)
    for k in np.flatnonzero(c.check):
        cell = stated.get(str(k))
        if not isinstance(cell, dict) or not cell:
            raise answers.AnswerError(f"heldout: position {k} is a check dwell and has no prediction")
        for i, axis in enumerate(("ax", "ay", "az")[: c.axes]):
            if axis in cell:
                residual[k, i] = measured[k, i] - float(cell[axis])
    rows = linear.to_rows @ residual.T.ravel()
    return {"heldout_rms_mg": oracle.heldout_rms(linear, rows, np.radians(truth.fixture_deg))}


class _TooLongError(Exception):
    pass


def _alarm(*_: object) -> None:
    raise _TooLongError


def run(
    sessions: Path, truths: Path, out: Path, name: str, command: str | None = None,
    tell: Callable[[str], None] = lambda _: None, deadline_s: float = float("inf"),
) -> int:  # fmt: skip
    """Run an entrant over all sessions that `out` does not hold yet; adds one JSON line a session.

    Parameters
    ----------
    name : str
        One of RUNNERS, `oracle`, or a name for `command`.
    command : str, optional
        A program; it is called with a directory that holds `session.csv` and writes `answer.json` there.
    deadline_s : float
        No session is begun after that many seconds.

    Returns
    -------
    int
        Number of answers that broke the contract or took too long.
    """
    done = (
        {json.loads(line)["id"] for line in out.read_text("utf-8").splitlines()} if out.exists() else set()
    )
    begun, bad = time.monotonic(), 0
    paths = sorted(truths.glob("*.json"))
    if not paths:
        raise ChallengeError(f"{truths}: no truth files; make sessions first")
    for path in paths:
        truth = Truth.load(path)
        if truth.id in done:
            continue
        if time.monotonic() - begun > deadline_s:
            break
        started = time.process_time() if not command else time.monotonic()
        error = None
        try:
            answer = oracle.answer(truth) if name == "oracle" else _ask(sessions / truth.id, name, command)
            answer = answers.checked(answer, truth.id)
            seconds = (time.process_time() if not command else time.monotonic()) - started
            answer["heldout"] = heldout_of(truth, answer["heldout"])
        except ChallengeError:
            raise
        except _TooLongError:
            error, answer, seconds = f"more than {TIMEOUT_S} s", answers.empty(), float(TIMEOUT_S)
        except answers.AnswerError as problem:
            error, answer, seconds = str(problem), answers.empty(), 0.0
        except Exception as problem:  # an entrant's failure must not end the run
            error = f"{type(problem).__name__}: {str(problem).splitlines()[0] if str(problem) else ''}"
            answer, seconds = answers.empty(), 0.0
        if error:
            bad += 1
            tell(f"{truth.id}: {error}")
        with out.open("a", encoding="utf-8") as file:
            file.write(
                json.dumps({"id": truth.id, "seconds": seconds, "error": error, "answer": answer}) + "\n"
            )
    return bad


def _ask(folder: Path, name: str, command: str | None) -> dict[str, Any]:
    """An entrant's answer; it sees a directory that holds nothing but the session."""
    with tempfile.TemporaryDirectory() as temporary:
        there = Path(temporary)
        csv = (folder / "session.csv").read_text(encoding="utf-8")
        sees = not command and name in SEES_CHECK_READINGS
        (there / "session.csv").write_text(csv if sees else blind(csv), encoding="utf-8")
        if command:
            return _external(command, there)
        old = signal.signal(signal.SIGALRM, _alarm)
        signal.alarm(TIMEOUT_S)
        try:
            return runner(name)(there)
        finally:
            signal.alarm(0)
            signal.signal(signal.SIGALRM, old)


def _external(command: str, there: Path) -> dict[str, Any]:
    program = shutil.which(command.split()[0])
    if program is None:
        raise ChallengeError(f"{command.split()[0]}: no such program")
    try:
        done = subprocess.run(
            [program, *command.split()[1:], str(there)],
            capture_output=True,
            timeout=TIMEOUT_S,
            check=False,
            text=True,
        )
    except subprocess.TimeoutExpired:
        raise _TooLongError from None
    if done.returncode:
        words = done.stderr.strip().splitlines()
        raise answers.AnswerError(
            f"the runner ended with status {done.returncode}: {words[-1] if words else 'no word'}"
        )
    return answers.load(there / "answer.json")


def records(truths: Path, answered: Path, by_oracle: Path | None) -> list[scoring.Record]:
    """Scores of all answered sessions."""
    told = {}
    if by_oracle is not None:
        told = {
            row["id"]: row["answer"] for row in map(json.loads, by_oracle.read_text("utf-8").splitlines())
        }
    out = []
    for line in answered.read_text("utf-8").splitlines():
        row = json.loads(line)
        truth = Truth.load(truths / f"{row['id']}.json")
        record = scoring.score(truth, answers.checked(row["answer"]), told.get(row["id"]), row["seconds"])
        out.append(record | {"error": row["error"]})
    return out
