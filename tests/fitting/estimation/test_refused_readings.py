"""Sessions whose readings cannot be what the file says, and what the error tells to do about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from adis_gonio.base.errors import DataError, FitError
from adis_gonio.fitting.estimation.readings import (
    from_means,
    mg_per_unit,
    quantized_means,
    readings_of,
    reduced,
)
from adis_gonio.model.effects import Conditions
from fitting.estimation.turns import turn


def test_readings_in_another_unit_name_the_unit_that_would_fit() -> None:
    with pytest.raises(DataError) as caught:
        readings_of(turn(1.0, source="bench.csv"))
    said = str(caught.value)
    assert said.startswith(
        "bench.csv: by accel_unit mg and sensor generic, readings are 0.00100 g long, not"
    )
    assert "; g would fit: add a line '# accel_unit: g', or give --unit g" in said
    assert said.endswith("; a plane that is turned has to be vertical")
    with pytest.raises(DataError, match=r"readings are 1000 g long.*; mg would fit"):
        readings_of(turn(1000.0, accel_unit="g"))
    with pytest.raises(DataError, match="mps2 would fit") as caught:
        readings_of(turn(9.81, accel_unit="g"))
    assert "vertical" not in str(caught.value)
    with pytest.raises(DataError, match=r"mg or lsb would fit|lsb or mg would fit"):
        readings_of(turn(1500.0, accel_unit="g", sensor="adis16354"))
    with pytest.raises(DataError, match=r"counts if .*; a plane") as caught:
        readings_of(turn(0.01))
    assert "would fit" not in str(caught.value)


def test_one_reading_of_another_length_is_named() -> None:
    sound = turn()
    dwells = list(sound.dwells)
    dwells[3] = replace(dwells[3], accel=0.3 * dwells[3].accel)
    with pytest.raises(DataError, match="readings of position 3 are not 1 g long as the others"):
        readings_of(replace(sound, dwells=tuple(dwells)))
    dwells[5] = replace(dwells[5], accel=1.7 * dwells[5].accel)
    with pytest.raises(DataError, match="readings of positions 3, 5 are not"):
        readings_of(replace(sound, dwells=tuple(dwells)))


@pytest.mark.parametrize("count", [4, 5, 8])
@pytest.mark.parametrize("sector_deg", [360.0, 90.0, 40.0])
def test_few_readings_in_a_sector_show_the_sense_of_turn(count: int, sector_deg: float) -> None:
    refused = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        angles = rng.permutation(np.linspace(0, sector_deg, count, endpoint=False))
        readings_of(turn(angles=tuple(angles)))
        try:
            readings_of(turn(angles=tuple(angles), sign=-1.0))
        except DataError as error:
            refused += "turn the other way" in str(error)
    assert refused >= 19


def test_readings_that_turn_the_other_way_are_refused_and_a_needless_reversal_too() -> None:
    readings_of(turn())
    with pytest.raises(DataError, match=r"change the sign of angle_deg \(--reverse\)"):
        readings_of(turn(sign=-1.0))
    with pytest.raises(DataError, match="leave --reverse out"):
        readings_of(turn(sign=-1.0, facts={"overrides": {"reverse": True}}))
    # Three positions do not tell a turn the other way from an axis that is upside down.
    readings_of(turn(sign=-1.0, angles=(0.0, 90.0, 180.0)))


def test_what_is_no_number_or_has_no_scale_is_refused() -> None:
    sound = turn()
    broken = list(sound.dwells)
    broken[2] = replace(broken[2], accel=np.array([[np.nan, 1.0]]))
    with pytest.raises(DataError, match="position 2 holds NaN or infinity"):
        reduced(replace(sound, dwells=tuple(broken)))
    with pytest.raises(DataError, match="LSB of sensor 'generic' is not known"):
        mg_per_unit(replace(sound, accel_unit="lsb"))
    with pytest.raises(FitError, match="all alike"):
        reduced(replace(sound, dwells=sound.dwells[:1], accel_unit="counts"))
    with pytest.raises(DataError, match="plane none needs three axes, there are two"):
        reduced(replace(sound, plane="none"))


def test_units_have_the_size_that_they_have() -> None:
    sound = turn()
    assert mg_per_unit(sound) == 1.0
    assert mg_per_unit(replace(sound, accel_unit="g")) == 1000.0
    assert mg_per_unit(replace(sound, accel_unit="mps2")) * 9.80665 == pytest.approx(1000.0)
    assert mg_per_unit(replace(sound, accel_unit="counts")) == 1.0


def test_readings_take_no_field_that_they_do_not_have() -> None:
    with pytest.raises(TypeError, match="taste"):
        from_means(
            np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)), Conditions(np.arange(2.0)), taste=1, colour=2
        )


def test_degrees_of_freedom_add_up_only_where_dwells_have_noise_of_their_own() -> None:
    made = from_means(
        np.ones((3, 2)),
        np.tile(np.diag([1.0, 3.0]), (3, 1, 1)),
        Conditions(np.arange(3.0)),
        dof=np.array([5.0, 7.0, np.inf]),
    )
    assert made.noise_dof == 7.0
    assert replace(made, pooled=False).noise_dof == 12.0
    assert np.isinf(replace(made, dof=np.full(3, np.inf)).noise_dof)
    np.testing.assert_allclose(made.variance_of_mean, 2.0)
    assert made.equations_each == 1
    assert replace(made, angle_rad=np.zeros(3)).equations_each == 2


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.2, 0.3, 0.45])
def test_what_a_step_leaves_on_a_mean_is_that_of_all_places_between_two_codes(sigma: float) -> None:
    step = 3.0
    place = step * (np.arange(400) + 0.5) / 400
    edges = np.arange(-20, 21) * step
    if sigma:
        above = norm.cdf((place[:, None] - (edges + step / 2)) / (sigma * step))
        mean = edges[0] + step * above.sum(axis=1)
    else:
        mean = step * np.round(place / step)
    left = np.mean((mean - place) ** 2)
    variance = (sigma * step) ** 2 + step**2 / 12
    found = quantized_means(np.array([[variance, 1e3]]), np.array([step, step]))
    assert found[0, 0] == pytest.approx(left, rel=0.01, abs=1e-9)
    assert found[0, 1] == pytest.approx(0, abs=1e-12)
    assert not quantized_means(np.array([[1e3, 1e3]]), np.array([step, step])).any()
