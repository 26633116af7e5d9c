"""The gyros' calibration gives the simulator's true rates, its uncertainty is that of repeated draws."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from importlib import resources

import jsonschema
import numpy as np
import pytest

from adis_gonio import Calibration
from adis_gonio.base.errors import DataError, FitError, SessionError, UsageError
from adis_gonio.calibrate import GyroCalibration
from adis_gonio.calibrate.gyro_calibration import KIND_OF
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World
from adis_gonio.tracing.trace_calibrations import load_calibration
from handover.calibrations import PLANE, SPACE, calibration
from handover.gyros import EVERY, FULL, ZERO, Estimated, estimates, gyros, with_gyros

LSB = 0.018315
SCHEMA = json.loads(
    resources.files("adis_gonio.calibrate").joinpath("schema/calibration-1.json").read_text("utf-8")
)
QUIET = {
    "noise_mg": 0.0, "bias_instability_mg": 0.0, "gyro_noise_dps": 0.0, "gyro_instability_dps": 0.0,
    "gyro_supply_dps_per_v": 0.0, "vibration_mg": 0.0, "fixture_sigma_deg": 0.0, "temperature_noise_c": 0.0,
}  # fmt: skip


def faulty_world() -> World:
    """A world without noise whose gyros have the faults of `FULL`, as far as its settings have them."""
    own = {"gyro_g_dps_per_g": 0.05}
    for name, value in FULL.items():
        kind, _, axes = name.rpartition("_")
        if kind == "g_sensitivity":
            if axes[0] != axes[1]:
                own[f"gyro_g_sensitivity_{axes}_dps_per_g"] = value
        else:
            own[{"gyro_bias": f"{name}_dps", "gyro_misalignment": f"{name}_deg"}.get(kind, name)] = value
    # The accelerometers are perfect, so that what the world's gyros feel is what these read.
    perfect = dict.fromkeys(("bias_x_mg", "bias_y_mg", "bias_z_mg", "delta_k", "delta_phi_deg"), 0.0)
    perfect |= {f"bias_tempco_{a}_mg_per_c": 0.0 for a in "xyz"}
    perfect |= {f"scale_tempco_{a}_ppm_per_c": 0.0 for a in "xyz"} | {"scale_y": 1.0, "scale_z": 1.0}
    return World(WorldSettings(**QUIET, **perfect, **own), seed=5)


def test_the_faults_of_a_simulated_part_correct_its_readings_to_the_rate_of_its_stage():
    world = faulty_world()
    made = GyroCalibration.of(estimates(FULL | {f"g_sensitivity_{a}{a}": 0.05 for a in "xyz"}))
    time_s = np.arange(0.0, 6.0, 1 / 819.2)
    for to in (40.0, 200.0, -90.0):
        world.stage.move_to(float(time_s[0]), to, 1)
        seen = world.sample(time_s)
        true = world.stage.at(time_s).rate_dps
        assert np.abs(true).max() > 20, "the stage is to turn"
        corrected = made.correct(seen.gyro_dps, seen.accel_mg / 1000)
        assert np.abs(seen.gyro_dps - true).max() > 1.0
        assert (
            np.abs(corrected - true).max() < 1e-3
        )  # the ringing after a move is no reading of the diagonal
        time_s = time_s + 6.0


def test_correct_undoes_the_model_written_out_in_scalars():
    made, rng = gyros(EVERY), np.random.default_rng(4)
    for _ in range(20):
        omega, f = rng.uniform(-300, 300, 3), rng.uniform(-1.2, 1.2, 3)
        warm, volts = rng.uniform(-15, 40), rng.uniform(4.8, 5.2)
        read = []
        for i, a in enumerate("xyz"):
            lean = [np.sin(np.radians(EVERY.get(f"gyro_misalignment_{a}{b}", 0.0))) for b in "xyz"]
            own = np.sqrt(1 - sum(one * one for one in lean))
            turn = sum((own if j == i else lean[j]) * omega[j] for j in range(3)) * EVERY[f"gyro_scale_{a}"]
            value = turn * (1 + 1e-6 * EVERY.get(f"gyro_scale_temperature_{a}", 0.0) * (warm - 25))
            value += EVERY[f"gyro_bias_{a}"] + EVERY.get(f"gyro_bias_temperature_{a}", 0.0) * (warm - 25)
            value += EVERY.get(f"gyro_bias_temperature2_{a}", 0.0) * (warm - 25) ** 2
            value += EVERY.get(f"gyro_bias_temperature3_{a}", 0.0) * (warm - 25) ** 3
            value += sum(EVERY.get(f"g_sensitivity_{a}{b}", 0.0) * f[j] for j, b in enumerate("xyz"))
            value += sum(EVERY.get(f"g2_sensitivity_{a}{b}", 0.0) * f[j] ** 2 for j, b in enumerate("xyz"))
            read.append(value + EVERY.get(f"gyro_supply_{a}", 0.0) * (volts - 5))
        assert made.correct(read, f, warm, supply_v=volts) == pytest.approx(omega, abs=1e-9)
        assert made.readings_of(omega, f, warm, supply_v=volts).rate_dps == pytest.approx(read, abs=1e-9)


def test_each_gyro_takes_its_own_thermometer():
    made = gyros(EVERY)
    rate, force = np.full((4, 3), 20.0), np.tile([0.0, 0.0, -1.0], (4, 1))
    own = np.array([[20.0, 25.0, 40.0]] * 4)
    together = made.correct(rate, force, own)
    for k in range(3):
        # Off the diagonal of K D the others' temperatures count by sines of small angles alone.
        alone = made.correct(rate, force, float(own[0, k]))
        assert np.abs(together[:, k] - alone[:, k]).max() < 5e-3
    assert np.abs(together - made.correct(rate, force, 25.0)).max() > 0.05


def test_u_is_that_of_calibrations_drawn_from_the_covariance():
    rng = np.random.default_rng(8)
    base = gyros(FULL)
    p = len(base.parameters)
    u = np.array([one.u for one in base.parameters])
    mix = rng.normal(size=(p, p))
    correlation = mix @ mix.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    covariance = correlation * np.outer(u, u)
    made = replace(base, covariance=covariance)
    rate, force = (
        np.array([[120.0, -40.0, 5.0], [0.0, 0.0, 0.0]]),
        np.array([[0.3, 0.9, -0.2], [1.0, 0, 0]]),
    )
    drawn = rng.multivariate_normal(made.values, covariance, size=4000)
    shown = np.stack(
        [
            replace(
                made,
                parameters=tuple(
                    replace(one, value=float(v)) for one, v in zip(made.parameters, row, strict=True)
                ),
            ).correct(rate, force)
            for row in drawn
        ]
    )
    stated = made.rates(rate, force)
    assert stated.rate_dps == pytest.approx(made.correct(rate, force))
    assert stated.u_dps == pytest.approx(shown.std(axis=0), rel=0.06)  # 4000 draws know a σ to 1.1 %
    assert np.isnan(replace(made, covariance=None).rates(rate, force).u_dps).all()


@pytest.mark.parametrize("convert", [GyroCalibration.rates, GyroCalibration.readings_of])
def test_u_at_another_temperature_has_the_effects_that_were_not_traced(convert):
    """The typical sizes of the catalogue: 0.02 °/s/°C and 100 ppm/°C, from the session's mean of 28 °C."""
    made, rate, force = gyros(FULL), np.array([[200.0, -50.0, 0.0]]), np.zeros((1, 3))
    own = convert(made, rate, force).u_dps
    dies_c = np.array([[48.0, 28.0, 13.0]])
    left = 0.02 * (dies_c - 28.0), 100e-6 * (dies_c - 28.0) * rate
    warm = convert(made, rate, force, dies_c)
    assert warm.u_dps == pytest.approx(np.sqrt(own**2 + left[0] ** 2 + left[1] ** 2), rel=1e-9)
    assert convert(made, rate[0], force[0], 48.0).u_dps[2] == pytest.approx(np.hypot(own[0, 2], 0.4))
    assert convert(made, rate, force, 28.0).u_dps == pytest.approx(own)
    unknown = replace(made, temperature_c=None)
    assert convert(unknown, rate, force, 48.0).u_dps == pytest.approx(own)


def test_u_at_another_temperature_has_no_part_for_effects_that_are_corrected():
    traced = gyros({name: value for name, value in EVERY.items() if "temperature" in name} | ZERO)
    warm = traced.rates(np.zeros(3), None, 48.0).u_dps
    # u of the zero rate, and of its coefficients at 23 °C above 25 °C.
    assert warm[2] == pytest.approx(np.hypot(2e-3, 23 * 1e-4), rel=0.01)


def test_the_covariance_of_a_result_is_taken_by_name_whatever_its_order():
    values = estimates(ZERO | {"g_sensitivity_xx": 0.05})
    names = ["alpha", "g_sensitivity_xx", "gyro_bias_z", "gyro_bias_x", "gyro_bias_y"]
    matrix = np.diag([9.0, 4e-6, 1e-6, 2e-6, 3e-6])
    matrix[1, 3] = matrix[3, 1] = 1e-6
    made = GyroCalibration.of(values, (names, matrix))
    order = [one.name for one in made.parameters]
    assert order == ["gyro_bias_x", "gyro_bias_y", "gyro_bias_z", "g_sensitivity_xx"]
    assert made.covariance.tolist() == [
        [2e-6, 0, 0, 1e-6], [0, 3e-6, 0, 0], [0, 0, 1e-6, 0], [1e-6, 0, 0, 4e-6],
    ]  # fmt: skip


def test_what_was_not_determined_is_nominal_and_said():
    unknown = estimates(FULL) | {"gyro_scale_x": Estimated(1.3, float("inf"), "1")}
    made = GyroCalibration.of(unknown)
    assert "gyro_scale_x" in made.assumed
    assert "gyro_scale_x" not in made
    assert made.sensitivity[0, 0] == pytest.approx(1.0, abs=1e-4)
    bare = GyroCalibration.of(estimates(ZERO))
    assert len(bare.assumed) == 3 + 6 + 9
    assert bare.correct([1.21, -0.73, 0.38]).tolist() == pytest.approx([0, 0, 0])
    missing = {name: one for name, one in estimates(FULL).items() if name != "gyro_bias_y"}
    with pytest.raises(FitError, match="gyro_bias_y"):
        GyroCalibration.of(missing)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"gyro_bias_x": Estimated(1.0, 0.1, "mg")}, "gyro_bias_x in mg"),
        ({"gyro_scale_z": Estimated(0.0, 0.1, "1")}, "impossible for three gyros"),
        ({"gyro_misalignment_xy": Estimated(80.0, 0.1, "deg")}, "impossible for three gyros"),
    ],
)
def test_parameters_of_no_three_gyros_are_refused(changed, match):
    with pytest.raises(FitError, match=match):
        GyroCalibration.of(estimates(FULL) | changed)


def test_names_of_other_parameters_are_left_alone():
    assert not {"gyro_latency", "gyro_misalignment_xx", "gyro_bias_xy"} & set(KIND_OF)
    assert KIND_OF["gyro_bias_temperature_x"] == "gyro_bias_temperature"
    made = GyroCalibration.of(estimates(ZERO) | {"lever_x": Estimated(5.0, 0.1, "mm")})
    assert "lever_x" not in made


def test_offsets_of_the_chip_move_the_zero_rate_alone():
    made = gyros(FULL)
    after = made.with_offsets((12 + 40, -5, -30))
    assert after.bias_dps - made.bias_dps == pytest.approx([40 * LSB, 0.0, -30 * LSB])
    assert after.offsets_lsb == (52, -5, -30)
    with pytest.raises(UsageError, match="does not state"):
        replace(made, offsets_lsb=None).with_offsets((1, 2, 3))


@pytest.mark.parametrize("values", [FULL, EVERY, ZERO | {"g2_sensitivity_yx": 0.5}])
def test_a_force_has_the_same_effect_and_u_after_the_accelerometers_have_moved(values):
    # 1000 LSB of XACCL_OFF later the accelerometers read 467.2 mg more of the same force.
    made = gyros(values)
    held = replace(calibration(SPACE).provenance, offsets_lsb=(0, 0, 0))
    whole = replace(calibration(SPACE), provenance=held, gyro=made)
    moved = whole.with_offsets((1000, 0, -500)).gyro
    force, moved_g, still = np.array([0.2, -0.4, 0.9]), np.array([0.4672, 0, -0.2336]), np.zeros(3)
    before = made.readings_of(still, force)
    after = moved.readings_of(still, force + moved_g)
    assert after.rate_dps == pytest.approx(before.rate_dps, abs=1e-12)
    assert after.u_dps == pytest.approx(before.u_dps, rel=1e-9)
    assert [one.u for one in moved.parameters] == pytest.approx(np.sqrt(np.diag(moved.covariance)))
    assert replace(made, covariance=None).with_force_moved([1, 0, 0]).covariance is None


def test_numbers_that_were_written_after_the_session_move_the_zero_rates_and_the_force():
    made = gyros(FULL)
    where = replace(
        calibration(SPACE).provenance, offsets_lsb=(10, 0, 0), gyro_offsets_lsb=made.offsets_lsb
    )
    written = replace(where, written_lsb=(1010, 0, -500), gyro_written_lsb=(52, -5, -30))
    # 1000 LSB of XACCL_OFF are 467.2 mg.
    expected = made.with_offsets((52, -5, -30)).with_force_moved([0.4672, 0, -0.2336])
    found = made.as_written(written)
    assert found.values == pytest.approx(expected.values, abs=1e-12)
    assert found.offsets_lsb == (52, -5, -30)
    unknown = replace(written, offsets_lsb=None), replace(written, sensor="generic")
    for one in (*unknown, replace(written, written_lsb=None)):
        assert made.as_written(one) == made.with_offsets((52, -5, -30))
    assert made.as_written(where) == made.as_written(None) == made
    with pytest.raises(SessionError, match="interrupted"):
        made.as_written(replace(written, gyro_write_open=True))


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda g: g.correct([[1.0, 2.0]], [0, 0, 1]), "rate_dps has shape"),
        (lambda g: g.correct([1.0, 2.0, np.nan], [0, 0, 1]), "NaN"),
        (lambda g: g.correct([1.0, 2.0, 3.0]), "give force_g"),
        (lambda g: g.correct(np.zeros((4, 3)), np.zeros((3, 3))), "3 rows for 4"),
        (lambda g: g.correct([1.0, 2.0, 3.0], [0, 0, 1], [[1.0, 2.0]]), "temperature_c has shape"),
        (lambda g: g.correct("fast", [0, 0, 1]), "has to be numbers"),
    ],
)
def test_arguments_that_cannot_be_are_refused(call, match):
    with pytest.raises(UsageError, match=match):
        call(gyros(EVERY))


# -- files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [ZERO, FULL, EVERY])
def test_the_file_obeys_the_schema_and_comes_back_bit_for_bit(values, tmp_path):
    whole = with_gyros(calibration(PLANE), values)
    jsonschema.Draft202012Validator(SCHEMA).validate(whole.as_dict())
    path = tmp_path / "own.json"
    whole.save(path)
    back = load_calibration(path)
    assert back == whole
    assert np.array_equal(back.gyro.covariance, whole.gyro.covariance)
    assert np.array_equal(back.gyro.values, whole.gyro.values)
    assert GyroCalibration.load(path) == whole.gyro
    alone = tmp_path / "gyros.json"
    whole.gyro.save(alone)
    assert GyroCalibration.load(alone) == whole.gyro


def test_without_gyros_the_document_is_what_it_was(tmp_path):
    bare = calibration(PLANE)
    assert "gyro" not in bare.as_dict()
    assert bare.gyro is None
    path = tmp_path / "bare.json"
    bare.save(path)
    assert load_calibration(path).gyro is None
    with pytest.raises(FitError, match="without gyros"):
        GyroCalibration.load(path)


def test_a_calibration_with_gyros_is_another_than_one_without():
    assert with_gyros(calibration(PLANE), ZERO) != calibration(PLANE)


def damages():
    def put(*keys, value):
        def change(document):
            inner = document["gyro"]
            for key in keys[:-1]:
                inner = inner[key]
            if value is None and keys[-1] != "offsets_lsb":
                del inner[keys[-1]]
            else:
                inner[keys[-1]] = value

        return change

    nan, odd = float("nan"), [[1.0, 2.0], [2.0, 1.0]]
    yield put("schema", value="other"), "is no gyro calibration"
    yield put("version", value=2), "of version 2, this program reads 1"
    yield put("unit", value="radps"), "unit is 'radps'"
    yield put("parameters", "gyro_bias_x", value=None), "differ in names: gyro_bias_x"
    yield put("parameters", "gyro_bias_x", "value", value=nan), "gyro_bias_x.value is nan"
    yield put("parameters", "gyro_bias_x", "value", value=True), "gyro_bias_x.value is True"
    yield put("parameters", "gyro_bias_x", "unit", value="mg"), "gyro_bias_x in mg"
    yield put("parameters", "gyro_wobble_x", value={"value": 1.0, "u": None, "unit": "1"}), "gyro_wobble_x"
    yield put("parameters", "gyro_scale_x", "value", value=0.0), "impossible for three gyros"
    yield put("covariance", "names", value=["a"]), "differ in names"
    yield put("covariance", "matrix", value=odd), "is no matrix of 21 × 21"
    yield put("covariance", "matrix", 0, 1, value=0.5), "not symmetric"
    yield put("offsets_lsb", value=[1, 2]), "a list of 3 values"
    yield put("offsets_lsb", value=[1, 2, 5000]), "from -4096 to 4095"
    yield put("reference", "temperature_c", value=20.0), "reference is not 25"
    yield put("assumed", value=None), "lacks 'assumed'"


def lacks_a_zero_rate(document):
    inner = document["gyro"]
    del inner["parameters"]["gyro_bias_x"]
    inner["covariance"] = None


@pytest.mark.parametrize(
    ("change", "match"),
    [*damages(), (lacks_a_zero_rate, "damaged gyro calibration: gyro_bias_x not determined")],
)
def test_a_damaged_file_is_refused_in_one_line_that_names_it(change, match, tmp_path):
    document = copy.deepcopy(with_gyros(calibration(PLANE), FULL).as_dict())
    change(document)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(DataError, match=match) as caught:
        Calibration.load(path)
    assert "bad.json" in str(caught.value)
    assert "\n" not in str(caught.value)
