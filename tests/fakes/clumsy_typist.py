"""A clumsy person before `calibrate --plain`: the program itself, with prompts read and lines typed.

The program runs by itself, on a pipe or (with questions about operator, serial number and stage) in a
pseudo-terminal; its bus is `hand:` (`fakes.hand_part`), moved by a file.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from adis_gonio.bench.guidance import to_do
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.plans import Position, extension, plan
from fakes.clumsy import Manner, Person
from fakes.clumsy_sessions import FIXTURE_DEG, MOST_RUNS, Outcome, Task, judge
from fakes.hand_part import HandPart

PATIENCE_S = 120.0
"""Without a prompt for so long a program hangs."""

TESTS = Path(__file__).parents[1]
GUARD_KEYS = {"retake": "r", "keep": "k", "skip": "s", "reverse": "v"}
GUARD_WORDS = {"go back": "retake", "keep it as it is": "keep", "skip": "skip"}
KEYS = {
    "confirm": "", "accept": "", "unpause": "", "decline": "n", "repeat": "r", "undo": "u", "pause": "p",
    "quit": "q", "skip": "s", "note": "n what is this?",
}  # fmt: skip
ASKED = re.compile(
    r"(?P<metadata>\(Enter: none\): $)"
    r"|(?P<note>  note: $)"
    r"|(?P<paused>paused: .* goes on: $)"
    r"|(?P<more>  Go on with 180°, 270°\? .* help\): $)"
    r"|(?P<guard>  Enter: .*, n note, \? help\): $)"
    r"|(?P<position>\d+ of \d+.*, n note, \? help\): $)",
)


def plugin(folder: Path) -> dict[str, str]:
    """Environment in which programs know the bus `hand:`."""
    info = folder / "hand-1.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hand\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[adis_gonio.bus]\nhand = fakes.hand_part:open_from_url\n")
    paths = [str(folder), str(TESTS), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TERM": "dumb", "COLUMNS": "200"}


class Program:
    """`calibrate --plain`, with what it says."""

    def __init__(self, command: list[str], environment: Mapping[str, str], *, terminal: bool) -> None:
        import pty

        ours, theirs = pty.openpty() if terminal else os.pipe()[::-1]
        self.terminal, self._typed = terminal, ours
        self.running = subprocess.Popen(
            command, stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment
        )
        os.close(theirs)
        self.said = ""
        self._seen = 0

    def prompt(self) -> re.Match[str] | None:
        """The next question; None where the program has ended."""
        assert self.running.stdout is not None
        pipe, end_s = self.running.stdout.fileno(), time.monotonic() + PATIENCE_S
        kept = b""
        while True:
            found = ASKED.search(self.said[self._seen :].rpartition("\n")[2])
            if found is not None:
                self._seen = len(self.said)
                return found
            if not select.select([pipe], [], [], max(end_s - time.monotonic(), 0))[0]:
                self.running.kill()
                raise TimeoutError(f"no prompt for {PATIENCE_S:g} s after: {self.said[-300:]}")
            read = os.read(pipe, 65536)
            if not read:
                return None
            kept += read
            try:
                self.said += kept.decode()
                kept = b""
            except UnicodeDecodeError:  # cut within a character
                continue

    def type(self, line: str) -> None:
        """Type a line; nobody may be there to read it."""
        with contextlib.suppress(OSError):
            os.write(self._typed, f"{line}\n".encode())

    def end(self) -> int:
        """Close the input and wait; the exit status."""
        os.close(self._typed)
        try:
            while self.prompt() is not None:
                pass
        finally:
            assert self.running.stdout is not None
            self.running.stdout.close()
        return self.running.wait(timeout=PATIENCE_S)


class Typist:
    """Reads the program's prompts to a person, and types what the person says."""

    def __init__(self, person: Person, part: HandPart, positions: list[Position], outcome: Outcome) -> None:
        self._person, self._part, self._outcome = person, part, outcome
        self._positions = positions
        self._place = 0
        self._reversed = False

    def answer(self, program: Program, asked: re.Match[str], control: Path) -> bool:
        """Do what a question leads to; False where the person walks away for good."""
        kind, text = str(asked.lastgroup), asked.group()
        if kind in ("metadata", "note"):
            program.type("")
            return True
        self._keys = KEYS
        for step in self._steps(kind, text):
            verb, _, rest = step.partition(" ")
            match verb:
                case "still" | "rest":
                    self._do("sleep 5", control)
                case "dwell" if rest == "quit":
                    self._interrupt = True
                case "dwell":
                    self._late = KEYS[rest]
                case "say":
                    if not self._say(program, rest):
                        return False
                case _:
                    self._do(step, control)
        return True

    _interrupt = False
    _late: str | None = None

    def _steps(self, kind: str, text: str) -> list[str]:
        person = self._person
        match kind:
            case "paused":
                return person.at_pause()
            case "more":
                steps = person.at_extension()
                longer = extension(plan("two-position"), 2)
                if steps == ["say accept"] and longer is not None:
                    self._positions = list(longer.positions)
                return steps
            case "guard":
                self._keys = KEYS | GUARD_KEYS
                answers = [name for name, key in GUARD_KEYS.items() if f"{key} " in text.partition("(")[2]]
                answers = [name for name in answers if re.search(rf"[(,] ?{GUARD_KEYS[name]} ", text)]
                default = next(n for words, n in GUARD_WORDS.items() if f"Enter: {words}" in text)
                self._outcome.guards.append("?")
                return person.at_guard("?", answers, default, self._place)
        todo = re.search(r"\d+ of \d+(?: \(about .* left\))?: (.*) and press Enter", text)
        assert todo is not None, text
        self._place = next(
            k
            for k, position in enumerate(self._positions)
            if todo[1] == to_do(position) or todo[1].endswith(f" {position}")
        )
        return person.at_position(self._place, ", u undo" in text, self._reversed)

    def _do(self, line: str, control: Path) -> None:
        with control.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
        name, *numbers = line.split()
        if name == "turn":
            self._part.angle_deg, self._part.direction = float(numbers[0]), None
        elif name == "orient":
            self._part.direction = tuple(map(float, numbers))
        elif name == "knock":
            self._part.slipped_deg += float(numbers[1])
        elif name == "nudge":
            self._part.angle_deg += float(numbers[1])

    def _say(self, program: Program, key: str) -> bool:
        if key == "quit" and self._person.comes_back():
            return False  # the input ends: the person has gone
        self._reversed ^= key == "reverse"
        program.type(self._person.nonsense() if key == "nonsense" else self._keys[key])
        if self._late is not None:
            program.type(self._late)
            self._late = None
        if self._interrupt:
            self._interrupt = False
            time.sleep(0.3)
            program.running.send_signal(signal.SIGINT)
        return True


def by_typing(task: Task, folder: Path, manner: Manner | None = None) -> Outcome:
    """Let a person go through a session of the program to its end."""
    part, chosen = HandPart(task.seed), plan(task.plan, task.positions)
    places = [p.direction if p.angle_deg is None else p.angle_deg for p in chosen.positions]
    person = Person(task.seed, places, FIXTURE_DEG, manner, task.only)
    path, control = folder / f"{task.seed}.session", folder / f"{task.seed}.control"
    outcome = Outcome(task, person.blunders, said=[str(path)])
    typist, environment = Typist(person, part, list(chosen.positions), outcome), plugin(folder)
    program = [sys.executable, "-m", "adis_gonio", "calibrate", "--plain", "-o", str(path)]
    for run in range(MOST_RUNS):
        control.write_text("")
        url = (
            f"hand:?seed={task.seed}&powered={run}&angle={part.angle_deg}&slipped={part.slipped_deg}"
            f"&virtual={int(task.seed % 3 > 0)}&control={control}"
        )
        begin = ["--plan", task.plan, "--dwell", "0.5", "--settle", "0.1", "--fixture", str(FIXTURE_DEG)]
        begin += [] if task.positions is None else ["--positions", str(task.positions)]
        command = [*program, url, *(["--resume"] if path.exists() else begin)]
        running = Program(command, environment, terminal=task.seed % 2 == 0)
        outcome.runs += 1
        status = _one_run(running, typist, control, person, outcome)
        if status is None:
            return outcome
        _check_words(running, status, path, outcome)
        outcome.complete = _complete(path)
        interrupted = status == 130  # perhaps after the last dwell: then the answer has not been seen
        if (outcome.complete and not interrupted) or person.exhausted or not person.comes_back():
            break
    if person.exhausted or outcome.runs == MOST_RUNS:
        outcome.trouble.append("dead end")
    outcome.questions = person.questions
    if path.exists():
        judge(outcome, path, part.truth())
        if outcome.status != status:
            outcome.trouble.append(f"exit status {status}, not {outcome.status}: {running.said[-500:]}")
    return outcome


def _one_run(
    program: Program, typist: Typist, control: Path, person: Person, outcome: Outcome
) -> int | None:
    try:
        while (asked := program.prompt()) is not None and not person.exhausted:
            if not typist.answer(program, asked, control):
                break
        return program.end()
    except TimeoutError as error:
        outcome.trouble.append(f"hangs: {error}")
        return None


def _complete(path: Path) -> bool:
    if not path.exists():
        return False
    with ArchiveView(path) as view:
        return not view.pending()


def _check_words(program: Program, status: int, path: Path, outcome: Outcome) -> None:
    """No traceback, and every dwell that was announced is in the archive with as many samples."""
    said = program.said
    if "Traceback" in said or status not in (0, 1, 130):
        outcome.trouble.append(f"status {status}: {said[-1500:]}")
    if not path.exists():
        return
    with ArchiveView(path) as view:
        run = len(view.runs())
        kept = [a for a in view.attempts() if a.run == run]
        sizes = [sum(map(len, view.blocks(a, "dwell"))) for a in kept if a.outcome == "complete"]
    announced = [int(count) for count in re.findall(r" mg   (\d+) samples", said)]
    if sizes[: len(announced)] != announced:
        outcome.trouble.append(f"announced {announced} samples, kept {sizes}")
    if said.count("interrupted:") > sum(a.outcome != "complete" for a in kept):
        outcome.trouble.append("an interrupted dwell is not in the archive")


__all__ = ["by_typing"]
