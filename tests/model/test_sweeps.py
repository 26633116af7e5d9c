"""Full turns are counted on and on, forth and back, and not by trembling."""

import itertools

import numpy as np
import pytest

from adis_gonio.model.records import Sweeps


def seen(*corners_deg, tremble_deg=0.0):
    """Sweeps of a course by corners, bit by bit, with a hand that trembles."""
    course = np.concatenate([np.linspace(a, b, 400) for a, b in itertools.pairwise(corners_deg)])
    found = Sweeps()
    for angle in course + tremble_deg * np.sin(2.1 * np.arange(len(course))):
        found.see(float(angle))
    return found


@pytest.mark.parametrize("tremble_deg", [0.0, 2.0])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("corners", "full", "way", "span"),
    [
        ((0, 365), 1, 365, 365),
        ((0, 350), 0, 350, 350),
        ((0, 730), 2, 730, 730),
        ((0, 363, 2), 2, 724, 363),
        ((0, 180, 0, 180, 0), 0, 720, 180),  # never all around
        ((0, 100, 60, 365), 1, 445, 365),  # a grip that went back
        ((0, 365, 0, 365), 3, 1095, 365),
        ((0, 5, -360), 1, 365, 365),  # begun the wrong way, within a hand's unevenness
    ],
)
def test_full_turns_are_counted(corners, full, way, span, sign, tremble_deg):
    found = seen(*(sign * c for c in corners), tremble_deg=tremble_deg)
    assert found.full == full
    assert found.travelled_deg == pytest.approx(way, abs=6 + 2 * tremble_deg * len(corners))
    assert found.span_deg == pytest.approx(span, abs=2 * tremble_deg)
    assert found.angle_deg == pytest.approx(sign * corners[-1], abs=tremble_deg)


@pytest.mark.parametrize(
    ("course", "way", "full"),
    [
        ((0, 50, 40), 50, 0),  # 10° back are no reversal yet
        ((0, 50, 39.5), 60.5, 0),
        ((0, 355), 355, 1),  # 5° may be missing from a full turn
        ((0, 50, 39.5, 49.5), 60.5, 0),
    ],
)
def test_a_turn_reverses_after_more_than_10_degrees_back(course, way, full):
    found = Sweeps()
    for angle_deg in course:
        found.see(angle_deg)
    assert found.travelled_deg == way
    assert found.full == full
