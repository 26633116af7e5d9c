#!/usr/bin/env python3
"""Hand damaged and forged files to the commands: one clear line each, in bounded time and memory.

Each file comes from its number and `--seed`: a session, a samples CSV, a calibration or a plan
(tests/record/strange_files.py) and a command that takes it. The command runs in a process forked from one
that has imported numpy, scipy and the commands. Outcomes:

    OK         exit status 0
    TOLD       exit status 1 or 2 and one line on standard error that begins with `adis-gonio:`
    NOISY      more lines, unprintable or very long ones, or a warning of Python
    TRACEBACK  an uncaught exception, another exit status or a signal
    HUNG       more than 30 s of processor time, or 300 s by the clock
    BIG        peak resident memory above 300 MB

Exit status 1 if a file ends in TRACEBACK, HUNG or BIG.

    python scripts/fuzz_files.py --files 2000 --seed 1 --jobs 2
    python scripts/fuzz_files.py --seed 1 --only 77 --keep failing    # one file again
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import math
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.faces.cli import COMMANDS as HOMES, main as adis_gonio
from adis_gonio.faces.cli.terminal import replace_missing_letters
from record.strange_files import KINDS, SoundFiles

OUTCOMES = ("OK", "TOLD", "NOISY", "TRACEBACK", "HUNG", "BIG")
FAILURES = ("TRACEBACK", "HUNG", "BIG")
CPU_S = 30
CLOCK_S = 300
MOST_MB = 300.0
ADDRESS_BYTES = 8_000_000_000
"""Address space of a command, so that the machine survives what it measures."""
_UNCAUGHT = 70

COMMANDS: dict[str, tuple[tuple[int, str], ...]] = {
    "session": (
        (8, "fit FILE"),
        (2, "fit FILE --all --json"),
        (3, "fit FILE --sensor-part gyro"),
        (4, "trace FILE --time-limit 5"),
        (1, "trace FILE --json --time-limit 5"),
        (1, "trace FILE --sensor-part gyro --time-limit 5"),
        (3, "report FILE -o OUT.html --time-limit 5"),
        (4, "export FILE -o OUT.h"),
        (2, "export FILE -o OUT.json"),
        (1, "export FILE --format json -o -"),
        (2, "export FILE -o OUT.csv"),
        (1, "export FILE -o OUT.xml"),
        (1, "export FILE -o OUT.txt"),
        (1, "export FILE -o OUT.parquet"),
        (1, "allan FILE"),
        (2, "calibrate sim:?seed=1 --auto --resume -o FILE"),
        (1, "angle sim:?seed=1 --cal FILE --seconds 0.1"),
        (1, "write FILE sim:?seed=1 --dry-run --dwell 1"),
        (1, "simulate --like FILE -o OUT.csv"),
        (1, "fleet FILE"),
    ),
    "samples": (
        (8, "fit FILE"),
        (1, "fit FILE --all --json"),
        (2, "fit FILE --sensor-part gyro"),
        (3, "trace FILE --time-limit 5"),
        (2, "report FILE -o OUT.html --time-limit 5"),
        (3, "export FILE -o OUT.csv"),
        (3, "export FILE -o OUT.h"),
        (1, "export FILE -o OUT.json"),
        (1, "allan FILE --sensor-part accelerometer"),
        (1, "fleet FILE"),
    ),
    "calibration": (
        (8, "export FILE -o OUT.h"),
        (3, "export FILE -o OUT.xml"),
        (3, "export FILE -o OUT.txt"),
        (3, "angle sim:?seed=1 --cal FILE --seconds 0.1"),
        (2, "fit SESSION --gyros FILE"),
        (2, "fit SESSION --sensor-part gyro --calibration FILE"),
        (1, "export SESSION --gyros FILE -o OUT.h"),
        (1, "fit FILE"),
    ),
    "plan": (
        (3, "plan --plan FILE --fixture 0.1"),
        (2, "template --plan FILE -o OUT.csv"),
        (2, "simulate --plan FILE --dwell 0.5 --rate 50 -o OUT.csv"),
        (2, "calibrate sim:?seed=1 --auto --plan FILE --dwell 0.5 --rate 50 -o OUT.session"),
    ),
}
"""Commands by family of files, with their weights."""
_ENDINGS = {"session": ".session", "samples": ".csv", "calibration": ".json", "plan": ".json"}
_CHATTY = ("calibrate", "simulate", "angle", "write", "fleet")
"""Commands that say on standard error how far they are."""


@dataclass(frozen=True)
class Result:
    """End of one command.

    Attributes
    ----------
    cpu_s : float
        Processor time, s.
    peak_mb : float
        Peak resident memory, MB.
    """

    outcome: str
    cpu_s: float
    peak_mb: float
    stderr: str


@dataclass(frozen=True)
class Trial:
    """One file and the command that takes it."""

    number: int
    kind: str
    what: str
    words: tuple[str, ...]
    folder: Path

    def __str__(self) -> str:
        return f"{self.number} ({self.kind}): {' '.join(self.words)}: {self.what[:200]}"


def classify(status: int, words: tuple[str, ...], stderr: str) -> str:
    """Outcome of a command that ended by itself with this wait status, memory apart."""
    if os.WIFSIGNALED(status):
        return "HUNG" if os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGALRM) else "TRACEBACK"
    code = os.WEXITSTATUS(status)
    if code not in (0, 1, 2) or "Traceback (most recent" in stderr or "Exception ignored in" in stderr:
        return "TRACEBACK"
    if re.search(r":\d+: \w*Warning", stderr):
        return "NOISY"
    if code == 0:
        return "OK"
    lines = stderr.split("\n")[:-1]
    if not all(line.isprintable() and len(line) < 1000 for line in lines):
        return "NOISY"
    chatty = words[0] in _CHATTY
    told = [line for line in lines if line.startswith("adis-gonio:")]
    said = [line for line in lines if line in told or not re.search(r" …( \(.*\))?$", line)]
    if chatty:
        return "TOLD" if lines and told in ([], lines[-1:]) else "NOISY"
    return "TOLD" if len(told) == 1 and said == told else "NOISY"


def run(
    words: tuple[str, ...], folder: Path, command: Callable[[tuple[str, ...]], int] = adis_gonio
) -> int:
    """Start a command in a forked process; returns its process id."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return child
    status = _UNCAUGHT
    try:
        with contextlib.suppress(ProcessLookupError):
            os.setpgid(0, 0)
        os.chdir(folder)
        _redirect(folder)
        replace_missing_letters()
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 5))
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
        signal.alarm(CLOCK_S)
        status = command(words)
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _redirect(folder: Path) -> None:
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        opened = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(opened, descriptor)
        os.close(opened)


def result_of(child: int, words: tuple[str, ...], folder: Path) -> Result:
    """Wait for a command that `run` started."""
    _, status, usage = os.wait4(child, 0)
    return _result(status, usage, words, folder)


def _result(status: int, usage: resource.struct_rusage, words: tuple[str, ...], folder: Path) -> Result:
    stderr = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
    outcome = classify(status, words, stderr)
    peak_mb = usage.ru_maxrss / 1000
    if peak_mb > MOST_MB and outcome not in ("TRACEBACK", "HUNG"):
        outcome = "BIG"
    return Result(outcome, usage.ru_utime + usage.ru_stime, peak_mb, stderr)


def make_sound_files(folder: Path) -> SoundFiles:
    """Record the sessions to begin from, and what is made of them."""
    sim = "calibrate sim:?seed=1 --auto --dwell 1 --rate 50"
    commands = (
        "simulate --plan mmpm --check 2 --dwell 1 --rate 50 -o turn.session",
        f"{sim} --plan poses --positions 9 -o poses.session",
        f"{sim} --plan gyro-turns --turns 1 --positions 3 -o gyros.session",
        "simulate --dwell 1 --rate 20 --effect quadratic:k2_x=2.5 -o four.session",
        "simulate --plan tumble --positions 3 --dwell 1 --rate 20 -o tumble.csv",
        "export four.session -o four.csv",
        "export poses.session -o poses.csv",
        "export turn.session -o turn.json",
        "export turn.session --trace -o traced.json",
        "export poses.session -o poses.json",
        "plan --plan four-position --fixture 0.1 -o named.json",
        "plan --positions 5 --fixture 0.1 -o plan.json",
    )
    for command in commands:
        words = tuple(command.split())
        done = result_of(run(words, folder), words, folder)
        if done.outcome in FAILURES:
            raise SystemExit(f"{command}: {done.outcome}: {done.stderr}")
    _make_recording(folder / "recording.csv")
    named = folder / "named.json"
    if named.exists():
        named.write_text(
            named.read_text(encoding="utf-8").replace("four-position", "mine"), encoding="utf-8"
        )

    def those(*names: str) -> list[Path]:
        return [folder / name for name in names if (folder / name).exists()]

    return SoundFiles(
        those("turn.session", "poses.session", "gyros.session", "four.session"),
        those("four.csv", "tumble.csv", "poses.csv", "recording.csv"),
        those("turn.json", "traced.json", "poses.json"),
        those("named.json", "plan.json"),
    )


def _make_recording(target: Path) -> None:
    """A continuous recording without positions: a quarter turn between two rests."""
    rng, lines = random.Random(1), ["# sensor: adis16354", "# accel_unit: mg", "time_s,ax,ay,az"]
    for k in range(600):
        angle = 0 if k < 250 else 90 if k > 300 else (k - 250) * 1.8
        x, y = (1000 * math.cos(math.radians(part)) for part in (angle, angle + 90))
        lines.append(
            f"{k / 50:.2f},{x + rng.gauss(0, 2):.1f},{y + rng.gauss(0, 2):.1f},{rng.gauss(0, 2):.1f}"
        )
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")


def warm_up() -> None:
    """Import what the commands import, once."""
    names = (
        "fitting.methods",
        "tracing.trace",
        "tracing.traced_answer",
        "bench.runner",
        "sim.bus",
        "plan.optimal_plan",
        "handover.calibration_report",
    )
    handover = ("session_export", "c_header", "certificate", "calibration_report")
    commands = {words.split()[0] for lines in COMMANDS.values() for _, words in lines}
    for name in (
        *names,
        *(f"handover.{name}" for name in handover),
        *sorted({f"faces.cli.{HOMES[name].module}" for name in commands}),
    ):
        importlib.import_module(f"adis_gonio.{name}")
    for name in (
        "scipy.stats",
        "scipy.optimize",
        "scipy.linalg",
        "scipy.special",
        "rich.console",
        "jinja2",
    ):
        importlib.import_module(name)


def make_trial(number: int, seed: int, sound: SoundFiles, folder: Path) -> Trial:
    """Make one file, and choose the command that takes it."""
    rng = random.Random(f"{seed} {number}")
    kind = rng.choices(list(KINDS), [weight for _, weight, _ in KINDS.values()])[0]
    family, _, make = KINDS[kind]
    folder.mkdir(parents=True)
    name = f"strange{_ENDINGS[family]}"
    weights, commands = zip(*COMMANDS[family], strict=True)
    command = rng.choices(commands, weights)[0]
    session = str(rng.choice(sound.sessions))
    what = make(sound, folder / name, rng)
    stands = {"FILE": name, "SESSION": session}
    words = tuple(stands.get(word, word.replace("OUT.", "out.")) for word in command.split())
    return Trial(number, kind, what, words, folder)


def results(
    numbers: Iterable[int], seed: int, sound: SoundFiles, folder: Path, jobs: int
) -> Iterator[tuple[Trial, Result]]:
    """Run the trials, `jobs` at a time; each comes with its result as it ends."""
    waiting, running = iter(numbers), dict[int, Trial]()
    while True:
        while len(running) < jobs:
            number = next(waiting, None)
            if number is None:
                break
            trial = make_trial(number, seed, sound, folder / str(number))
            running[run(trial.words, trial.folder)] = trial
        if not running:
            return
        child, status, usage = os.wait4(-1, 0)
        trial = running.pop(child)
        yield trial, _result(status, usage, trial.words, trial.folder)


def table(counts: Counter[tuple[str, str]]) -> str:
    """Kinds of files by outcomes."""
    lines = [f"{'':20}" + "".join(f"{outcome:>10}" for outcome in OUTCOMES)]
    for kind in (*KINDS, "all"):
        row = [
            sum(n for (k, o), n in counts.items() if kind in (k, "all") and o == outcome)
            for outcome in OUTCOMES
        ]
        lines.append(f"{kind:20}" + "".join(f"{count:>10}" for count in row))
    return "\n".join(lines)


def show_baseline(sound: SoundFiles, folder: Path) -> None:
    """Memory and time of sound files."""
    for path, command in (
        (sound.sessions[0], "fit"),
        (sound.sessions[0], "trace"),
        (sound.samples[0], "fit"),
    ):
        words = (command, str(path))
        done = result_of(run(words, folder), words, folder)
        print(f"sound: {command} {path.name}: {done.outcome}, {done.peak_mb:.0f} MB, {done.cpu_s:.1f} s")


def main() -> int:
    """Run them; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--files", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of files to make again")
    parser.add_argument("--keep", type=Path, help="folder for the files that fail")
    options = parser.parse_args()
    warm_up()
    begun, counts, failed = time.monotonic(), Counter[tuple[str, str]](), []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        sound = make_sound_files(folder)
        show_baseline(sound, folder)
        numbers = range(options.files) if options.only is None else options.only
        for trial, done in results(numbers, options.seed, sound, folder / "trials", options.jobs):
            counts[trial.kind, done.outcome] += 1
            if done.outcome in FAILURES or done.outcome == "NOISY" or options.only is not None:
                failed.append(trial.number)
                last = (done.stderr.strip().split("\n") or [""])[-1]
                print(
                    f"{done.outcome} {done.cpu_s:.1f} s {done.peak_mb:.0f} MB {trial}\n    {last[:300]}",
                    flush=True,
                )
                if options.keep is not None:
                    shutil.copytree(trial.folder, options.keep / str(trial.number), dirs_exist_ok=True)
            shutil.rmtree(trial.folder)
    print(table(counts))
    print(
        f"{time.monotonic() - begun:.0f} s; not OK or TOLD: {' '.join(map(str, sorted(failed))) or 'none'}"
    )
    return 1 if any(outcome in FAILURES for _, outcome in counts) else 0


if __name__ == "__main__":
    sys.exit(main())
