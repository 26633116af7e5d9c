"""The text of the C header: its names, its comment, and what it refuses; no compiler is needed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.handover.c_header import c_header
from handover.calibrations import EVERY, PLANE, calibration, of_counts


@pytest.mark.parametrize("name", ["", "2x", "a-b", "a b", "_a", "é"])
def test_names_that_c_cannot_have_are_refused(name):
    with pytest.raises(UsageError, match="is no name for C"):
        c_header(calibration(PLANE), name)


def test_every_coefficient_stands_in_the_header_with_its_u_and_unit():
    own = calibration(PLANE, EVERY, title="bench 3", operator="M. Muster")
    text = c_header(own)
    for one in own.parameters:
        row = next(line for line in text.splitlines() if line.startswith(f" * {one.name} "))
        value, unit, u = row.split()[2:5]
        assert float(value) == pytest.approx(one.value, rel=1e-8)
        assert float(u) == pytest.approx(one.u, rel=0.05)
        assert unit == one.unit.translate(str.maketrans({"²": "2", "³": "3", "°": "d"})).replace(
            "/dC", "/degC"
        )
    for piece in (
        "bench 3",
        "M. Muster",
        "ab" * 32,
        "ADIS_GONIO_ALPHA_UDEG 31250000L",
        "ADIS_GONIO_U_UDEG",
    ):
        assert piece in text


def test_what_a_firmware_cannot_solve_is_refused():
    with pytest.raises(FitError, match="too large"):
        c_header(calibration(PLANE, {"quadratic": (99.0, 99.0), "cubic": (99.0, 99.0)}))
    with pytest.raises(FitError, match="gains are too far from 1"):
        c_header(calibration({**PLANE, "scale_x": 0.3}))
    # The zero of a converter of 24 bits without a sign; a scan holds 256 times its counts in 32 bits.
    with pytest.raises(FitError, match="exceed the 24 bits"):
        c_header(of_counts(zero=2.0**23))
    with pytest.raises(FitError, match="exceed the 24 bits"):
        c_header(calibration({**PLANE, "bias_x": 1e14}))


def test_without_noise_no_u_is_claimed():
    bare = replace(calibration(PLANE), covariance=None)
    text = c_header(bare)
    assert "_U_UDEG" not in text
    assert "is not known" in text
