"""Guided sessions with one fault below the driver: results of `calibrate` and `fit`.

Each session has a seed, a simulated part, a plan, a polled or a streaming bus, and one fault between the
driver and the chip (tests/fakes/faulty_chip.py): the chip restarts, a register changes, the data line
sticks, the supply dips. The fault comes at a random time: during a dwell or between two, at the first
position, at the last one or at any, or as registers are read and written. The command line itself runs:

    calibrate 'faulty:?seed=…' --plan … --auto -o FILE, then fit FILE --json

| outcome | the session |
|---|---|
| right | ends with status 0, and each value is within 4 u of the truth |
| reported | ends with another status and a message, and the dwells before the fault are in the file |
| wrong | ends with status 0, and a value is off by more than 4 u |
| later | is reported, but `fit` of its file then gives such a value and no warning |
| mute, lost | ends with another status, but without a message, or without the dwells before the fault |
| traceback | ends with an exception |
| hung | takes too long: on the host's clock or on the bus's, or one exchange takes more than 1 s |

Biases are compared with the truth plus the offsets that the session file states as configured. With
--resume a reported session goes on with a chip that was switched off and on, and is judged again. Sessions
without a fault give the rate of `wrong` by chance. `inadequate` counts right sessions whose fit widened its
uncertainties because the residuals contradict the model.

Ends with status 1 if any session is wrong, mute, lost, hung or has a traceback, or is wrong later.

    python scripts/session_faults.py --sessions 500 --seed 1 --jobs 2 --json faults.json
    python scripts/session_faults.py --sessions 50 --only dip --plan four-position
    python scripts/session_faults.py --again 1000017 --show
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shlex
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.faces.cli import main as run_program
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from fakes import faulty_chip

NO_FAULT = "none"
PLANS = {
    "two-position": 0.2,
    "four-position": 0.35,
    "mmpm": 0.2,
    "poses": 0.1,
    "tumble": 0.05,
    "free-turn": 0.1,
}
PLACES = ("first", "last", "any", "registers")
TURNS = ("free-turn",)
"""Plans that are no list of dwells: their dwells are not counted."""
MOST_U = 4.0
HOST_LIMIT_S = 120.0
EXCHANGE_LIMIT_S = 1.0
WAITING_LIMIT_S = 60.0
"""Simulated time that a session may take beyond twice the time of a session without a fault."""
COMPARED = (
    "delta_k", "delta_phi", "scale_x", "scale_y", "scale_z", "skew_xy", "skew_xz", "skew_yz",
    "bias_x", "bias_y", "bias_z", "gyro_bias_z", "gyro_scale_z",
)  # fmt: skip
OFFSETS = {
    "bias_x": "XACCL_OFF", "bias_y": "YACCL_OFF", "bias_z": "ZACCL_OFF", "gyro_bias_z": "ZGYRO_OFF",
}  # fmt: skip
ACCEL_LSB_MG, GYRO_LSB_DPS = 0.4672, 0.018315
OUTCOMES = ("right", "reported", "wrong", "later", "mute", "lost", "traceback", "hung")
GOOD = ("right", "reported")


class HostOvertimeError(BaseException):
    """A session took more of the host's time than it may."""


@dataclass(frozen=True)
class Task:
    """One session: its seed decides all that is random."""

    seed: int
    kind: str
    plan: str
    polled: bool
    dwell_s: float
    place: str
    within: bool
    preset: str
    pulsing: bool

    @property
    def url(self) -> str:
        """URL of the part without a fault, freshly switched on."""
        return f"faulty:?seed={self.seed}&stream={int(not self.polled)}&pulsing={int(self.pulsing)}"


@dataclass
class Outcome:
    """The result of one session.

    Attributes
    ----------
    off : dict of str to float
        Error of each compared value in units of its u.
    inadequate : bool
        The fit added an uncertainty to each reading because the residuals contradict the model.
    fired : bool
        The fault came before the session ended.
    resumed : str
        The outcome after `--resume` on a chip that was switched off and on; empty if not tried.
    """

    task: Task
    url: str = ""
    outcome: str = ""
    status: int | None = None
    fit_status: int | None = None
    said: str = ""
    off: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    inadequate: bool = False
    fired: bool = False
    dwells: int = 0
    simulated_s: float = 0.0
    host_s: float = 0.0
    longest_s: float = 0.0
    resumed: str = ""
    resumed_said: str = ""
    resumed_off: dict[str, float] = field(default_factory=dict)

    @property
    def command(self) -> str:
        """The command line that repeats the session."""
        return shlex.join(["adis-gonio", *calibrate(self.task, self.url, Path("a.session"))])


def task_of(seed: int, kinds: Sequence[str], plan: str = "", dwell_s: float = 1.0) -> Task:
    """Draw a session from its seed."""
    rng = np.random.default_rng(seed)
    weights = np.array(list(PLANS.values()))
    drawn = str(rng.choice(list(PLANS), p=weights / weights.sum()))
    return Task(
        seed,
        kind=kinds[seed % len(kinds)],
        plan=plan or drawn,
        polled=bool(rng.random() < 0.5),
        dwell_s=dwell_s,
        place=str(rng.choice(PLACES)),
        within=bool(rng.random() < 0.5),
        preset=str(rng.choice(["0", "8", "40", "written"])),
        pulsing=bool(rng.random() < 0.3),
    )


def calibrate(task: Task, url: str, path: Path) -> list[str]:
    """Arguments of `calibrate`."""
    words = ["calibrate", url, "--plan", task.plan, "--auto", "-o", str(path)]
    return [*words, "--duration", "30"] if task.plan in TURNS else [*words, "--dwell", str(task.dwell_s)]


@cache
def scheme() -> tempfile.TemporaryDirectory[str]:
    """Register `faulty:` by the metadata of a package in a temporary folder, for this process."""
    folder = tempfile.TemporaryDirectory()
    info = Path(folder.name) / "faulty-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[adis_gonio.bus]\nfaulty = fakes.faulty_chip:open_from_url\n")
    sys.path.insert(0, folder.name)
    return folder


@contextmanager
def host_limit(seconds: float) -> Iterator[None]:
    """Raise `HostOvertimeError` after so many seconds of the process's processor time."""

    def stop(number: int, frame: object) -> None:
        raise HostOvertimeError(f"{seconds:g} s of processor time")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def run(words: Sequence[str]) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of the command line, in this process."""
    scheme()
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), host_limit(HOST_LIMIT_S):
        status = run_program(list(words))
    return status, out.getvalue(), err.getvalue()


@dataclass(frozen=True)
class Timeline:
    """When a session without a fault does what.

    Attributes
    ----------
    gaps_s : list of float
        Times between the moves, from opening to closing.
    registers_s : list of (int, float)
        Each exchange with registers: the number of moves before it, the time since the last of them.
    dwells : int
        How many dwells the session has.
    """

    gaps_s: list[float]
    registers_s: list[tuple[int, float]]
    dwells: int


@cache
def timeline(plan: str, polled: bool, dwell_s: float) -> Timeline:
    """Run a session without a fault."""
    task = Task(1, NO_FAULT, plan, polled, dwell_s, "any", within=False, preset="0", pulsing=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.session"
        status, _, err = run(calibrate(task, task.url, path))
        if status != 0:
            raise RuntimeError(f"a session without a fault ends with status {status}: {err}")
        dwells = kept_dwells(path)
    bus = faulty_chip.OPENED.pop()
    begins_s = [0.0, *bus.moves_s]
    moves = [int(np.searchsorted(bus.moves_s, time_s, side="right")) for time_s in bus.exchanges_s]
    since = [(k, time_s - begins_s[k]) for k, time_s in zip(moves, bus.exchanges_s, strict=True)]
    return Timeline([float(gap) for gap in np.diff([*begins_s, bus._now])], since, dwells)


def faulty_url(task: Task) -> str:
    """URL of the part with its fault, whose time is drawn from the seed."""
    clean = timeline(task.plan, task.polled, task.dwell_s)
    gaps = clean.gaps_s
    url = f"{task.url}&preset={task.preset}&limit_s={2 * sum(gaps) + WAITING_LIMIT_S:.0f}"
    if task.kind == NO_FAULT:
        return url
    rng = np.random.default_rng([task.seed, 1])
    last = len(gaps) - 1
    if task.place == "registers":
        move, wait_s = clean.registers_s[rng.integers(len(clean.registers_s))]
        wait_s = max(0.0, wait_s + rng.uniform(-1e-3, 1e-3))
        return f"{url}&fault={task.kind}&move={move}&wait_s={wait_s:.6f}&draw={task.seed}"
    move = {"first": min(1, last), "last": last, "any": int(rng.integers(last + 1))}[task.place]
    dwell_s = min(task.dwell_s, gaps[move]) if task.plan not in TURNS else 0.8 * gaps[move]
    begin_s = gaps[move] - dwell_s
    wait_s = rng.uniform(begin_s, gaps[move]) if task.within else rng.uniform(0, begin_s)
    return f"{url}&fault={task.kind}&move={move}&wait_s={wait_s:.4f}&draw={task.seed}"


def kept_dwells(path: Path) -> int:
    """How many dwells a session file holds; 0 without a file."""
    if not path.exists():
        return 0
    with ArchiveView(path) as view:
        return len(view.dwells())


def due_dwells(task: Task, url: str) -> int:
    """How many dwells were complete before the fault."""
    clean = timeline(task.plan, task.polled, task.dwell_s)
    if task.plan in TURNS or "move=" not in url:
        return 0
    move = int(url.partition("move=")[2].partition("&")[0])
    return max(0, clean.dwells - (len(clean.gaps_s) - 1 - move) - 1)


def judge_fit(outcome: Outcome, path: Path, truth: dict[str, float]) -> dict[str, float]:
    """Fit a session file; return the error of each value in units of its u."""
    outcome.fit_status, out, _ = run(["fit", str(path), "--json"])
    if outcome.fit_status != 0:
        return {}
    result = json.loads(out)
    outcome.warnings = result["warnings"]
    outcome.inadequate = bool(result.get("extra_reading_u_mg"))
    registers = (load_session(path).facts.get("registers") or {}).get("configured") or {}
    off = {}
    for name in COMPARED:
        row = result["parameters"].get(name)
        if row is None or not row["u"]:
            continue
        expected = truth[name]
        if name in OFFSETS:
            expected += registers.get(OFFSETS[name], 0) * (GYRO_LSB_DPS if "gyro" in name else ACCEL_LSB_MG)
        off[name] = (row["value"] - expected) / row["u"]
    return off


def is_wrong(off: dict[str, float]) -> bool:
    """Whether any value is farther from the truth than `MOST_U`."""
    return any(not abs(value) <= MOST_U for value in off.values())


def judge(outcome: Outcome, path: Path, truth: dict[str, float]) -> str:
    """Classify a session by its exit status, its message and its fit."""
    task = outcome.task
    wrong = False
    if path.exists():
        outcome.dwells = kept_dwells(path)
        outcome.off = judge_fit(outcome, path, truth)
        wrong = is_wrong(outcome.off)
    if outcome.longest_s > EXCHANGE_LIMIT_S:
        return "hung"
    if outcome.status == 0:
        return "wrong" if wrong or outcome.fit_status != 0 else "right"
    if not outcome.said:
        return "mute"
    if outcome.dwells < due_dwells(task, outcome.url):
        return "lost"
    return "later" if wrong and not outcome.warnings else "reported"


def last_line(text: str) -> str:
    """The message that ends a program's standard error: an error, or doubts about the result."""
    lines = [line for line in text.splitlines() if line.strip()]
    ends = [line for line in lines if line.startswith(("adis-gonio:", "the result "))]
    return ends[-1] if ends else ""


def session(task: Task, *, resume: bool = False) -> Outcome:
    """Run one session and judge it."""
    outcome = Outcome(task, faulty_url(task))
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.session"
        try:
            outcome.status, _, err = run(calibrate(task, outcome.url, path))
            outcome.said = last_line(err)
            bus = observe(outcome)
            if bus is None:
                outcome.outcome = "reported" if outcome.said else "mute"
            else:
                outcome.outcome = judge(outcome, path, truth_of(bus))
                if resume and outcome.outcome == "reported" and path.exists():
                    resume_session(outcome, path)
        except (faulty_chip.OvertimeError, HostOvertimeError) as error:
            observe(outcome)
            outcome.outcome, outcome.said = "hung", str(error)
        except Exception:
            observe(outcome)
            outcome.outcome, outcome.said = "traceback", traceback.format_exc()
    faulty_chip.OPENED.clear()
    outcome.host_s = time.monotonic() - begin_s
    return outcome


def observe(outcome: Outcome) -> faulty_chip.FaultyBus | None:
    """Take the counts of the session's bus and return it; None if no bus was opened."""
    if not faulty_chip.OPENED:
        return None
    bus = faulty_chip.OPENED[-1]
    outcome.fired, outcome.longest_s, outcome.simulated_s = bus.chip.fired, bus.longest_s, bus._now
    return bus


def truth_of(bus: faulty_chip.FaultyBus) -> dict[str, float]:
    """Return the hidden parameters, with the mean wander of the biases while the bus was open."""
    return bus.world.truth(np.linspace(0.0, bus._now, 200))


def resume_session(outcome: Outcome, path: Path) -> None:
    """Go on with a reported session after the chip was switched off and on, and judge the result."""
    again = Outcome(outcome.task, outcome.url)
    again.status, _, err = run(["calibrate", again.url, "--resume", "--auto", "-o", str(path)])
    again.said = last_line(err)
    outcome.resumed = judge(again, path, truth_of(faulty_chip.OPENED[-1]))
    outcome.resumed_said, outcome.resumed_off = again.said, again.off


# -- tables ------------------------------------------------------------------------------------------


def row(name: str, outcomes: Sequence[Outcome]) -> str:
    """One row of the table."""
    ends = Counter(outcome.outcome for outcome in outcomes)
    inadequate = sum(o.inadequate for o in outcomes if o.outcome == "right")
    silent = sum(not o.fired for o in outcomes)
    cells = [name, len(outcomes), *(ends[end] or "" for end in OUTCOMES), inadequate, silent]
    return "| " + " | ".join(map(str, cells)) + " |"


def report(outcomes: Sequence[Outcome], kinds: Sequence[str]) -> bool:
    """Print kinds × outcomes and each bad session; return True if there is none with a fault."""
    head = ("fault", "sessions", *OUTCOMES, "right, inadequate", "no fault came")
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    for kind in kinds:
        print(row(kind, [o for o in outcomes if o.task.kind == kind]))
    faulty = [o for o in outcomes if o.task.kind != NO_FAULT]
    print(row("all faults", faulty))
    resumed = Counter(o.resumed for o in outcomes if o.resumed)
    if resumed:
        print("\nresumed: " + ", ".join(f"{count} {end}" for end, count in resumed.items()))
    values = sum(len(o.off) for o in outcomes if o.task.kind == NO_FAULT)
    far = sum(abs(v) > MOST_U for o in outcomes if o.task.kind == NO_FAULT for v in o.off.values())
    print(f"without a fault: {far} of {values} values off by more than {MOST_U:g} u")
    for outcome in outcomes:
        if outcome.outcome not in GOOD:
            show(outcome)
        elif outcome.resumed not in ("", *GOOD):
            print(f"\nresumed, {outcome.resumed}: {outcome.resumed_off}")
            show(outcome)
    bad = any(o.outcome not in GOOD or o.resumed not in ("", *GOOD) for o in faulty)
    return not bad


def show(outcome: Outcome) -> None:
    """Print a session, its result and the command that repeats it."""
    off = {name: round(value, 1) for name, value in outcome.off.items() if abs(value) > MOST_U}
    print(f"\n{outcome.outcome}: seed {outcome.task.seed}, {outcome.task.kind}, {outcome.task.plan}")
    print(f"  {outcome.command}")
    print(f"  off/u {off}, status {outcome.status}, fit {outcome.fit_status}, {outcome.dwells} dwells")
    print(f"  said: {outcome.said.strip()[-600:]}\n  warnings: {' / '.join(outcome.warnings)[:400]}")


def run_all(tasks: Sequence[Task], jobs: int, *, resume: bool) -> list[Outcome]:
    """Run sessions in processes, with a count on standard error."""
    outcomes = []
    with ProcessPoolExecutor(jobs) as pool:
        waiting = [pool.submit(session, task, resume=resume) for task in tasks]
        for number, future in enumerate(waiting, 1):
            outcomes.append(future.result(timeout=4 * HOST_LIMIT_S * (1 + len(tasks))))
            print(f"\r{number}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return outcomes


def main() -> int:
    """Run and print."""
    kinds = (*faulty_chip.FAULTS, NO_FAULT)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", default="", choices=["", *kinds], help="the only kind of fault")
    parser.add_argument("--plan", default="", choices=["", *PLANS])
    parser.add_argument("--dwell", type=float, default=1.0, help="length of a dwell in s")
    parser.add_argument("--resume", action="store_true", help="also resume each reported session")
    parser.add_argument("--again", type=int, help="repeat the one session of a seed")
    parser.add_argument("--show", action="store_true", help="print each session")
    parser.add_argument("--json", type=Path, help="write all outcomes")
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    kinds = (options.only,) if options.only else kinds
    first = 1_000_000 * options.seed
    seeds = range(first, first + options.sessions) if options.again is None else [options.again]
    tasks = [task_of(seed, kinds, options.plan, options.dwell) for seed in seeds]
    outcomes = run_all(tasks, options.jobs, resume=options.resume)
    good = report(outcomes, kinds)
    if options.show:
        for outcome in outcomes:
            show(outcome)
    if options.json:
        options.json.write_text(json.dumps([asdict(o) | {"command": o.command} for o in outcomes]))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
