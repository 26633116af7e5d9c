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

from simulated_bench.bench import KILL, LINE_KINDS, PATIENCE_S, SHAKE, SHORT, URL, Bench, Ended, LineFault
from simulated_bench.disk import SIDES, DiskFault
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
SHARES = {
    "fit": 0.06, "angle": 0.08, "export": 0.16, "write": 0.24, "write --save": 0.12, "undo": 0.1,
    "status": 0.1, "serve": 0.14,
}  # fmt: skip
"""Share of each command after a session."""
COMMANDS = tuple(SHARES)
CALIBRATE, AFRESH = "calibrate", "calibrate afresh"
NIGHT, POWER, OUTAGE, STRANGER = "night", "power", "outage", "stranger"
SELF_TEST, OFFSET = "self-test on", "offset by hand"
HAPPENINGS = {NIGHT: 0.3, POWER: 0.15, OUTAGE: 0.15, SELF_TEST: 0.1, OFFSET: 0.1, STRANGER: 0.2}
"""Share of each thing that happens between two commands."""
CAUSES = (0.4, 0.3, 0.25)
"""Probabilities of a fault of the disk, a fault of the line and Ctrl-C in a command in which any comes."""
HAPPENS = 0.45
"""Probability that something happens between two commands."""
DISK_SHARES = {
    "kill": 0.3, "cut": 0.3, "full": 0.1, "read-only": 0.05, "broken": 0.1, "slow": 0.05, "interrupt": 0.1,
}  # fmt: skip
AFTER_CRASH, OTHERWISE = 0.5, 0.15
"""Probability that a second session begins afresh after the first was killed, and otherwise."""
AGAIN = 0.25
"""Probability that the operator types the same command again."""
HAND_LSB = 40
SIGNS = (0x100, 0x200)
"""Bits of the manual self-test: positive, negative."""
LENGTHS = {
    "fit": (0.1, 4), "angle": (1.5, 4), "export": (0.1, 9), "write": (12.0, 28), "write --save": (12.0, 34),
    "undo": (0.5, 29), "status": (0.4, 5), "serve": (10.0, 0), "bringup": (10.0, 10),
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
        (nobody is there for `hours`), `power` (the part is switched off and on), `outage` (computer and
        part lose their power right after the command before), `self-test on` or `offset by hand` (somebody
        writes to a register), or a key of `FORGERIES` (a stranger changes the session file).
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

    @property
    def crashes(self) -> bool:
        """True if the program is killed or the computer loses its power."""
        killed = self.disk is not None and self.disk.kind in ("kill", "cut")
        return killed or any(fault.kind == KILL for fault in self.line)


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


@dataclass(frozen=True)
class _World:
    """What can happen in one story at all, with shares.

    Each story has about half of the commands, happenings and faults: those that it has come often enough to
    coincide ("swarm testing": Groce et al., ISSTA 2012).
    """

    rng: np.random.Generator
    commands: dict[str, float]
    happenings: dict[str, float]
    forgeries: dict[str, float]
    disk: dict[str, float]
    line: dict[str, float]

    @classmethod
    def draw(cls, rng: np.random.Generator, *, motor: bool) -> _World:
        # An operator has no plan on the wall for a forged session.
        happenings = {k: v for k, v in HAPPENINGS.items() if motor or k != STRANGER}
        same = ({**dict.fromkeys(kinds, 1.0)} for kinds in (FORGERIES, LINE_KINDS))
        forgeries, line = (_some(rng, shares) for shares in same)
        return cls(
            rng, _some(rng, SHARES), _some(rng, happenings), forgeries, _some(rng, DISK_SHARES), line
        )

    def command(self, before: str | None = None) -> str:
        """Draw a command after a session; the operator may type the one before again."""
        if before is not None and self.rng.random() < AGAIN:
            return before
        return _one(self.rng, self.commands)

    def between(self) -> list[Step]:
        """Draw what happens between two commands."""
        rng = self.rng
        if rng.random() >= HAPPENS:
            return []
        kind = _one(rng, self.happenings)
        if kind == NIGHT:
            return [Step(NIGHT, hours=float(rng.choice([0.2, 2.0, 8.0, 14.0])))]
        if kind in (SELF_TEST, OFFSET):
            return [Step(kind, draw=int(rng.integers(2)))]
        if kind == STRANGER:
            return [Step(_one(rng, self.forgeries), draw=int(rng.integers(1 << 16)))]
        return [Step(kind)]

    def step(self, command: str, length_s: float, operations: int, share: float) -> Step:
        """Draw the faults around a command that takes about so many seconds and operations of the disk."""
        rng = self.rng
        step = Step(command, draw=int(rng.integers(1 << 16)) if command == "serve" else 0)
        if rng.random() >= share:
            return step
        disk, line, interrupt = rng.random(3) < CAUSES
        if disk and operations:
            step = replace(step, disk=self._disk_fault(operations))
        if interrupt:
            step = replace(step, interrupt_s=round(float(rng.uniform(0, length_s)), 2))
        if line or step.faults == 0:
            count = 1 + int(rng.random() < 0.2)
            step = replace(step, line=tuple(self._line_fault(length_s) for _ in range(count)))
        return step

    def _disk_fault(self, operations: int) -> DiskFault:
        rng = self.rng
        number = 1 + int(rng.integers(operations if rng.random() < 0.8 else min(operations, 10)))
        return DiskFault(_one(rng, self.disk), number, str(rng.choice(SIDES)))

    def _line_fault(self, length_s: float) -> LineFault:
        rng = self.rng
        kind = _one(rng, self.line)
        sizes = {SHORT: [1.0, 2.0, 3.0], SHAKE: [0.5, 3.0, 20.0, 300.0]}
        size = float(rng.choice(sizes.get(kind, [0.5, 3.0, 20.0])))
        at_s = rng.uniform(0, length_s) if rng.random() < 0.85 else rng.uniform(0, 0.3)
        return LineFault(kind, round(float(at_s), 3), size)


def _some(rng: np.random.Generator, shares: dict[str, float]) -> dict[str, float]:
    """About half of some kinds, at least one."""
    chosen = {kind: share for kind, share in shares.items() if rng.random() < 0.5}
    return chosen or dict([list(shares.items())[int(rng.integers(len(shares)))]])


def _one(rng: np.random.Generator, shares: dict[str, float]) -> str:
    weights = np.array([*shares.values()])
    return str(rng.choice([*shares], p=weights / weights.sum()))


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
    world = _World.draw(rng, motor=motor)
    steps: list[Step] = []
    if rng.random() < 0.16:
        command = str(rng.choice(["bringup", "serve"]))
        steps.append(world.step(command, *LENGTHS[command], share=0.6))
    for number in range(int(rng.integers(1, 4))):
        crashed = number > 0 and any(step.crashes for step in steps)
        afresh = number > 0 and rng.random() < (AFTER_CRASH if crashed else OTHERWISE)
        length_s, share = 4.0 + 3.0 * counts[which], 0.4 if number else 0.8
        steps.append(world.step(AFRESH if afresh else CALIBRATE, length_s, 30 * counts[which], share))
        steps += world.between()
    if rng.random() < 0.6:
        steps.append(Step(CALIBRATE))
    command = None
    for _ in range(int(rng.integers(2, 8))):
        command = world.command(command)
        steps.append(world.step(command, *LENGTHS[command], share=0.6))
        steps += world.between()
    return replace(story, steps=tuple(steps))


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
        if step.command == OUTAGE:
            bench.lose_power()
            self.record.note_power()
            outcome.told.append("computer and part lose their power and have it again")
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
            "angle": ["angle", URL, "--cal", SESSION, "--json", "--seconds", "1"],
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
