"""Local gravity against values that the standard and national surveys publish."""

import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.model.records import normal_gravity_mps2


@pytest.mark.parametrize(
    ("latitude", "height", "expected", "within"),
    [
        (0.0, 0.0, 9.7803253359, 1e-9),  # WGS 84, equator
        (90.0, 0.0, 9.8321849379, 1e-8),  # WGS 84, pole
        (-90.0, 0.0, 9.8321849379, 1e-8),
        (45.0, 0.0, 9.806199, 1e-5),  # normal gravity at 45°
        (45.0, 1000.0, 9.806199 - 3.0855e-3, 3e-5),  # free-air gradient 0.30855 mGal/m there
        (52.3, 80.0, 9.81252, 3e-4),  # Braunschweig, absolute measurements
    ],
)
def test_normal_gravity_agrees_with_published_values(latitude, height, expected, within):
    assert normal_gravity_mps2(latitude, height) == pytest.approx(expected, abs=within)


@pytest.mark.parametrize(("latitude", "height"), [(91, 0), (float("nan"), 0), (45, 20_000)])
def test_a_place_that_is_none_is_refused(latitude, height):
    with pytest.raises(UsageError, match="take"):
        normal_gravity_mps2(latitude, height)
