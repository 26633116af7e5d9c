"""Kill -9 an automatic session at random moments and see that nothing that was announced is lost.

Each round: start a session in a process of its own, kill it at a random moment, then
  * every dwell that the process had announced is in the file, with the words that it had announced;
  * resume (killing again with some probability) until the session is complete;
  * the finished session equals the undisturbed one: words, times, angles of every dwell;
  * one file is left, no journal.

    python scripts/kill_test.py --kills 100
    python scripts/kill_test.py --kills 100 --cli        # the same by `adis-gonio calibrate`
    python scripts/kill_test.py --kills 100 --stress     # kills within commits, archive alone
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

READY = "ready"
URL = "sim:?seed=7&fixture_sigma_deg=0.05"


def digest(words: np.ndarray) -> str:
    """Short name of a dwell's words."""
    return hashlib.sha256(np.ascontiguousarray(words).astype("<u2").tobytes()).hexdigest()[:16]


# -- what runs in the process that is killed ------------------------------------------------------------


def run_session(path: Path, plan_name: str, positions: int | None, dwell_s: float) -> None:
    """Begin or resume an automatic session; announce each complete dwell on standard output."""
    from adis_gonio.base.errors import AdisGonioError
    from adis_gonio.bench.events import DwellDone
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor import open_sensor
    from adis_gonio.record.archive import ArchiveView
    from adis_gonio.record.plans import plan
    from adis_gonio.record.source import Settings

    print(json.dumps(READY), flush=True)
    with open_sensor(URL) as sensor:
        try:
            runner = SessionRunner.resume(sensor, path, auto=True)
        except AdisGonioError:
            runner = SessionRunner.begin(
                sensor, path, plan(plan_name, positions), Settings(dwell_s=dwell_s), auto=True
            )
        for event in runner.run():
            if isinstance(event, DwellDone):
                with ArchiveView(path) as view:
                    stored = next(a for a in view.attempts() if a.number == event.attempt)
                    words = np.concatenate([block.words for block in view.blocks(stored, "dwell")])
                print(json.dumps({"place": event.place, "words": digest(words)}), flush=True)


def run_writer(path: Path, seed: int) -> None:
    """Write small dwells to an archive as fast as possible, so that most moments lie within a commit."""
    from adis_gonio.device.sensor.settings import ScanBlock
    from adis_gonio.record.archive import Archive
    from adis_gonio.record.archive_tables import Attempt, Header, utc_now
    from adis_gonio.record.plans import plan

    print(json.dumps(READY), flush=True)
    rng = np.random.default_rng(seed)
    header = Header("test:", "adis16354", plan("tumble", 1000), {}, 9.80665, None)
    archive = Archive.create(path, header)
    archive.begin_run(0.0, 0.0)
    names = ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT")
    for place, position in enumerate(archive.plan().positions):
        words = rng.integers(0, 1 << 16, (2000, 3)).astype(np.uint16)
        block = ScanBlock(names, words, np.arange(2000.0))
        now = float(place)
        archive.add_attempt(Attempt(place, position, "complete", utc_now(), now, now, [("dwell", block)]))
        print(json.dumps({"place": place, "words": digest(words)}), flush=True)


# -- the one who kills ----------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What one run of the child announced."""

    announced: dict[int, str] = field(default_factory=dict)
    killed: bool = False
    seconds: float = 0.0


def child(arguments: list[str], kill_after_s: float | None) -> Outcome:
    """Run this script as a child; kill it some time after it has started up."""
    outcome = Outcome()
    for line, began in _lines(
        [str(Path(__file__).resolve()), *arguments], kill_after_s, outcome, stderr=False
    ):
        try:
            entry = json.loads(line)
        except ValueError:
            continue  # the kill cut the line
        if entry == READY:
            began()
        else:
            outcome.announced[entry["place"]] = entry["words"]
    return outcome


def command_line(path: Path, options: list[str], kill_after_s: float | None) -> Outcome:
    """Run `adis-gonio calibrate` in the same way; it announces a dwell with a line of its samples."""
    outcome = Outcome()
    again = ["--resume"] if begun(path) else []
    if not again:
        path.unlink(missing_ok=True)  # empty: killed before the session existed
    run = [
        "-c",
        "from adis_gonio.faces.cli import main; raise SystemExit(main())",
        "calibrate",
        URL,
        "--auto",
    ]
    arguments = [*run, "-o", str(path), *(again or options)]
    for line, began in _lines(arguments, kill_after_s, outcome, stderr=True):
        if " begun, " in line or " resumed, " in line:
            began()
        if re.search(r"\d+ samples\s*$", line):
            outcome.announced[len(outcome.announced)] = ""
    return outcome


def _lines(
    arguments: list[str], kill_after_s: float | None, outcome: Outcome, *, stderr: bool
) -> Iterator[tuple[str, Callable[[], None]]]:
    """Lines of a Python process, each with what starts the clock of the kill."""
    process = subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.DEVNULL if stderr else subprocess.PIPE,
        stderr=subprocess.PIPE if stderr else None,
        text=True,
    )
    timer = threading.Timer(kill_after_s or 0.0, process.send_signal, (signal.SIGKILL,))
    started = [time.monotonic()]

    def begin() -> None:
        started[0] = time.monotonic()
        if kill_after_s is not None:
            timer.start()

    pipe = process.stderr if stderr else process.stdout
    assert pipe is not None
    said = []
    for line in pipe:
        said.append(line)
        yield line, begin
    code = process.wait()
    timer.cancel()
    pipe.close()
    outcome.seconds = time.monotonic() - started[0]
    outcome.killed = code == -signal.SIGKILL
    if code and not outcome.killed:
        raise SystemExit(f"the session failed with exit {code}: {''.join(said[-3:])}")


def begun(path: Path) -> bool:
    """True where a file holds a session, be it without a dwell."""
    from adis_gonio.base.errors import AdisGonioError
    from adis_gonio.record.archive import ArchiveView

    try:
        ArchiveView(path).close()
    except AdisGonioError:
        return False
    return True


def stored(path: Path) -> dict[int, str]:
    """Places of the complete dwells in a file, with their words."""
    from adis_gonio.record.archive import ArchiveView

    if not begun(path):
        return {}
    with ArchiveView(path) as view:
        return {
            a.place: digest(np.concatenate([b.words for b in view.blocks(a, "dwell")]))
            for a in view.dwells()
        }


def check_announced(path: Path, announced: dict[int, str]) -> None:
    """Every announced dwell must be in the file, word by word."""
    found = stored(path)
    for place, words in announced.items():
        if found.get(place) != words:
            raise SystemExit(
                f"{path}: place {place} was announced as {words}, stored is {found.get(place)}"
            )


def check_same(path: Path, undisturbed: Path) -> None:
    """Two finished sessions must be equal in all that a fit reads."""
    from adis_gonio.record.session_reader import read_session

    ours, theirs = read_session(path), read_session(undisturbed)
    if len(ours.dwells) != len(theirs.dwells):
        raise SystemExit(f"{path}: {len(ours.dwells)} dwells, undisturbed {len(theirs.dwells)}")
    for a, b in zip(ours.dwells, theirs.dwells, strict=True):
        same = (
            (a.position, a.angle_deg, a.approach, a.use) == (b.position, b.angle_deg, b.approach, b.use)
            and np.array_equal(a.accel, b.accel)
            and np.array_equal(a.time_s, b.time_s)
            and a.gyro is not None
            and b.gyro is not None
            and np.array_equal(a.gyro, b.gyro)
        )
        if not same:
            raise SystemExit(f"{path}: dwell {a.position} differs from the undisturbed session")
    if ours.notes or not ours.facts["complete"]:
        raise SystemExit(f"{path}: {ours.notes}")


def kill_sessions(
    kills: int, seed: int, plan_name: str, positions: int | None, dwell_s: float, *, cli: bool = False
) -> dict[str, int]:
    """Kill sessions until so many kills have hit; return what was seen."""
    rng = random.Random(seed)
    seen = {
        "kills": 0,
        "sessions": 0,
        "dwells announced before a kill": 0,
        "kills within the first dwell": 0,
    }
    options = ["--plan", plan_name, "--dwell", str(dwell_s)]
    options += [] if positions is None else ["--positions", str(positions)]

    def run(path: Path, limit: float | None) -> Outcome:
        if cli:
            return command_line(path, options, limit)
        return child(["--child", str(path), *options], limit)

    with tempfile.TemporaryDirectory() as folder:
        reference = Path(folder) / "undisturbed.session"
        whole = run(reference, None)
        while seen["kills"] < kills:
            path = Path(folder) / f"{seen['sessions']}.session"
            announced: dict[int, str] = {}
            while True:
                before = len(stored(path))
                outcome = run(
                    path, rng.uniform(0.0, 1.05 * whole.seconds) if seen["kills"] < kills else None
                )
                if cli:
                    if len(stored(path)) < before + len(outcome.announced):
                        raise SystemExit(f"{path}: a dwell that was announced is missing")
                else:
                    check_announced(path, announced | outcome.announced)
                announced |= outcome.announced
                if not outcome.killed:
                    break
                seen["kills"] += 1
                seen["dwells announced before a kill"] += len(outcome.announced)
                seen["kills within the first dwell"] += not stored(path)
            check_same(path, reference)
            if list(Path(folder).glob(f"{path.name}-*")):
                raise SystemExit(f"{path}: something is left beside the file")
            path.unlink()
            seen["sessions"] += 1
    return seen


def kill_writers(kills: int, seed: int) -> dict[str, int]:
    """Kill a process that does nothing but commit."""
    rng = random.Random(seed)
    seen = {"kills": 0, "dwells announced": 0, "journals rolled back": 0, "committed, not yet announced": 0}
    with tempfile.TemporaryDirectory() as folder:
        while seen["kills"] < kills:
            path = Path(folder) / f"{seen['kills']}.session"
            outcome = child(
                ["--writer", str(path), "--seed", str(rng.randrange(1 << 30))], rng.uniform(0.0, 0.7)
            )
            seen["kills"] += 1
            seen["journals rolled back"] += path.with_name(path.name + "-journal").exists()
            check_announced(path, outcome.announced)
            seen["dwells announced"] += len(outcome.announced)
            extra = len(stored(path)) - len(outcome.announced)
            if not 0 <= extra <= 1:
                raise SystemExit(f"{path}: {extra} dwells more than were announced")
            seen["committed, not yet announced"] += extra
            path.unlink(missing_ok=True)
    return seen


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plan", default="tumble")
    parser.add_argument("--positions", type=int)
    parser.add_argument("--dwell", type=float, default=5.0, help="length of a dwell in s")
    parser.add_argument("--cli", action="store_true", help="run `adis-gonio calibrate`, not the Python API")
    parser.add_argument("--stress", action="store_true", help="kill a process that only commits")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--writer", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        run_session(options.child, options.plan, options.positions, options.dwell)
    elif options.writer:
        run_writer(options.writer, options.seed)
    else:
        if options.stress:
            seen = kill_writers(options.kills, options.seed)
        else:
            seen = kill_sessions(
                options.kills,
                options.seed,
                options.plan,
                options.positions,
                options.dwell,
                cli=options.cli,
            )
        print(", ".join(f"{name}: {count}" for name, count in seen.items()))
        print(
            "every announced dwell was there; resumed sessions equal the undisturbed one"
            if not options.stress
            else "every announced dwell was there"
        )


if __name__ == "__main__":
    main()
