"""What a session settles about its own noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adis_gonio import fit
from adis_gonio.fitting.noise import NoiseAssumptions, _equal_to_dof
from fitting.test_uncertainty import NINE, turn


@pytest.mark.parametrize("true", [0.0013, 0.02, 3.0, 80.0])
def test_the_scale_at_which_chi2_is_its_degrees_of_freedom_is_found(true: float) -> None:
    found = _equal_to_dof(lambda s: 7 * (true / s) ** 2, 7, 1e-3, 100.0)
    assert found == pytest.approx(true, rel=1e-3)


def test_a_scale_beyond_the_range_is_its_end() -> None:
    assert _equal_to_dof(lambda s: 7 * (1e-5 / s) ** 2, 7, 1e-3, 100.0) == 1e-3
    assert _equal_to_dof(lambda s: 7 * (500.0 / s) ** 2, 7, 1e-3, 100.0) == 100.0
    assert _equal_to_dof(lambda s: 0.0, 7, 1e-3, 100.0) == 1e-3


def test_what_is_assumed_changes_only_what_nothing_states() -> None:
    readings = fit(turn(NINE)).origin.readings
    known = np.arange(9) < 4
    own = np.tile(4.0 * np.eye(2), (9, 1, 1))
    mixed = NoiseAssumptions(scale=3.0, extra_mg=2.0, sigma_rad=0.1).applied(
        type(readings)(**{**vars_of(readings), "known": known, "own_covariance": own})
    )
    np.testing.assert_allclose(mixed.own_covariance[known], np.tile(8.0 * np.eye(2), (4, 1, 1)))
    np.testing.assert_allclose(mixed.own_covariance[~known], np.tile(40.0 * np.eye(2), (5, 1, 1)))
    assert mixed.fixture_rad == 0.1


def vars_of(readings: object) -> dict[str, object]:
    return {name: getattr(readings, name) for name in readings.__dataclass_fields__}


def test_an_estimated_noise_has_the_degrees_of_freedom_of_the_residual() -> None:
    result = fit(turn(NINE, stated=None, noise=0.5, sigma=0.0), "ml")
    noise = result.origin.noise
    # Eighteen readings, six parameters.
    assert noise.dof == result.dof == 12
    assert result.chi2 == pytest.approx(12, rel=1e-3)
    left = result.residual_mg
    assert noise.scale == pytest.approx(math.sqrt((left**2).sum() / 12), rel=1e-3)
    assert "were given" in noise.notes[0]
    assert "(12 degrees of freedom)" in noise.notes[0]


def test_a_residual_beyond_the_noise_is_made_up_for_until_it_agrees() -> None:
    result = fit(turn(NINE, stated=0.1, noise=2.0, sigma=0.0), "ml")
    made = result.origin
    assert result.chi2 > 100
    left = (made.fit.misfit**2).sum()
    assert left / (0.1**2 + made.noise.extra_mg**2) == pytest.approx(12, rel=0.01)
    assert made.noise.dof == 12
