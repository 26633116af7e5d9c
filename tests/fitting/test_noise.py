"""What a session settles about its own noise."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import fit, trace
from adis_gonio.faces.cli import main
from adis_gonio.fitting.noise_estimation import NoiseAssumptions, scale_at_dof
from fitting.test_uncertainty import NINE, turn


@pytest.mark.parametrize("true", [0.0013, 0.02, 3.0, 80.0])
def test_the_scale_at_which_chi2_is_its_degrees_of_freedom_is_found(true: float) -> None:
    found = scale_at_dof(lambda s: 7 * (true / s) ** 2, 7, 1e-3, 100.0)
    assert found == pytest.approx(true, rel=1e-3)


def test_a_scale_beyond_the_range_is_its_end() -> None:
    assert scale_at_dof(lambda s: 7 * (1e-5 / s) ** 2, 7, 1e-3, 100.0) == 1e-3
    assert scale_at_dof(lambda s: 7 * (500.0 / s) ** 2, 7, 1e-3, 100.0) == 100.0
    assert scale_at_dof(lambda s: 0.0, 7, 1e-3, 100.0) == 1e-3


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


def samples_file(
    path: Path, seed: int, lone: int, *, quadratic_mg: float = 0.0, lone_mg: float = 1.0, lines: int = 40
) -> Path:
    """Write a turn of 18 dwells with noise of 1 mg a sample; `lone` of them have one row each."""
    rng = np.random.default_rng(seed)
    rows = ["# sensor: generic", "# accel_unit: mg", "# fixture_sigma_deg: 0.001"]
    rows.append("time_s,position,angle_deg,ax,ay")
    single = rng.choice(18, lone, replace=False)
    for k in range(18):
        angle = math.radians(20 * k)
        cos, sin = math.cos(0.05 - angle), math.sin(0.06 - angle)
        mean = np.array([1010 * cos + BIAS_MG + quadratic_mg * cos**2, 990 * sin - 7])
        count, noise = (1, lone_mg) if k in single else (lines, 1.0)
        for n, (x, y) in enumerate(mean + noise * rng.standard_normal((count, 2))):
            rows.append(f"{10 * k + 0.02 * n:.2f},{k + 1},{20 * k},{x:.4f},{y:.4f}")
    path.write_text("\n".join(rows) + "\n")
    return path


BIAS_MG = 12.0


@pytest.mark.parametrize("lone", [1, 2, 6])
def test_readings_of_unstated_noise_do_not_hide_that_the_model_lacks_an_effect(
    tmp_path: Path, lone: int, capsys: pytest.CaptureFixture[str]
) -> None:
    path = samples_file(tmp_path / "a.csv", 5, lone, quadratic_mg=6.0)
    result = fit(path, method="ml")
    assert result.extra_mg > 0
    assert result.chi2 > 20 * result.dof
    assert result.dof == 2 * (18 - lone) - 6
    u = result["bias_x"].U
    assert u is not None
    assert abs(result["bias_x"].value - BIAS_MG) < u < 15
    assert main(["fit", str(path)]) == 0
    assert "The model does not describe this session" in capsys.readouterr().out


def test_readings_of_unstated_noise_are_covered_as_the_others_are(tmp_path: Path) -> None:
    """Binomial(100, 0.05): 12 misses or more have a probability of 0.4 %."""
    misses = 0
    for seed in range(100):
        result = fit(samples_file(tmp_path / "a.csv", seed, 2), method="ml")
        assert result.extra_mg == 0
        misses += abs(result["bias_x"].value - BIAS_MG) > result["bias_x"].U
    assert misses < 12


def test_a_reading_of_unstated_noise_counts_no_more_than_the_best_of_the_others(tmp_path: Path) -> None:
    """Two single rows without any noise at all could otherwise determine the parameters alone."""
    result = fit(samples_file(tmp_path / "a.csv", 3, 2, lone_mg=0.0), method="ml")
    alone = fit(samples_file(tmp_path / "b.csv", 3, 0), method="ml")
    assert result["bias_x"].u > 0.9 * alone["bias_x"].u
    assert any("2 readings of one sample without a stated noise" in text for text in result.warnings)


def test_too_few_readings_of_known_noise_leave_one_noise_for_all(tmp_path: Path) -> None:
    result = fit(samples_file(tmp_path / "a.csv", 3, 16, lone_mg=3.0), method="ml")
    assert not result.origin.readings.known.any()
    assert result["bias_x"].u == pytest.approx(3 / math.sqrt(18), rel=0.5)


def test_a_trace_tests_its_model_by_the_readings_of_known_noise(tmp_path: Path) -> None:
    found = trace(samples_file(tmp_path / "a.csv", 5, 2, quadratic_mg=6.0))
    assert found.adequate
    assert {one.effect for one in found.found} == {"quadratic", "bias"}
