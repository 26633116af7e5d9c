"""JSON documents of dataclasses follow from their fields and the metadata of these."""

import json
import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from adis_gonio.base.jsonable import (
    HIDDEN,
    INLINE,
    KEYED_BY_NAME,
    NAMED_BY_UNIT,
    OPTIONAL,
    JsonRecord,
    finite,
    json_object,
    key,
)
from adis_gonio.base.uncertainty import Value


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True)
class Point:
    x: float
    y: tuple[float, ...] = ()


class Part(JsonRecord):
    name: str = field(metadata=HIDDEN)
    size: float = field(metadata=NAMED_BY_UNIT)
    unit: str = field(default="mm", metadata=HIDDEN)


class Whole(JsonRecord):
    kind: str = field(metadata=key("type"))
    first: Part = field(metadata=INLINE)
    parts: tuple[Part, ...] = field(metadata=KEYED_BY_NAME)
    spare: Part | None = field(default=None, metadata=OPTIONAL)
    turns: int = field(default=0, metadata=OPTIONAL)
    dof: float = field(default=1.0, metadata=OPTIONAL)


class Chosen(JsonRecord):
    document_keys = ("twice", "value", "hue")

    value: int
    hidden: str = ""
    hue: Colour = Colour.RED

    @property
    def twice(self) -> int:
        return 2 * self.value


def text(value: object) -> str:
    return json.dumps(finite(value), allow_nan=False)


def test_fields_are_the_document_in_their_order():
    assert text(Point(1.0, (2.0, math.nan))) == '{"x": 1.0, "y": [2.0, null]}'


def test_metadata_says_where_a_document_differs_from_the_fields():
    whole = Whole("box", Part("a", 1.0), (Part("b", 2.0), Part("c", 3.0, "in")))
    assert text(whole) == text(
        {"type": "box", "size_mm": 1.0, "parts": {"b": {"size_mm": 2.0}, "c": {"size_in": 3.0}}}
    )


def test_what_is_optional_is_left_out_at_its_default_and_where_it_is_not_finite():
    whole = Whole("box", Part("a", 1.0), (), Part("s", 4.0), turns=2, dof=math.inf)
    assert list(whole.as_dict()) == ["type", "size_mm", "parts", "spare", "turns"]


def test_listed_keys_take_properties_and_leave_out_the_other_fields():
    assert text(Chosen(3)) == '{"twice": 6, "value": 3, "hue": "red"}'


def test_arrays_numbers_and_nested_records_become_types_of_json():
    made = json_object(
        a=np.array([[1, 2]]), b=np.float32(0.5), c={"u": Value(1.0, None, "mg")}, d=(Point(0.0),)
    )
    assert made["a"] == [[1, 2]]
    assert made["b"] == 0.5
    assert made["c"]["u"] == Value(1.0, None, "mg").as_dict()
    assert made["d"] == [{"x": 0.0, "y": []}]
