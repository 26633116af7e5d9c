"""The generator makes what it says: deterministic, the catalogue's meaning, the ladder, the noise."""

import json
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.model.effects import Conditions, Enters, effect
from adis_gonio.record.loading import load_session
from blind_residual import recordings
from blind_residual.catalogue import NAMES, terms
from blind_residual.causes import CAUSES, Planted
from blind_residual.circumstances import Circumstances, ideal_plane, lagged
from blind_residual.generator import FAMILIES, Truth, draw
from blind_residual.noise import Noise
from blind_residual.runners.common import read
from recordings import MEASURED


def circumstances(plane: bool = True, n: int = 30, seed: int = 0) -> Circumstances:
    """A session with everything recorded."""
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(10, 40, n))
    direction = rng.normal(size=(n, 3))
    return Circumstances(
        plane,
        time_s - time_s[0],
        rng.uniform(0, 2 * np.pi, n) if plane else np.zeros(n),
        25 + 5 * np.sin(time_s / 150),
        5 + 0.1 * rng.normal(size=n),
        rng.choice([-1.0, 1.0], n),
        rng.uniform(0, 100, (n, 2 if plane else 3)) ** 2,
        np.arange(n) % 5 == 4,
        direction / np.linalg.norm(direction, axis=1)[:, None],
    )


def ideal(c: Circumstances) -> np.ndarray:
    return ideal_plane(0.3 - c.angle_rad, 0.004) if c.plane else c.direction


def planted(name: str, c: Circumstances, seed: int = 1) -> Planted:
    return CAUSES[name].make(c, ideal(c), np.random.default_rng(seed))


def test_a_secret_and_a_number_give_the_same_bytes_and_another_secret_others():
    first, again, other = draw("a", 3), draw("a", 3), draw("b", 3)
    assert first[0] == again[0]
    assert first[1].gain == again[1].gain
    assert first[0] != other[0]


def test_a_truth_survives_its_file(tmp_path: Path):
    truth = draw("a", 4)[1]
    truth.save(tmp_path / "t.json")
    assert Truth.load(tmp_path / "t.json") == truth


@pytest.mark.parametrize("name", [n for n in NAMES if n not in ("position_slip", "outlier_dwell")])
@pytest.mark.parametrize("plane", [True, False])
def test_columns_mean_what_the_package_means_by_the_name(name: str, plane: bool):
    c = circumstances(plane)
    a = ideal(c)
    ways = terms(name, c, a)
    if not ways:
        assert not plane
        return
    conditions = Conditions(
        time_s=c.time_s, angle_rad=c.angle_rad, order=np.arange(c.n), approach=c.approach,
        temperature_c=c.temp_c, supply_v=c.supply_v, temperature_history=(c.time_s, c.temp_c),
        variance_mg2=c.variance_mg2,
    )  # fmt: skip
    rng = np.random.default_rng(5)
    for term in ways:
        made = effect(name, "xyz"[: c.axes] if term.reading.any() else "")
        values = dict(zip(term.parameters, rng.uniform(0.5, 1, len(term.parameters)), strict=True))
        given = np.array([values.get(p.name, 0.0) for p in made.parameters])
        for k, p in enumerate(made.parameters):
            if p.name == "tau":
                given[k] = float(term.label.split("tau=")[1].rstrip(")"))
        ours = np.array([values[p] for p in term.parameters])
        if made.enters is Enters.ATTITUDE:
            assert made.attitude_rad(given, conditions) == pytest.approx(term.angle @ ours, abs=1e-12)
        else:
            expected = made.reading(given, 1000 * a, conditions)
            assert expected == pytest.approx(term.reading @ ours, abs=1e-9), term.label


@pytest.mark.parametrize("name", list(CAUSES))
@pytest.mark.parametrize("plane", [True, False])
def test_every_cause_adds_something_finite_where_it_may_occur(name: str, plane: bool):
    cause, c = CAUSES[name], circumstances(plane)
    if not (cause.plane if plane else cause.space):
        return
    made = planted(name, c)
    assert made.reading.shape == (c.n, c.axes)
    assert made.angle.shape == (c.n,)
    everything = np.concatenate([made.reading.ravel(), made.angle])
    assert np.isfinite(everything).all()
    assert np.any(everything)
    assert made.is_scatter == (cause.family == "scatter")
    assert bool(cause.covariates) or cause.family in ("catalogue", "scatter")


def test_there_are_thirty_strangers_and_more():
    assert sum(cause.family == "stranger" for cause in CAUSES.values()) >= 30
    assert sum(cause.family == "scatter" for cause in CAUSES.values()) >= 8


def test_a_worm_gear_repeats_every_ten_degrees_and_no_sooner():
    c = circumstances()
    c.angle_rad = np.radians(np.arange(c.n) * 10.0 + 3)
    assert np.ptp(planted("worm_gear", c).angle) < 1e-9
    c.angle_rad = np.radians(np.arange(c.n) * 5.0 + 3)
    assert np.ptp(planted("worm_gear", c).angle) > 1e-3


def test_a_gain_that_creeps_adds_nothing_at_zero_reading_and_grows():
    c = circumstances()
    made = CAUSES["gain_log_time"].make(c, np.zeros((c.n, 2)), np.random.default_rng(1))
    assert not made.reading.any()
    made = CAUSES["gain_log_time"].make(c, np.ones((c.n, 2)), np.random.default_rng(1))
    assert np.all(np.diff(np.abs(made.reading[:, np.argmax(np.abs(made.reading[-1]))])) > 0)


def test_hysteresis_of_preisach_depends_on_the_way_there():
    c = circumstances(n=12)
    up_down = np.concatenate([np.linspace(-1, 1, 6), np.linspace(1, -1, 6)])[:, None] * [1.0, 1.0]
    made = CAUSES["preisach"].make(c, up_down, np.random.default_rng(1)).reading
    axis = np.argmax(np.abs(made).sum(axis=0))
    assert abs(made[2, axis] - made[9, axis]) > 0.1  # the same reading, from below and from above


def test_a_memory_of_two_moves_sees_no_third():
    c = circumstances()
    before = planted("two_move_memory", c).reading
    c.angle_rad = c.angle_rad.copy()
    c.angle_rad[10] += 0.7
    changed = np.flatnonzero(np.any(planted("two_move_memory", c).reading != before, axis=1))
    assert changed.tolist() == [10, 11, 12]


def test_soft_clipping_leaves_the_middle_alone():
    c = circumstances()
    a = np.linspace(-1, 1, c.n)[:, None] * [1.0, 1.0]
    made = CAUSES["soft_clip"].make(c, a, np.random.default_rng(1)).reading
    assert not made[np.abs(a) < 0.85].any()
    assert made[[0, -1]].any()


def test_clipped_vibration_lowers_the_mean_as_a_simulation_does():
    c = circumstances(n=3)
    c.variance_mg2 = np.full((3, 2), 150.0**2)
    a = np.array([[1.0, 0.0], [-1.0, 0.5], [0.2, 0.9]])
    made = CAUSES["vibration_clip"].make(c, a, np.random.default_rng(1)).reading
    shaken = a[:, :, None] + 0.150 * np.random.default_rng(2).normal(size=(3, 2, 400_000))
    clipped = np.clip(shaken, -1.2, 1.2).mean(axis=2) - a
    assert made == pytest.approx(1000 * clipped, abs=1.2)


def test_telegraph_noise_has_two_values_and_a_shift_one_step():
    c = circumstances(n=40)
    assert len(np.unique(planted("telegraph", c).reading)) == 2
    column = planted("jump", c).reading
    steps = np.abs(np.diff(column[:, np.argmax(np.abs(column).sum(axis=0))])) > 1e-12
    assert steps.sum() == 1


def test_condensation_stays_until_the_part_is_warmer_than_where_it_came():
    c = circumstances(n=60)
    c.temp_c = 25 + 5 * np.cos(np.linspace(0, 2 * np.pi, 60))
    made = planted("condensation", c).reading
    wet = np.abs(made).sum(axis=1) > 0
    assert c.temp_c[wet].max() > c.temp_c[np.flatnonzero(wet)[0]] + 1


@pytest.mark.parametrize(
    "name",
    ["seat", "fixture", "telegraph", "random_walk", "flicker_excess", "shifts", "loosening", "bumps"],
)
def test_scatter_has_the_covariance_that_the_oracle_is_told(name: str):
    c = circumstances(n=14)
    c.angle_rad = np.zeros(14)
    draws, told = [], []
    for seed in range(1000):
        made = planted(name, c, seed)
        draws.append(made.angle if made.angle_covariance is not None else made.reading[:, 0])
        told.append(made.angle_covariance if made.angle_covariance is not None else made.reading_covariance)
    expected = np.mean(told, axis=0)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.cov(np.array(draws).T) / size == pytest.approx(expected / size, abs=0.25)


def test_a_lag_follows_a_ramp_by_its_time_constant():
    time_s = np.arange(0, 5000, 10.0)
    assert (time_s - lagged(time_s, time_s, 100.0))[-1] == pytest.approx(100.0, rel=1e-6)


def test_readings_scatter_as_their_covariance_says():
    noise, start = Noise(3.0, 4, 0.2, 0.0), np.arange(4) * 20.0
    rng = np.random.default_rng(3)
    means = np.array([noise.samples(start, 40, 400.0, rng).mean(axis=1) for _ in range(1200)])
    expected = noise.reading_covariance(start, 40, 400.0)
    assert np.cov(means.T) == pytest.approx(expected, abs=0.12 * expected.max())


def test_gains_come_out_as_the_ladder_wants_them():
    """√gain scatters by 1 about √target: noise on one direction."""
    made = [draw("ladder", k, "catalogue")[1] for k in range(25)]
    z = np.array([np.sqrt(max(t.gain[0], 0)) - np.sqrt(t.target[0]) for t in made])
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert 0.5 < z.std() < 1.6


@pytest.mark.parametrize("family", list(FAMILIES))
def test_the_package_reads_every_family_and_sees_the_true_readings(family: str, tmp_path: Path):
    csv, truth = draw("read", 1, family)
    path = tmp_path / "session.csv"
    path.write_text(csv, encoding="utf-8")
    assert len(load_session(path).dwells) == len(truth.start_s)
    table = read(path)
    assert table.reading_mg == pytest.approx(np.array(truth.readings_mg), abs=1e-4)
    assert table.c.check.tolist() == truth.circumstances["check"]
    assert (table.c.time_s - table.c.time_s[0]) == pytest.approx(truth.circumstances["time_s"], abs=1e-3)


def test_no_csv_holds_a_word_of_the_truth():
    csv, truth = draw("train", 5)
    head = "\n".join(line for line in csv.splitlines() if line.startswith("#"))
    assert not any(word in head for word in (truth.kind, "truth", "gain", "seed"))


def test_recordings_get_what_the_truth_says_and_nothing_else():
    csv, truth = recordings.plant(MEASURED, "t", 2)  # a continuous recording in m/s²
    assert truth.family == "recording"
    assert truth.kind.startswith("mpu9150_0")
    assert min(truth.gain) > 5
    assert len(truth.start_s) in (22, 23)
    assert csv == recordings.plant(MEASURED, "t", 2)[0]
    json.dumps(truth.parameters)
