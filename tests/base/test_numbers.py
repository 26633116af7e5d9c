"""Numbers as people read them."""

from __future__ import annotations

import math

import pytest

from adis_gonio.base.numbers import (
    QuantityRow,
    format_duration,
    format_fixed,
    format_number,
    format_p,
    format_percent,
    format_ranges,
    format_reduction,
    format_span,
    format_uncertain,
    join_words,
    label_quantity,
    name_positions,
    signed,
    with_unit,
)
from adis_gonio.base.uncertainty import Value


def spaced(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ")


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.0, 3, "0"),
        (-12.345, 3, "−12.3"),
        (123456.0, 3, "123456"),
        (1234567.0, 3, "1.23·10⁶"),
        (0.00012345, 3, "0.000123"),
        (0.000012345, 3, "1.23·10⁻⁵"),
        (-2.5e-12, 1, "−2·10⁻¹²"),
        (math.inf, 3, "–"),
        (math.nan, 3, "–"),
        (None, 3, "–"),
    ],
)
def test_a_number_has_its_significant_digits(value, digits, text):
    assert format_number(value, digits) == text


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (2.0, 1, "2.0"),
        (-0.04, 1, "0.0"),
        (-0.06, 1, "−0.1"),
        (1.5e-11, 9, "0.000000000"),
        (1.5e-11, 10, "1.5·10⁻¹¹"),
        (math.nan, 1, "–"),
        (None, 1, "–"),
    ],
)
def test_a_number_has_its_decimals_and_no_minus_before_zero(value, decimals, text):
    assert format_fixed(value, decimals) == text


def test_a_signed_number_has_a_plus_or_a_minus():
    assert [signed(value) for value in (1.5, -1.5, 0.0)] == ["+1.5", "−1.5", "+0"]
    assert signed(1234567.0) == "+1.23457·10⁶"
    assert [signed(value, 2) for value in (1.0, -1.0)] == ["+1.00", "−1.00"]
    assert signed(2 / 3, digits=2) == "+0.67"
    assert signed(None) == signed(math.inf, 1) == "–"


def test_a_span_of_equal_texts_is_one_number():
    assert spaced(format_span(24.41, 24.87, 1, "°C")) == "24.4 to 24.9 °C"
    assert spaced(format_span(24.41, 24.44, 1, "°C")) == "24.4 °C"


@pytest.mark.parametrize(
    ("value", "expanded", "text"),
    [
        (3.23939, 0.0613, "3.239 ± 0.061"),
        (-58.7495, 2.483, "−58.7 ± 2.5"),
        (1234.5, 120.0, "1234 ± 120"),
        (-0.0001, 0.5, "0.00 ± 0.50"),
        (2.76e-6, 5.2e-7, "(2.76 ± 0.52)·10⁻⁶"),
        (0.0, 5.2e-7, "(0.0 ± 5.2)·10⁻⁷"),
        (391.335, None, "391.3, u unknown"),
        (391.335, math.nan, "391.3, u unknown"),
        (391.335, 0.0, "391.3"),
        (391.335, 1e-11, "391.3"),  # rounding of the arithmetic
    ],
)
def test_numbers_have_two_digits_of_their_uncertainty(value, expanded, text):
    assert spaced(format_uncertain(value, expanded)) == text


def test_a_plus_is_shown_if_it_is_asked_for():
    assert spaced(format_uncertain(1.084, 0.131, "mg", sign=True)) == "+1.08 ± 0.13 mg"


@pytest.mark.parametrize(
    ("text", "unit", "shown"),
    [
        ("3.2 ± 0.1", "deg", "(3.2 ± 0.1)°"),
        ("3.2", "deg", "3.2°"),
        ("3.2", "1", "3.2"),
        ("3.2", "us", "3.2 µs"),
        ("3.2", "dps/g", "3.2 °/s/g"),
        ("3.2", "mg/degC", "3.2 mg/°C"),
        ("–", "mg", "–"),
    ],
)
def test_a_unit_follows_its_number(text, unit, shown):
    assert spaced(with_unit(text, unit)) == shown


def test_a_heading_has_the_symbol_and_the_unit():
    assert [label_quantity(*one) for one in (("delta_phi", "deg"), ("delta_k", "1"), ("bias_x", "mg"))] == [
        "Δφ / °", "ΔK", "bias_x / mg",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("p", "text"),
    [
        (0.5, "p = 0.5"),
        (0.0113, "p = 0.011"),
        (0.0042, "p = 0.0042"),
        (9e-4, "p < 10⁻³"),
        (2e-7, "p < 10⁻⁶"),
        (0.0, "p < 10⁻¹²"),
    ],
)
def test_a_p_value_is_a_number_and_below_a_thousandth_the_next_power_of_ten(p, text):
    assert spaced(format_p(p)) == text


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        (1.0, "> 99.9 %"),
        (0.9995, "> 99.9 %"),
        (0.9994, "99.9 %"),
        (0.985, "98.5 %"),
        (0.984, "98 %"),
        (0.54, "54 %"),
        (0.096, "10 %"),
        (0.094, "9.4 %"),
        (0.0005, "0.1 %"),
        (0.0004, "< 0.1 %"),
    ],
)
def test_a_percentage_has_a_decimal_near_its_ends(fraction, text):
    assert spaced(format_percent(fraction)) == text


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (36.2, 1.0, " (36 times less)"),
        (9.4, 1.0, " (9.4 times less)"),
        (2.3, 2.0, " (1.1 times less)"),
        (2.2, 2.0, ""),
        (1.0, 0.0, ""),
        (None, 1.0, ""),
        (1.0, None, ""),
    ],
)
def test_a_reduction_is_stated_from_fifteen_percent_on(before, after, text):
    assert format_reduction(before, after) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.2, "0 s"),
        (59.4, "59 s"),
        (60.0, "1 min"),
        (90.0, "1 min 30 s"),
        (599.0, "9 min 59 s"),
        (629.0, "10 min"),
        (3599.0, "1 h 00 min"),
        (3900.0, "1 h 05 min"),
    ],
)
def test_a_duration_has_no_seconds_from_ten_minutes_on(seconds, text):
    assert format_duration(seconds) == text


def test_lists_of_positions_and_words():
    assert name_positions([7]) == "position 7"
    assert name_positions([3, 4, 9]) == "positions 3, 4, 9"
    assert name_positions([3, 4, 9, 11], most=2) == "positions 3, 4 and 2 more"
    assert format_ranges([9, 1, 2, 3, 4, 4, 7, 10]) == "1–4, 7, 9, 10"
    assert [join_words(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "", "a", "a and b", "a, b and c",
    ]  # fmt: skip


def test_value_u_and_expanded_uncertainty_of_a_row_have_equal_decimals():
    row = QuantityRow.of("delta_phi", Value(0.12345, 0.0123, "deg"))
    assert row == ("Δφ", "°", "0.123", "0.012", "0.024", "1.96")
    assert QuantityRow.of("bias_x", Value(1.23456789, None, "mg")) == (
        "bias_x", "mg", "1.23457", "u unknown", "–", "–",
    )  # fmt: skip
