"""The simulated bench without end: stories from seeds, with every invariant after each command.

The bench is in tests/simulated_bench. A failing seed is shrunk and printed as a story that a person reads,
with the Python of the story for a test.
Every minute and at the end (also after Ctrl-C, once the present story has ended) one line states the seeds,
the bench hours, the bench hours in an hour of one core, the values outside U and the failing seeds.

    nice -n 19 python scripts/bench_stories.py                      # for ever, from seed 0
    python scripts/bench_stories.py --first 5000 --minutes 30
    python scripts/bench_stories.py --again 4711                    # one story, told in full
    python scripts/bench_stories.py --defects --most 300            # seeds until each defect is found
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from simulated_bench.defects import DEFECTS, Watch, put_back
from simulated_bench.stories import Outcome, Story, draw, play, shrink, tell


def played(story: Story, observe: Callable[..., object] | None = None) -> Outcome:
    """Play a story in a folder of its own; `observe` as in `play`."""
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=memory) as outer:
        folder = Path(outer) / "bench"
        folder.mkdir()
        return play(story, folder, observe)


def name_of(outcome: Outcome) -> str:
    """Name of the first invariant that did not hold; empty without one."""
    return outcome.wrong[0].split(": ")[0] if outcome.wrong else ""


def stopped() -> bool:
    """True if Ctrl-C was pressed; it waits until the present story has ended."""
    return signal.SIGINT in signal.sigpending()


def report(story: Story, outcome: Outcome) -> None:
    """Print a failing story, shrunk."""
    which = name_of(outcome)
    print(f"\nseed {story.seed} fails: {outcome.wrong[0]}", flush=True)
    small = shrink(story, lambda one: not stopped() and name_of(played(one)) == which)
    print(f"FAILED, shrunk from seed {story.seed}:\n{tell(played(small))}\n{small!r}\n", flush=True)


def run(first: int, minutes: float) -> int:
    """Play stories from a seed on; return the number of failing ones."""
    began_s, told_s, core_s = time.monotonic(), time.monotonic(), time.process_time()
    hours = measured = 0.0
    failed: list[int] = []
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    values = outside = 0
    for seed in count(first):
        story = draw(seed)
        outcome = played(story)
        hours += outcome.hours
        measured += outcome.measured_hours
        values += len(outcome.off) * (not outcome.lied)
        outside += sum(abs(off) > 1 for off in outcome.off.values()) * (not outcome.lied)
        used_h = (time.process_time() - core_s) / 3600
        if outcome.wrong:
            failed.append(seed)
            report(story, outcome)
        over = time.monotonic() - began_s > 60 * minutes or stopped()
        if over or time.monotonic() - told_s > 60:
            told_s = time.monotonic()
            print(
                f"seeds {first} to {seed}: {hours:.0f} bench hours, {measured:.2f} of them in commands;"
                f" {hours / used_h:.0f} bench hours ({measured / used_h:.0f} in commands) in an hour of one"
                f" core; outside U {outside} of {values} values; failed: {failed}",
                flush=True,
            )
        if over:
            break
    return len(failed)


def find_defects(names: Sequence[str], first: int, most: int, state: Path | None) -> int:
    """Print how many seeds it takes to find each known defect; return the number of those not found.

    The second number of a line counts the stories among them that reach the place of the defect.

    A story that may reach the place of a defect is played without one first. Only defects with a place that
    it reaches can change it: these are put back one by one. The numbers equal those of a run with all.
    `state` is a file from which the search goes on, or None.
    """
    known = json.loads(state.read_text()) if state is not None and state.exists() else {}
    next_seed, found = known.get("next", first), known.get("found", {})
    reached = Counter(known.get("reached", {}))
    for seed in range(next_seed, first + most):
        story, watch = draw(seed), Watch()
        missed = [name for name in names if name not in found]
        wanted = [name for name in missed if DEFECTS[name].needs(story)]
        if not missed:
            break
        if not wanted:
            continue
        with watch.watching():
            outcome = played(story, watch.ended)
        if outcome.wrong:
            print(f"seed {seed} fails without a defect: {outcome.wrong[0]}", flush=True)
        for name in wanted if not outcome.wrong else ():
            if name in watch.reached:
                reached[name] += 1
                with put_back(name):
                    outcome = played(story)
                if outcome.wrong:
                    found[name] = seed - first + 1
                    which = f"{found[name]:5} {reached[name]:5}  {name_of(outcome):50}"
                    print(f"{name:20} {which}  {DEFECTS[name].text}", flush=True)
        if state is not None:
            state.write_text(json.dumps({"next": seed + 1, "found": found, "reached": reached}))
    missed = [name for name in names if name not in found]
    for name in missed:
        print(
            f"{name:20} not found in {most} seeds, {reached[name]} reach it  {DEFECTS[name].text}",
            flush=True,
        )
    return len(missed)


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--again", type=int, help="play one seed and tell it")
    parser.add_argument("--defects", nargs="*", choices=DEFECTS, help="without names: all")
    parser.add_argument("--most", type=int, default=200, help="with --defects: most seeds for each")
    parser.add_argument("--state", type=Path, help="with --defects: file to stop and go on with")
    options = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.freeze()
    if options.again is not None:
        outcome = played(draw(options.again))
        print(f"{tell(outcome)}\n{outcome.digest}")
        return 1 if outcome.wrong else 0
    if options.defects is not None:
        names = options.defects or [*DEFECTS]
        return 1 if find_defects(names, options.first, options.most, options.state) else 0
    return 1 if run(options.first, options.minutes) else 0


if __name__ == "__main__":
    sys.exit(main())
