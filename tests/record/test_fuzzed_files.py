"""Twenty files of `scripts/fuzz_files.py`, and its judgement of commands that misbehave."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "scripts"
LONGEST_S = 300

MISBEHAVING = """
import json, os, signal, sys, tempfile
from pathlib import Path
import fuzz_files

def say(status, *lines):
    print(*lines, sep="\\n", file=sys.stderr)
    return status

def spin():
    while True:
        pass

commands = {
    "done": lambda words: say(0, "note"),
    "one line": lambda words: say(1, "adis-gonio: a.csv: is empty"),
    "two lines": lambda words: say(1, "adis-gonio: a.csv: is empty", "more"),
    "escape": lambda words: say(1, "adis-gonio: \\x1b[31m"),
    "no line": lambda words: 1,
    "warning": lambda words: say(0, "/a.py:3: RuntimeWarning: overflow"),
    "exception": lambda words: 1 // 0,
    "status": lambda words: 3,
    "crash": lambda words: os.kill(os.getpid(), signal.SIGSEGV),
    "endless": lambda words: spin(),
    "asleep": lambda words: signal.pause(),
    "large": lambda words: len(b"x" * 400_000_000) * 0,
}
fuzz_files.CPU_S, fuzz_files.CLOCK_S = 2, 5
with tempfile.TemporaryDirectory() as folder:
    outcomes = {}
    for name, command in commands.items():
        child = fuzz_files.run(("fit",), Path(folder), command)
        outcomes[name] = fuzz_files.result_of(child, ("fit",), Path(folder)).outcome
print(json.dumps(outcomes))
"""


def run_python(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        cwd=SCRIPTS,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )


def test_strange_files_end_well_or_in_one_line():
    done = run_python("fuzz_files.py", "--files", "20", "--seed", "5", "--jobs", "2")
    assert done.returncode == 0, done.stdout + done.stderr
    (*counts,) = map(int, done.stdout.splitlines()[-2].split()[1:])
    ok, told, noisy, *failures = counts
    assert (sum(counts), noisy, failures) == (20, 0, [0, 0, 0]), done.stdout
    assert ok > 0  # files that are refused at once reach nothing
    assert told > 7


def test_commands_that_misbehave_are_found():
    done = run_python("-c", MISBEHAVING)
    assert json.loads(done.stdout) == {
        "done": "OK",
        "one line": "TOLD",
        "two lines": "NOISY",
        "escape": "NOISY",
        "no line": "NOISY",
        "warning": "NOISY",
        "exception": "TRACEBACK",
        "status": "TRACEBACK",
        "crash": "TRACEBACK",
        "endless": "HUNG",
        "asleep": "HUNG",
        "large": "BIG",
    }, done.stderr
