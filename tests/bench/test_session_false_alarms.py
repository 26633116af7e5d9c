"""No guard speaks on a sane part: over seeds, plans, and each effect of the catalogue at usual size."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from adis_gonio.base.uncertainty import POSITION_QUESTIONED
from adis_gonio.bench.events import DwellDone, GuardKind, Problem
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.model.effects import catalogue
from adis_gonio.record.plans import Expectation, PriorKnowledge, plan
from bench.hand_bench import QUICK


def alarms(url, path, name, positions=None):
    with open_sensor(url) as sensor:
        runner = SessionRunner.begin(
            sensor, path, plan(name, positions), QUICK, auto=True, fixture_sigma_deg=0.02
        )
        events = list(runner.run(so_far=False))
    found = [event for event in events if isinstance(event, Problem) and event.kind in get_args(GuardKind)]
    return found, sum(isinstance(event, DwellDone) for event in events)


@pytest.mark.parametrize("seed", range(6))
def test_no_alarm_on_a_sane_part(tmp_path, seed):
    for number, (name, positions) in enumerate([("tumble", 6), ("poses", 9)]):
        found, dwells = alarms(f"sim:?seed={seed}", tmp_path / f"{number}.session", name, positions)
        assert dwells >= 9
        assert not found


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_no_alarm_on_an_effect_of_the_catalogue_at_its_usual_size(tmp_path, name):
    found, _ = alarms(f"sim:?seed=5&effects={name}", tmp_path / "a.session", "four-position")
    assert not found


def test_the_rate_of_false_alarms_of_the_limits_is_what_they_say():
    """Direct simulation of the nonlinear readings: 1200 parts, nine positions and a tumble of twelve.

    Gains, misalignment and biases are drawn by the spread that the part's sheet states, angles by the
    fixture. At 1e-4 a position 2.5 of 25 200 alarm, and more than 10 once in 10 000 times.
    """
    rng = np.random.default_rng(7)
    spread = PriorKnowledge(bias_mg=10.0, reading_mg=0.7, fixture_deg=0.1)
    count = wrong = 0
    for angles in ([40.0 * k for k in range(9)], [*range(0, 360, 60), *range(300, -1, -60)]):
        for _ in range(1200):
            expected = Expectation(spread)
            gain = 1 + rng.uniform(-0.02, 0.02, 2)
            skew = np.radians(rng.uniform(-0.75, 0.75))
            bias, start = rng.normal(0, 10.0, 2), rng.uniform(-np.pi, np.pi)
            for angle in angles:
                psi = start - np.radians(angle + rng.normal(0, 0.1))
                ideal = 1000.0 * np.array([np.cos(psi), np.sin(psi + skew)])
                reading = gain * ideal + bias + rng.uniform(-5, 5, 2)
                count += 1
                wrong += not expected.off(reading, angle).allowed
                expected.add(reading, angle)
    assert count == 25200
    assert wrong <= 10
    assert POSITION_QUESTIONED * count < 10


def test_the_first_limit_is_what_the_sheet_s_spread_explains_and_the_last_what_the_fixture_does():
    """An independent Monte Carlo of the second position: the limit is near the spread's own quantile."""
    rng = np.random.default_rng(3)
    spread, n = PriorKnowledge(bias_mg=10.0, reading_mg=0.7, fixture_deg=0.02), 200_000
    gain, skew = 1 + rng.uniform(-0.02, 0.02, (n, 2)), np.radians(rng.uniform(-0.75, 0.75, n))
    bias = rng.normal(0, 10.0, (n, 2))

    def phi(psi):
        reading = np.stack([np.cos(psi), np.sin(psi + skew)], axis=1) * 1000.0 * gain
        reading += bias + rng.uniform(-5, 5, (n, 2))
        return np.arctan2(reading[:, 1], reading[:, 0])

    turned = phi(np.zeros(n)) - phi(np.radians(rng.normal(-90.0, 0.02, n)))
    quantile = np.quantile(np.abs(np.degrees(turned) - 90.0), 1 - 1e-4)
    expected = Expectation(spread)
    expected.add(np.array([1000.0, 0.0]), 0.0)
    limit = expected.off(np.array([0.0, -1000.0]), 90.0).limit_deg
    assert 0.9 < limit / quantile < 1.3
