"""Sessions of the simulated sensor, 1/f noise included, through the archive file.

They are recorded as `simulate` records them; `trace --json` is this result (tests/faces/cli). Rates over
many seeds are in scripts/trace_simulated.py.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.faces.cli import main
from tracing.recorded import record

SLOWER = {"smpl_prd": 31}
TWO_EFFECTS = ("quadratic:k2_x=3", "backlash:backlash=0.15")


def traced(folder: Path, seed: int, *effects: str, **settings: float) -> dict:
    """What `trace` says of a session that was recorded, as JSON."""
    path = record(folder / "blind.session", seed, *effects, **settings)
    return json.loads(json.dumps(trace(load_session(path)).as_dict()))


def found(result: dict) -> set[str]:
    return {entry["effect"] for entry in result["found"]}


@pytest.mark.parametrize("seed", [1025, 1036])
def test_slow_noise_is_no_effect(tmp_path, seed: int) -> None:
    # With the 1/f noise of each dwell taken as its own these gave a hysteresis and a drift.
    result = traced(tmp_path, seed, **SLOWER)
    assert found(result) == {"bias"}
    assert result["unnamed"] is None
    assert result["adequate"]


def test_a_drift_beside_slow_noise_is_found(tmp_path) -> None:
    result = traced(tmp_path, 2004, "bias_drift:drift_y=1.5", smpl_prd=7)
    assert found(result) == {"bias", "bias_drift"}
    assert result["unnamed"] is None
    drift = next(e for e in result["found"] if e["effect"] == "bias_drift")["parameters"]["drift_y"]
    assert abs(drift["value"] - 1.5) < 4 * drift["u"]
    # With slow noise of 0.1 mg a smaller uncertainty could only be that of white noise.
    assert 0.05 < drift["u"] < 0.3


def test_what_is_recorded_here_is_what_the_command_line_records(tmp_path) -> None:
    path = tmp_path / "told.session"
    words = [word for effect in TWO_EFFECTS for word in ("--effect", effect)]
    options = ["--plan", "tumble", "--positions", "6", "--dwell", "0.5", "--seed", "2002"]
    further = ["--set", "fixture_sigma_deg=0.01", "--filter", "1"]
    assert main(["simulate", "-o", str(path), *options, *further, *words]) == 0
    other = tmp_path / "recorded.session"
    short = {"positions": 6, "dwell_s": 0.5, "filter_m": 1}
    record(other, 2002, *TWO_EFFECTS, **short, fixture_sigma_deg=0.01)
    told, same = load_session(path), load_session(other)
    for one, alike in zip(told.dwells, same.dwells, strict=True):
        np.testing.assert_array_equal(one.accel, alike.accel)
        np.testing.assert_array_equal(one.time_s, alike.time_s)
        np.testing.assert_array_equal(one.temperature_c, alike.temperature_c)
        assert (one.angle_deg, one.approach) == (alike.angle_deg, alike.approach)
    assert told.fixture_sigma_deg == same.fixture_sigma_deg == 0.01


def test_two_effects_are_found_by_name(tmp_path) -> None:
    result = traced(tmp_path, 2002, *TWO_EFFECTS, **SLOWER)
    assert found(result) == {"bias", "quadratic", "backlash"}
    assert result["unnamed"] is None
    values = {name: entry for e in result["found"] for name, entry in e["parameters"].items()}
    assert abs(values["k2_x"]["value"] - 3) < 4 * values["k2_x"]["u"]
    assert abs(values["backlash"]["value"] - 0.15) < 4 * values["backlash"]["u"]


@pytest.mark.parametrize(
    ("seed", "dwell_s", "effects"),
    [
        (7, 10.0, {"quadratic": "k2_x=6", "bias_drift": "drift_x=1.5"}),
        (9017, 3.0, {"hysteresis": "hysteresis_x=1.5", "asymmetry": "asymmetry_y=3"}),
    ],
)
def test_no_nameless_surface_takes_the_place_of_three_names(
    tmp_path, seed: int, dwell_s: float, effects: dict[str, str]
) -> None:
    # Beside a bias of tens of mg one function of time and angle explains more than any two of three names.
    texts = (f"{name}:{value}" for name, value in effects.items())
    result = traced(tmp_path, seed, *texts, dwell_s=dwell_s, **SLOWER)
    assert result["unnamed"] is None
    assert "bias" in found(result)
    rest = set(effects) - found(result)
    named = {name for group in result["confounded"] for name in group}
    assert rest <= named
    instead = {name for group in result["confounded"] if group and set(group) & rest for name in group}
    assert found(result) <= {"bias", *effects, *instead}


def test_creep_after_each_turn_is_found_by_name(tmp_path) -> None:
    result = traced(tmp_path, 3101, "creep:creep_x=5,creep_y=-3,tau=20", **SLOWER)
    assert found(result) == {"bias", "creep"}
    assert result["unnamed"] is None
    values = next(e for e in result["found"] if e["effect"] == "creep")["parameters"]
    for name, truth in {"creep_x": 5, "creep_y": -3, "tau": 20}.items():
        assert abs(values[name]["value"] - truth) < 4 * values[name]["u"]


def test_cycles_that_fold_at_twelve_angles_are_found_as_the_fewest_and_the_others_named(
    tmp_path,
) -> None:
    effect = "stage_periodic:cycles=17,per_sin=0.1,per_cos=0.05"
    result = traced(tmp_path, 3101, effect, fixture_sigma_deg=0.01, **SLOWER)
    assert found(result) == {"bias", "stage_periodic"}
    values = next(e for e in result["found"] if e["effect"] == "stage_periodic")["parameters"]
    assert values["cycles"]["value"] == 5
    # sin 17θ is sin 5θ at whole multiples of 30°, and −sin 7θ.
    assert abs(values["per_sin"]["value"] - 0.1) < 4 * values["per_sin"]["u"]
    assert any("5 cycles a turn of the stage look like 7, 17, 19" in note for note in result["notes"])
    assert any("tell 5 cycles a turn from 7, 17, 19" in line for line in result["next"])


def test_of_cycles_that_are_their_own_mirror_the_phase_that_nothing_shows_has_no_uncertainty(
    tmp_path,
) -> None:
    effect = "stage_periodic:cycles=6,per_sin=0.1,per_cos=0.08"
    result = traced(tmp_path, 3102, effect, fixture_sigma_deg=0.01, **SLOWER)
    values = next(e for e in result["found"] if e["effect"] == "stage_periodic")["parameters"]
    assert values["per_sin"]["u"] is None
    assert abs(values["per_cos"]["value"] - 0.08) < 4 * values["per_cos"]["u"]


def test_a_gain_that_follows_a_supply_which_only_sinks_stands_with_a_drift_of_the_gain(
    tmp_path,
) -> None:
    sinking = {"supply_drift_v_per_h": -4, "fixture_sigma_deg": 0.01}
    result = traced(tmp_path, 3102, "supply_scale:supply_scale_y=20000", **sinking, **SLOWER)
    assert found(result) - {"bias"} <= {"supply_scale", "scale_drift"}
    together = next(s["names"] for s in result["sets"] if "supply_scale" in s["names"])
    assert "scale_drift" in together
    assert any({"supply_scale", "scale_drift"} <= set(group) for group in result["confounded"])


def test_a_constant_temperature_does_not_become_an_impossible_coefficient(tmp_path) -> None:
    # The sensor reads 25.05 °C throughout: a bias of 5.6 mg would be 116 mg/°C, five times the bound.
    result = traced(tmp_path, 1002, dwell_s=10.0, **SLOWER)
    assert found(result) == {"bias"}
    assert result["adequate"]
