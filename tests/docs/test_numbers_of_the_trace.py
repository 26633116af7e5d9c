"""The numbers of the trace: few are chosen, and each that is no effort has a test."""

import dataclasses
import re
from pathlib import Path

from adis_gonio.tracing.thresholds import Limits

TESTS = Path(__file__).parents[1] / "tracing" / "test_trace_numbers.py"
ORIGINS = {field.name: field.metadata["origin"] for field in dataclasses.fields(Limits)}


def test_fewer_than_forty_numbers_are_neither_derived_nor_promised() -> None:
    assert sum(origin in {"chosen", "measured"} for origin in ORIGINS.values()) < 40


def test_each_number_that_is_no_effort_has_a_test_marked_with_it() -> None:
    marked = re.findall(r'^ +@pytest\.mark\.number\("(\w+)"\)$', TESTS.read_text("utf-8"), re.MULTILINE)
    assert set(marked) == {name for name, origin in ORIGINS.items() if origin != "effort"}
