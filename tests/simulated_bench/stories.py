"""Stories of the bench: what a seed draws, and how a person reads it.

A story is data: the bench, and steps, each one command with the faults around it. `draw` makes it from a
seed, `play` runs it and checks every invariant after each step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from simulated_bench.bench import LINE_KINDS, PATIENCE_S, SHAKE, SHORT, URL, Bench, Ended, LineFault
from simulated_bench.disk import FAILURES, SIDES, DiskFault
from simulated_bench.forging import FORGERIES, forge
from simulated_bench.invariants import Record, check

SESSION = "a.session"
PLANS = (
    ("two-position", 2, 0.2),
    ("four-position", 4, 0.45),
    ("mmpm", 9, 0.1),
    ("tumble", 4, 0.15),
    ("poses", 9, 0.1),
)
IN_SPACE = ("tumble", "poses")
COMMANDS = ("fit", "angle", "export", "write", "write --save", "undo", "status", "serve")
SHARES = (0.06, 0.08, 0.16, 0.24, 0.12, 0.1, 0.1, 0.14)
"""Share of each command after a session."""
CALIBRATE, AFRESH, NIGHT, POWER = "calibrate", "calibrate afresh", "night", "power"
SELF_TEST, OFFSET = "self-test on", "offset by hand"
HAND_LSB = 40
SIGNS = (0x100, 0x200)
"""Bits of the manual self-test: positive, negative."""
LENGTHS = {
    "fit": (0.1, 4), "angle": (1.5, 4), "export": (0.1, 9), "write": (6.0, 28), "write --save": (6.0, 34),
    "undo": (0.5, 29), "status": (0.4, 5), "serve": (8.0, 0), "bringup": (10.0, 10),
}  # fmt: skip
"""Time in s and number of operations of the disk that a command takes: faults are drawn from them."""
MOST_TRIES = 4
FORGED_PATIENCE_S = 300.0
"""A forged session may ask for a dwell of a year: no virtual time is spent on it."""


@dataclass(frozen=True)
class Step:
    """One command, or what happens between two commands, with its faults.

    Attributes
    ----------
    command : str
        `calibrate` (begins or resumes), `calibrate afresh` (with --force), one of `COMMANDS`, `night`
        (nobody is there for `hours`), `power` (the part is switched off and on), `self-test on` or
        `offset by hand` (somebody writes to a register), or a key of `FORGERIES` (a stranger changes the
        session file).
    line : tuple of LineFault
    disk : DiskFault or None
    interrupt_s : float or None
        When Ctrl-C comes.
    hours : float
    draw : int
        Draws what a stranger changes, the sign of the self-test, and the clients of `serve`.
    """

    command: str
    line: tuple[LineFault, ...] = ()
    disk: DiskFault | None = None
    interrupt_s: float | None = None
    hours: float = 0.0
    draw: int = 0

    @property
    def faults(self) -> int:
        """Number of faults around the command."""
        return len(self.line) + (self.disk is not None) + (self.interrupt_s is not None)


@dataclass(frozen=True)
class Story:
    """A bench and its steps; `only` as in `Bench`."""

    seed: int
    steps: tuple[Step, ...]
    motor: bool = False
    streams: bool = True
    plan: str = "four-position"
    positions: int | None = None
    drift_c_per_h: float = 0.0
    dwell_s: float = 0.5
    only: str = ""
    patience_s: float = PATIENCE_S


@dataclass
class Outcome:
    """What became of a story.

    Attributes
    ----------
    wrong : list of str
        Invariants that did not hold, each with its step.
    ended : list of Ended
    hours, measured_hours : float
        Virtual time, and the part of it in which a command ran.
    off : dict of str to float
        Error of each value of the last answer with exit status 0, in units of its U.
    lied : bool
        The operator put the part elsewhere than was said, which few positions cannot show.
    digest : str
        Digest of all output and of all files at the end.
    told : list of str
        The story in lines for people.
    """

    story: Story
    wrong: list[str] = field(default_factory=list)
    ended: list[Ended] = field(default_factory=list)
    hours: float = 0.0
    measured_hours: float = 0.0
    off: dict[str, float] = field(default_factory=dict)
    lied: bool = False
    digest: str = ""
    told: list[str] = field(default_factory=list)


# -- drawing -------------------------------------------------------------------------------------------


def draw(seed: int) -> Story:
    """Draw a story from its seed."""
    rng = np.random.default_rng([seed, 35])
    names, counts, shares = zip(*PLANS, strict=True)
    which = int(rng.choice(len(names), p=shares))
    plane = names[which] not in IN_SPACE
    motor = plane and bool(rng.random() < 0.7)
    story = Story(
        seed,
        (),
        motor=motor,
        streams=bool(rng.random() < 0.6),
        plan=names[which],
        positions=counts[which],
        drift_c_per_h=float(rng.choice([0.0, 0.0, 0.5, -2.0])),
        only="" if rng.random() < 0.25 else "none",
    )
    steps: list[Step] = []
    if rng.random() < 0.16:
        command = str(rng.choice(["bringup", "serve"]))
        steps.append(_step(rng, command, *LENGTHS[command], share=0.6))
    for number in range(int(rng.integers(1, 3))):
        command = AFRESH if number and rng.random() < 0.15 else CALIBRATE
        length_s, share = 4.0 + 3.0 * counts[which], 0.4 if number else 0.8
        steps.append(_step(rng, command, length_s, 30 * counts[which], share))
        steps += _between(rng, motor=motor)
    if rng.random() < 0.6:
        steps.append(Step(CALIBRATE))
    for _ in range(int(rng.integers(1, 5))):
        command = str(rng.choice(COMMANDS, p=SHARES))
        steps.append(_step(rng, command, *LENGTHS[command], share=0.6))
        steps += _between(rng, motor=motor)
    return replace(story, steps=tuple(steps))


def _between(rng: np.random.Generator, *, motor: bool) -> list[Step]:
    """Draw what happens between two commands; an operator has no plan on the wall for a forged session."""
    kind = rng.random()
    if kind < 0.15:
        return [Step(NIGHT, hours=float(rng.choice([0.2, 2.0, 8.0, 14.0])))]
    if kind < 0.23:
        return [Step(POWER)]
    if kind < 0.33:
        return [Step(SELF_TEST if kind < 0.28 else OFFSET, draw=int(rng.integers(2)))]
    if kind < 0.43 and motor:
        return [Step(str(rng.choice([*FORGERIES])), draw=int(rng.integers(1 << 16)))]
    return []


def _step(rng: np.random.Generator, command: str, length_s: float, operations: int, share: float) -> Step:
    """Draw the faults around a command that takes about so many seconds and operations of the disk."""
    step = Step(command, draw=int(rng.integers(1 << 16)) if command == "serve" else 0)
    if rng.random() >= share:
        return step
    kind = rng.random()
    if kind < 0.5 and operations:
        step = replace(step, disk=_disk_fault(rng, operations))
    if kind > 0.4 or not operations:
        count = 1 + int(rng.random() < 0.2)
        step = replace(step, line=tuple(_line_fault(rng, length_s) for _ in range(count)))
    if kind > 0.9 or 0.2 < kind < 0.35:
        step = replace(step, interrupt_s=round(float(rng.uniform(0, length_s)), 2))
    return step


def _disk_fault(rng: np.random.Generator, operations: int) -> DiskFault:
    kind = str(
        rng.choice(["kill", "cut", *FAILURES, "slow", "interrupt"], p=[0.3, 0.3, 0.1, 0.05, 0.1, 0.05, 0.1])
    )
    number = 1 + int(rng.integers(operations if rng.random() < 0.8 else min(operations, 10)))
    return DiskFault(kind, number, str(rng.choice(SIDES)))


def _line_fault(rng: np.random.Generator, length_s: float) -> LineFault:
    kind = str(rng.choice(LINE_KINDS))
    sizes = {SHORT: [1.0, 2.0, 3.0], SHAKE: [0.5, 3.0, 20.0, 300.0]}
    size = float(rng.choice(sizes.get(kind, [0.5, 3.0, 20.0])))
    at_s = rng.uniform(0, length_s) if rng.random() < 0.85 else rng.uniform(0, 0.3)
    return LineFault(kind, round(float(at_s), 3), size)


# -- playing -------------------------------------------------------------------------------------------


class Play:
    """A story that is being played; `do` takes its steps one by one, `finish` brings it to its end.

    Attributes
    ----------
    journal : bool
        The last command found the journal of a killed program.
    """

    def __init__(
        self, story: Story, folder: Path, observe: Callable[[Play, Step, Ended], object] | None = None
    ) -> None:
        self.story = story
        self.journal = False
        self._observe = observe
        self.bench = Bench(
            story.seed,
            folder,
            motor=story.motor,
            streams=story.streams,
            plan=story.plan,
            positions=story.positions,
            drift_c_per_h=story.drift_c_per_h,
            only=story.only,
        )
        self.outcome = Outcome(story)
        self.record = Record(self.bench)
        self._afresh = False

    def do(self, step: Step) -> Ended | None:
        """Take a step and check the invariants; None if it was no command."""
        outcome, bench = self.outcome, self.bench
        if step.command == NIGHT:
            bench.wait(3600 * step.hours)
            outcome.told.append(f"{step.hours:g} hours pass")
            return None
        if step.command == POWER:
            bench.switch_part_off_and_on()
            self.record.note_power()
            outcome.told.append("the part is switched off and on")
            return None
        if step.command in FORGERIES:
            if self.record.readable():
                what = forge(bench.folder / SESSION, step.command, step.draw)
                self.record.note_forgery()
                outcome.told.append(f"a stranger changes {what}")
            return None
        self._afresh |= step.command == AFRESH
        words = self._words(step)
        if words is None:
            return None
        self.record.found, self.record.controls_before = self.record.offsets(), self.record.controls()
        self.journal = any(bench.folder.glob("*-journal"))
        did = len(bench.operator.did)
        ended = bench.run(
            words,
            line=step.line,
            disk=step.disk,
            interrupt_s=step.interrupt_s,
            patience_s=min(self.story.patience_s, FORGED_PATIENCE_S if self.record.forged else PATIENCE_S),
            draw=step.draw,
        )
        if step.command == OFFSET:
            self.record.note_hand()
        outcome.ended.append(ended)
        outcome.told += _tell(step, ended, bench, bench.operator.did[did:])
        found = check(self.record, ended, step, self.story)
        outcome.wrong += [f"{text} (after '{' '.join(words)}')" for text in found.wrong]
        if found.off:
            outcome.off, outcome.lied = found.off, found.lied
        self._afresh = "begin a new session" in ended.err
        outcome.measured_hours += (ended.ended_s - ended.began_s) / 3600
        if self._observe is not None:
            self._observe(self, step, ended)
        return ended

    def finish(self) -> None:
        """Nothing goes wrong any more: the session has to come to its end, with a right answer."""
        bench, outcome = self.bench, self.outcome
        bench.operator.become_careful()
        last = None
        for attempt in range(MOST_TRIES):
            if attempt == 2:
                self.do(Step(POWER))
            if attempt == 3:
                self._afresh = True
            last = self.do(Step(CALIBRATE))
            if last is None or outcome.wrong or last.status == 0:
                break
        if last is not None and last.status != 0 and not outcome.wrong:
            outcome.wrong.append(f"no way leads to a complete session: {last.last_line}")
        if not outcome.wrong:
            self.do(Step("status"))
            self.do(Step("fit"))

    def close(self) -> Outcome:
        """Return the outcome."""
        outcome = self.outcome
        outcome.hours = self.bench.now_s / 3600
        digest = hashlib.sha256()
        for ended in outcome.ended:
            digest.update(repr(ended).encode())
        for path in sorted(self.bench.folder.iterdir()):
            digest.update(path.name.encode() + path.read_bytes())
        outcome.digest = digest.hexdigest()[:16]
        return outcome

    def _words(self, step: Step) -> list[str] | None:
        """The command line of a step, as the operator types it; None if there is no session for it yet."""
        path, story, command = self.bench.folder / SESSION, self.story, step.command
        if command in (CALIBRATE, AFRESH):
            plain = ["--auto"] if story.motor else ["--plain"]
            if path.exists() and not self._afresh:
                return ["calibrate", URL, "--resume", *plain, "--json", "-o", SESSION]
            if path.exists():
                plain.append("--force")
                self.record.forget()
            self.bench.operator.new_session(story.plan, story.positions)
            positions = (
                []
                if story.plan in ("two-position", "four-position")
                else ["--positions", str(story.positions)]
            )
            times = ["--dwell", f"{story.dwell_s:g}", "--settle", "0.1"]
            fixture = [] if story.plan in IN_SPACE else ["--fixture", "0.02"]
            options = [*positions, *times, *fixture, *plain, "--json", "-o", SESSION]
            return ["calibrate", URL, "--plan", story.plan, *options]
        if command == "bringup":
            again = any(self.bench.folder.glob("board.*"))
            return ["bringup", URL, "-o", "board.html", *(["--force"] if again else [])]
        if command == SELF_TEST:
            word = self.bench.chip.inner.memory["MSC_CTRL"] | SIGNS[step.draw % 2]
            return ["registers", URL, f"MSC_CTRL=0x{word:X}", "--no-check"]
        if command == OFFSET:
            by_hand = f"XACCL_OFF={self.record.offsets()[0] + HAND_LSB}"
            return None if self.record.written() else ["registers", URL, by_hand]
        if command == "serve":
            return ["serve", URL]
        if not self.record.readable() and not self.record.forged:
            return None
        return {
            "fit": ["fit", SESSION, "--json"],
            "angle": ["angle", URL, "--cal", SESSION, "--json", "--seconds", "1", "--reconnect", "2"],
            "export": ["export", SESSION, "--format", "json", "-o", "cal.json", "--force"],
            "write": ["write", SESSION, URL, "--yes", "--dwell", "1", "--json"],
            "write --save": ["write", SESSION, URL, "--yes", "--save", "--dwell", "1", "--json"],
            "undo": ["write", SESSION, URL, "--undo", "--yes", "--json"],
            "status": ["write", SESSION, URL, "--status", "--json"],
        }[command]


def play(
    story: Story, folder: Path, observe: Callable[[Play, Step, Ended], object] | None = None
) -> Outcome:
    """Play a whole story in an empty folder; stop at the first invariant that does not hold.

    `observe` is called after each command.
    """
    run = Play(story, folder, observe)
    for step in story.steps:
        run.do(step)
        if run.outcome.wrong:
            break
    else:
        run.finish()
    return run.close()


def shrink(story: Story, fails: Callable[[Story], bool]) -> Story:
    """Leave out steps and faults for as long as the story still fails.

    Parameters
    ----------
    fails : callable
        Plays a story and returns True if it fails in the way that is looked for.
    """
    tried = True
    while tried:
        tried = False
        for smaller in _smaller(story):
            if fails(smaller):
                story, tried = smaller, True
                break
    return story


def _smaller(story: Story) -> Iterator[Story]:
    """Stories with one step, one fault or one circumstance less, the largest omissions first."""
    steps = story.steps
    for k in range(len(steps)):
        yield replace(story, steps=steps[:k])
        yield replace(story, steps=steps[:k] + steps[k + 1 :])
    for k, step in enumerate(steps):
        less = [replace(step, line=step.line[:n] + step.line[n + 1 :]) for n in range(len(step.line))]
        less += [replace(step, disk=None)] if step.disk is not None else []
        less += [replace(step, interrupt_s=None)] if step.interrupt_s is not None else []
        for one in less:
            yield replace(story, steps=(*steps[:k], one, *steps[k + 1 :]))
    if story.only != "none":
        yield replace(story, only="none")
    if story.drift_c_per_h:
        yield replace(story, drift_c_per_h=0.0)
    if story.plan != "four-position":
        yield replace(story, plan="four-position", positions=4)


# -- telling -------------------------------------------------------------------------------------------

_DISK_WORDS = {
    "kill": "the program is killed",
    "cut": "the computer loses its power",
    "full": "the disk is full from",
    "read-only": "the disk is read-only from",
    "broken": "the disk fails from",
    "slow": "the disk is slow from",
    "interrupt": "Ctrl-C",
}


def _tell(step: Step, ended: Ended, bench: Bench, did: Sequence[str]) -> list[str]:
    """Lines for people about a step."""
    lines = [f"adis-gonio {' '.join(ended.words)}   (at {ended.began_s:.1f} s)"]
    lines += [f"    operator, {what}" for what in did]
    lines += [f"    {what}" for what in ended.clients]
    lines += [f"    {fault.at_s:g} s later: {fault.kind} ({fault.size:g})" for fault in step.line]
    if step.disk is not None:
        where = bench.disk.acted or "never reached"
        side = f"{step.disk.side} " if step.disk.kind in ("kill", "cut") else ""
        lines.append(f"    {_DISK_WORDS[step.disk.kind]} {side}operation {step.disk.operation} ({where})")
    if step.interrupt_s is not None:
        lines.append(f"    {step.interrupt_s:g} s later: Ctrl-C")
    status = "" if ended.status is None else f" {ended.status}"
    return [*lines, f"    -> {ended.how}{status}: {ended.last_line[:300]}"]


def tell(outcome: Outcome) -> str:
    """The story as a person reads it, with the invariants that did not hold."""
    story = outcome.story
    stage = "a motor moves the stage" if story.motor else "the operator moves the part"
    head = f"seed {story.seed}: {story.plan}, {stage}"
    return "\n".join([head, *outcome.told, *(f"WRONG: {text}" for text in outcome.wrong)])
