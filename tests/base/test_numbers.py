"""Numbers as people read them."""

from __future__ import annotations

import pytest

from adis_gonio.base.numbers import format_p


@pytest.mark.parametrize(
    ("p", "text"),
    [
        (0.5, "p = 0.5"),
        (0.0042, "p = 0.0042"),
        (9e-4, "p < 10⁻³"),
        (2e-7, "p < 10⁻⁶"),
        (0.0, "p < 10⁻¹²"),
    ],
)
def test_a_p_value_is_a_number_and_below_a_thousandth_the_next_power_of_ten(p, text):
    assert format_p(p).replace("\N{NO-BREAK SPACE}", " ") == text
