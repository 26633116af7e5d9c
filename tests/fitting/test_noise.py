"""What a session settles about its own noise."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from adis_gonio import fit, trace
from adis_gonio.fitting.determination import NoiseAssumptions, scale_at_dof
from fitting.test_uncertainty import NINE, turn


@pytest.mark.parametrize("true", [0.0013, 0.02, 3.0, 80.0])
def test_the_scale_at_which_chi2_is_its_degrees_of_freedom_is_found(true: float) -> None:
    found = scale_at_dof(lambda s: 7 * (true / s) ** 2, 7, 1e-3, 100.0)
    assert found == pytest.approx(true, rel=1e-3)


def test_a_scale_beyond_the_range_is_its_end() -> None:
    assert scale_at_dof(lambda s: 7 * (1e-5 / s) ** 2, 7, 1e-3, 100.0) == 1e-3
    assert scale_at_dof(lambda s: 7 * (500.0 / s) ** 2, 7, 1e-3, 100.0) == 100.0
    assert scale_at_dof(lambda s: 0.0, 7, 1e-3, 100.0) == 1e-3


def test_an_assumed_noise_scales_the_placeholder_and_adds_to_every_reading() -> None:
    readings = replace(
        fit(turn(NINE)).origin.readings, noise_known=False, own_covariance=np.tile(np.eye(2), (9, 1, 1))
    )
    applied = NoiseAssumptions(scale=3.0, extra_mg=2.0, sigma_rad=0.1).applied(readings)
    np.testing.assert_allclose(applied.own_covariance, np.tile(13.0 * np.eye(2), (9, 1, 1)))
    assert applied.fixture_rad == 0.1


def test_an_estimated_noise_has_the_degrees_of_freedom_of_the_residual() -> None:
    result = fit(turn(NINE, stated=None, noise=0.5, sigma=0.0), "ml")
    noise = result.origin.noise
    # Eighteen readings, six parameters.
    assert noise.scale_dof == result.dof == 12
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


# -- some readings state no noise ----------------------------------------------------------------------

BIAS_MG = 12.0


def samples_file(path: Path, seed: int, lone: int, lone_mg: float = 1.0) -> Path:
    """Write a turn of 18 dwells with noise of 1 mg a sample; `lone` of them have one row each."""
    rng = np.random.default_rng(seed)
    rows = ["# sensor: generic", "# accel_unit: mg", "# fixture_sigma_deg: 0.001"]
    rows.append("time_s,position,angle_deg,ax,ay")
    single = rng.choice(18, lone, replace=False)
    for k in range(18):
        angle = math.radians(20 * k)
        mean = np.array([1010 * math.cos(0.05 - angle) + BIAS_MG, 990 * math.sin(0.06 - angle) - 7])
        count, noise = (1, lone_mg) if k in single else (40, 1.0)
        for n, (x, y) in enumerate(mean + noise * rng.standard_normal((count, 2))):
            rows.append(f"{10 * k + 0.02 * n:.2f},{k + 1},{20 * k},{x:.4f},{y:.4f}")
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_few_readings_of_unstated_noise_leave_one_noise_for_all_and_intervals_that_hold(
    tmp_path: Path,
) -> None:
    """Binomial(50, 0.05): 8 misses or more have a probability of 0.4 %."""
    misses = 0
    for seed in range(50):
        result = fit(samples_file(tmp_path / "a.csv", seed, 2), method="ml")
        assert not result.origin.readings.noise_known
        misses += abs(result["bias_x"].value - BIAS_MG) > result["bias_x"].U
    assert misses < 8
    assert any("2 dwells of one sample without a stated noise" in text for text in result.warnings)
    assert any("chi2 is therefore no test" in text for text in result.warnings)


def test_a_reading_that_agrees_by_chance_counts_no_more_than_the_others(tmp_path: Path) -> None:
    """Two single rows without any noise at all could otherwise determine the parameters alone."""
    result = fit(samples_file(tmp_path / "a.csv", 3, 2, lone_mg=0.0), method="ml")
    alone = fit(samples_file(tmp_path / "b.csv", 3, 0), method="ml")
    assert result["bias_x"].u > 0.7 * alone["bias_x"].u


def test_a_trace_of_readings_without_a_stated_noise_does_not_claim_an_adequate_model(
    tmp_path: Path,
) -> None:
    found = trace(samples_file(tmp_path / "a.csv", 5, 2))
    assert {one.effect for one in found.found} == {"bias"}
    assert not found.adequate


@pytest.mark.parametrize(("positions", "noise_mg"), [(12, 0.2), (12, 0.02), (6, 0.02)])
def test_an_unstated_noise_beside_a_stated_fixture_has_the_degrees_of_freedom_that_show_it(
    tmp_path: Path, positions: int, noise_mg: float
) -> None:
    rng = np.random.default_rng(11)
    angle = np.arange(0.0, 360.0, 360 / positions)
    estimated, counted = [], []
    for _ in range(30):
        psi = np.radians(40.0 - angle + 0.1 * rng.standard_normal(positions))
        xy = 1000 * np.stack([np.cos(psi), np.sin(psi)], axis=1)
        xy += noise_mg * rng.standard_normal(xy.shape)
        rows = [f"{60 * k},{k},{angle[k]:g},{x:.5f},{y:.5f}" for k, (x, y) in enumerate(xy)]
        head = ["# sensor: generic", "# accel_unit: mg", "# fixture_sigma_deg: 0.1"]
        path = tmp_path / "hand.csv"
        path.write_text("\n".join([*head, "time_s,position,angle_deg,ax,ay", *rows]) + "\n")
        origin = fit(path, method="ml").origin
        assert origin is not None
        estimated.append(origin.noise.scale)
        counted.append(origin.noise.scale_dof)
    # The length shows the noise: a length each, less 2 gains, Δφ and 2 biases. The angles scatter 9 times
    # more, or 90 times. One session in ten may show none of the noise.
    seen = positions - 5
    assert np.quantile(counted, [0.5, 0.9]) == pytest.approx(seen, abs=1.0)
    middle = float(np.sqrt(chi2.ppf(0.5, seen) / seen))
    assert np.median(estimated) == pytest.approx(middle * noise_mg, rel=0.3)
    if seen == 7:  # the variance of 30 estimates with 7 degrees of freedom has a mean that is known to 10 %
        assert np.mean(np.square(estimated)) == pytest.approx(noise_mg**2, rel=0.3)
