"""Values of files pass up to the limits of their type, and a message has the way to the wrong one."""

import math

import pytest

from adis_gonio.base import shapes
from adis_gonio.base.shapes import LONGEST_TEXT, Shape, ShapeError

PERSON = shapes.fields({"name": shapes.text}, {"ages": shapes.list_of(shapes.whole(0, 150), 1, 2)})


@pytest.mark.parametrize(
    ("shape", "good", "bad"),
    [
        (shapes.number(0, 1), [0, 1, 0.5], [-1e-9, 1 + 1e-9, math.nan, True, "1", None]),
        (shapes.whole(1, 3), [1, 3], [0, 4, 2.0, True, "2"]),
        (shapes.choice("a", 1, None), ["a", 1, None], ["b", True, 1.0, ["a"]]),
        (shapes.text, ["", "x" * LONGEST_TEXT], ["x" * (LONGEST_TEXT + 1), b"x", None]),
        (shapes.truth_value, [True, False], [0, 1, None]),
        (shapes.moment, ["2026-11-24T10:00:00+00:00"], ["2026-11-24T10:00:00", "now", 5, None]),
        (shapes.nullable(shapes.whole(1, 3)), [None, 2], [0]),
        (shapes.list_of(shapes.text, 1, 2), [["a"], ["a", "b"]], [[], ["a", "b", "c"], [1], ("a",), "a"]),
        (shapes.mapping_of(shapes.text), [{}, {"any": "a"}], [{"any": 1}, []]),
        (PERSON, [{"name": "A"}, {"name": "A", "ages": [150]}], [{}, {"name": "A", "age": 3}, "A"]),
    ],
)
def test_a_value_passes_up_to_the_limits_of_its_type(shape: Shape, good: list, bad: list) -> None:
    for value in good:
        shape(value)
    for value in bad:
        with pytest.raises(ShapeError):
            shape(value)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ({"name": "A", "ages": [3, 151]}, ".ages[1] is 151: expected an integer from 0 to 150"),
        ({"name": "A", "ages": []}, ".ages is []: expected a list of 1 to 2 values"),
        ({"ages": [3]}, " lacks 'name'"),
        ({"name": 10**30}, ".name is an integer of 100 bits: "),
        ({"name": ["x" * 100]}, f".name is ['{'x' * 37}…: "),
    ],
)
def test_a_message_names_the_way_to_the_wrong_value(value: object, told: str) -> None:
    with pytest.raises(ShapeError) as caught:
        PERSON(value)
    assert str(caught.value).startswith(told)
    assert len(str(caught.value)) < 120


def test_a_name_that_cannot_be_printed_is_escaped() -> None:
    with pytest.raises(ShapeError, match=r"^\['\\x1b\[2J'\] is 1: "):
        shapes.mapping_of(shapes.text)({"\x1b[2J": 1})
