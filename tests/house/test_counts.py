"""One dwell, two dwells: a number has its noun from one place."""

import re
from pathlib import Path

from adis_gonio.base.numbers import counted

SOURCE = Path(__file__).resolve().parents[2] / "src" / "adis_gonio"
RAW = re.compile(r"\{[^{}:]+\} (?:dwells|positions|samples|poses)\b")
ALWAYS_MANY = {
    "tracing/validation.py",  # nine dwells or more
    "tracing/within/courses.py",  # a mean of several
    "tracing/within/faults.py",  # limits of the program
    "tracing/within/samples.py",  # asks for more than one itself
    "tracing/within/second_pass.py",  # limits of the program
    "device/sensor/driver.py",
    "record/plans.py",
    "tracing/one_pose.py",
}


def test_one_is_singular_and_all_else_plural():
    assert [counted(n, "dwell") for n in (0, 1, 2)] == ["0 dwells", "1 dwell", "2 dwells"]
    assert [counted(n, "axis", "axes") for n in (1, 3)] == ["1 axis", "3 axes"]


def test_no_sentence_counts_dwells_or_positions_by_itself():
    found = [
        f"{path.relative_to(SOURCE)}:{number}: {line.strip()}"
        for path in sorted(SOURCE.rglob("*.py"))
        if str(path.relative_to(SOURCE)) not in ALWAYS_MANY
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if RAW.search(line)
    ]
    assert not found
