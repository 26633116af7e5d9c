"""Limits are the quantiles that they claim to be; the spectrum's model holds."""

import numpy as np
import pytest
from scipy import stats

from adis_gonio.bench.bringup import STEPS, bring_up
from adis_gonio.bench.bringup.bringup_step import ALPHA, Z, highest_bin, variance_ratio
from adis_gonio.bench.bringup.part_steps import flicker, spectrum
from adis_gonio.bench.bringup.update_steps import nearest_code
from adis_gonio.device.sensor.settings import filter_response, rounding_spectrum, sample_period_s
from adis_gonio.sim.noise import Flicker
from adis_gonio.sim.sampling import bartlett_sums, history_rows, taps
from fakes.changed_chips import Change, NewNever, open_chip


def test_each_limit_is_exceeded_with_its_probability():
    assert 2 * stats.norm.sf(Z) == pytest.approx(ALPHA, rel=0.05)
    for dof in (3.0, 60.0, 4000.0):
        low, high = variance_ratio(dof)
        assert stats.chi2.cdf(low * dof, dof) == pytest.approx(ALPHA / 2)
        assert stats.chi2.sf(high * dof, dof) == pytest.approx(ALPHA / 2)
    assert 1000 * np.exp(-highest_bin(1000)) == pytest.approx(ALPHA)


def filtered(m, n, sigma, seed):
    """Rounded samples of white noise behind the chip's filter, in LSB."""
    noise = np.random.default_rng(seed).normal(0, sigma * 1024, (n + history_rows(m), 1))
    return bartlett_sums(np.rint(noise).astype(np.int64), m) / taps(m) ** 2 / 1024


@pytest.mark.parametrize("m", range(7))
def test_the_spectrum_of_rounded_filtered_noise_is_the_models(m):
    sigma, n = 10.0, 1 << 15
    power = np.mean([spectrum(np.rint(filtered(m, n, sigma, seed)))[1][:, 0] for seed in range(8)], axis=0)
    cycles = np.fft.rfftfreq(n)
    model = sigma**2 * filter_response(m, cycles) + rounding_spectrum(m, sigma, cycles)
    ratio = (power / model)[4:-1]
    for band in np.array_split(ratio, 16):
        assert band.mean() == pytest.approx(1.0, abs=5 * np.sqrt(35 / 18 / 8 / len(band)) + 0.01)


def test_the_level_of_flicker_is_that_of_the_simulated_world():
    rate = 819.2
    n = 1 << 14
    time_s = np.arange(n) / rate
    powers = [
        spectrum(Flicker(np.array([1.0]), np.random.default_rng(seed)).at(time_s))[1][:, 0]
        for seed in range(30)
    ]
    hz = np.fft.rfftfreq(n) * rate
    band = (hz > 0.3) & (hz < 1.2)
    model = flicker(np.array([1.0]), hz[band], rate)[:, 0]
    assert np.mean(np.mean(powers, axis=0)[band] / model) == pytest.approx(1.0, abs=0.25)


def test_a_chip_without_the_new_data_flag_is_not_watched_for_minutes():
    with open_chip(Change("", NewNever), 2) as bus:
        begin_s = bus.now_s()
        done = bring_up(bus, steps=tuple(step for step in STEPS if step.name == "sample rate"))
        assert "ND never came" in str(done.as_dict())
        assert bus.now_s() - begin_s < 5.0


def test_a_period_belongs_to_the_nearest_code():
    for code in (0x01, 0x02, 0x09, 0x0A, 0x7F, 0x80, 0x83, 0xFF):
        assert sample_period_s(nearest_code(1.001 * sample_period_s(code))) == pytest.approx(
            sample_period_s(code), rel=0.005
        )
