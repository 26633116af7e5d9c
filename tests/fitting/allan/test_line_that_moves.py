"""A line that moves, a sway and turn-on scatter: records at rest of a real sensor, and simulated twins."""

import numpy as np
import pytest

from adis_gonio import fit, load_session, trace
from adis_gonio.base.errors import DataError
from adis_gonio.fitting.allan.allan_fit import fit_allan, moving_peak
from recordings import RUNS_AT_REST, recording

PERIOD_S = 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_line_that_moves_is_found_and_noise_has_none(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(200_000)
    rounded = np.convolve(noise, np.ones(8) / 8, "same") + 0.02 * rng.standard_normal(200_000)
    assert moving_peak([noise], PERIOD_S, 1.0) is None
    assert moving_peak([rounded], PERIOD_S, 1.0) is None
    time = PERIOD_S * np.arange(200_000)
    frequency = 19.5 + np.sin(2 * np.pi * time / 1500 + seed)
    line = 0.5 * np.sin(2 * np.pi * np.cumsum(frequency) * PERIOD_S)
    found = moving_peak([noise + line], PERIOD_S, 1.0)
    assert found is not None
    assert found.low_hz == pytest.approx(18.5, abs=0.4)
    assert found.high_hz == pytest.approx(20.5, abs=0.4)
    assert moving_peak([noise + line], PERIOD_S, 25.0) is None


def test_resonance_and_sway_of_a_real_sensor_at_rest_are_named_and_no_drift_is_called() -> None:
    session = load_session(recording("adis16405/run4_first_hour"))
    notes = [one.notes for one in fit_allan(session, part="gyro").axes]
    assert [any("a line between 1" in text and "resonance" in text for text in one) for one in notes] == [
        False,
        False,
        True,
    ]
    swaying = fit_allan(session, part="accelerometer").axes
    assert all(any("0.5363 Hz" in text and "a sway" in text for text in one.notes) for one in swaying)
    assert not trace(session, part="gyro").found
    with pytest.raises(DataError, match=r"the part lies flat, X and Y read 0\.00.* not 1\.02 g"):
        fit(session)


@pytest.mark.parametrize("name", RUNS_AT_REST)
def test_no_drift_is_called_in_ten_thousand_seconds_at_rest(name: str) -> None:
    assert not trace(load_session(recording(name)), part="gyro").found
