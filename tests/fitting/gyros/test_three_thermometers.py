"""Each gyro has the temperature of its own die, from archive to effect; accelerometers as before."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.bench.gyro_turns import ALL_THERMOMETERS
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.gyros.gyro_readings import rate_intervals, readings_of_intervals
from adis_gonio.model.effects import effect
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings

PER_C = {"x": 0.05, "y": -0.04, "z": 0.03}
URL = (
    "sim:?seed=4&hand_moves=1&ambient_swing_c=8&ambient_period_s=13&die_lag_y_s=2&die_lag_z_s=5&gyro_noise_dps=0.1"
    "&gyro_instability_dps=0.001"
) + "".join(f"&gyro_bias_tempco_{axis}_dps_per_c={value}" for axis, value in PER_C.items())


def record(path, **settings):
    with open_sensor(URL) as sensor:
        wanted = Settings(dwell_s=1, settle_s=0.1, **settings)
        list(SessionRunner.begin(sensor, path, plan("mmpm"), wanted, auto=True).run(so_far=False))
    return load_session(path)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return record(tmp_path_factory.mktemp("dies") / "dies.session", registers=ALL_THERMOMETERS, turns=True)


def test_dwells_and_turns_have_the_three_as_the_archive_holds_them(session):
    with ArchiveView(session.source) as view:
        attempt = view.dwells()[2]
        words = np.concatenate([block.words for block in view.blocks(attempt, "dwell")])
        columns = [attempt.registers.index(f"{axis}TEMP_OUT") for axis in "XYZ"]
    numbers = (words[:, columns] & 0x0FFF).astype(int)
    celsius = 25 + 0.1453 * np.where(numbers > 0x7FF, numbers - 0x1000, numbers)
    dwell, turn = session.dwells[2], session.turns[2]
    np.testing.assert_allclose(dwell.temperatures_c, celsius, atol=1e-9)
    np.testing.assert_allclose(dwell.temperatures_c.mean(axis=1), dwell.temperature_c, atol=1e-9)
    assert turn.temperatures_c.shape == (len(turn), 3)


def test_intervals_and_conditions_have_one_temperature_a_gyro(session):
    found = rate_intervals(session)
    assert found.column("temperatures_c").shape == (len(found.rows), 3)
    rests = [dwell.temperatures_c.mean(axis=0) for dwell in session.dwells]
    np.testing.assert_allclose(found.column("temperatures_c")[~found.column("turn")], rests)
    data = readings_of_intervals(found)
    np.testing.assert_array_equal(data.conditions.temperatures_c, found.column("temperatures_c"))
    assert (
        np.abs(np.ptp(found.column("temperatures_c"), axis=0) - np.ptp(found.column("temperature_c"))).max()
        > 0.5
    )


def tempco(data):
    """Coefficients (3,) of `gyro_bias_temperature` and their u, beside zero rates and g-sensitivity."""
    terms = [effect(name, ("x", "y", "z")) for name in ("gyro_bias_temperature", "g_sensitivity")]
    named = tuple(NamedTerm(term.name, (), 0.0, term) for term in terms)
    begun = Fit.begin(data, with_prior=False).with_terms(
        named, [np.zeros(len(t.parameters)) for t in terms]
    )
    names = [*data.model.names, *(p.name for term in terms for p in term.parameters)]
    seen = [not name.startswith("g_") or name[-1] != "z" for name in names]
    found = begun.refit(within=np.eye(len(names))[:, seen])
    rows = found.jacobian[:, seen]
    u = np.sqrt(np.diagonal(np.linalg.inv(rows.T @ rows)))
    return found.values.parameters[3:6], u[3:6]


def test_the_effect_follows_the_gyros_own_thermometer(session):
    found = rate_intervals(session)
    rest = readings_of_intervals(found)
    rest = rest.rows(~found.column("turn"))
    true = list(PER_C.values())
    own, u = tempco(rest)
    assert np.abs((own - true) / u).max() < 4
    shared = replace(rest, conditions=replace(rest.conditions, temperatures_c=None))
    assert np.abs((tempco(shared)[0] - true) / u).max() > 5
    for k in range(3):
        force = found.column("force_g")[~found.column("turn")][:, :2]
        design = np.column_stack([np.ones(len(rest)), force, rest.conditions.temperatures_c[:, k]])
        plain = np.linalg.lstsq(design, rest.mean[:, k], rcond=None)[0]
        assert own[k] == pytest.approx(plain[3], abs=u[k])


def test_the_accelerometers_do_not_see_which_thermometer_was_whose(session):
    without = replace(
        session,
        dwells=tuple(replace(dwell, temperatures_c=None) for dwell in session.dwells),
    )
    one, other = (json.dumps(fit(given).as_dict()) for given in (session, without))
    assert one == other


def test_a_session_with_one_thermometer_has_one_temperature(tmp_path):
    session = record(tmp_path / "one.session")
    assert all(dwell.temperatures_c is None for dwell in session.dwells)
    assert readings_of_intervals(rate_intervals(session)).conditions.temperatures_c is None
    assert "YTEMP_OUT" not in session.facts["settings"]["registers"]


def test_samples_are_exported_with_the_columns_of_the_format(session):
    assert not set(session.dwells[0].columns()) - {
        *("time_s", "position", "angle_deg", "approach", "use", "ax", "ay", "az", "gx", "gy", "gz"),
        *("temp_c", "supply_v", "turned_deg"),
    }
