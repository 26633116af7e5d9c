"""The page of the trace's numbers says what the code uses."""

import dataclasses
import re
from pathlib import Path

import pytest

from adis_gonio.tracing.thresholds import Limits

PAGE = Path(__file__).parents[2] / "docs" / "thresholds.md"
TESTS = Path(__file__).parents[1] / "tracing" / "test_trace_numbers.py"
NUMBERS = PAGE.read_text("utf-8").partition("## What the rules are worth")[0]
ROWS = {
    name: (float(value), origin)
    for name, value, origin in re.findall(
        r"^\| `(\w+)` \| ([^ |]+) \| [^|]*\| (\w+) \|", NUMBERS, re.MULTILINE
    )
}


@pytest.mark.parametrize("field", dataclasses.fields(Limits), ids=lambda field: field.name)
def test_each_number_stands_on_the_page_with_its_value_and_origin(field) -> None:
    assert ROWS[field.name] == (pytest.approx(field.default), field.metadata["origin"])


def test_the_page_has_no_number_that_is_gone() -> None:
    assert set(ROWS) == {field.name for field in dataclasses.fields(Limits)}


def test_fewer_than_forty_numbers_are_neither_derived_nor_promised() -> None:
    tuned = [f for f in dataclasses.fields(Limits) if f.metadata["origin"] in {"chosen", "measured"}]
    assert len(tuned) < 40


def test_each_number_that_is_no_effort_has_a_test_marked_with_it() -> None:
    marked = re.findall(r'^ +@pytest\.mark\.number\("(\w+)"\)$', TESTS.read_text("utf-8"), re.MULTILINE)
    assert set(marked) == {name for name, (_, origin) in ROWS.items() if origin != "effort"}
