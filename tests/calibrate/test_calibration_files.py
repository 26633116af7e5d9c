"""A calibration's file: as the schema says, bit-exact, and refused in one line where it is damaged."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from dataclasses import replace
from importlib import resources

import jsonschema
import numpy as np
import pytest

import adis_gonio
from adis_gonio import Calibration
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.calibrate import GyroCalibration
from adis_gonio.faces.cli import main
from adis_gonio.fitting.methods import FREE_TURN, METHODS
from adis_gonio.record.loading import load_session
from adis_gonio.record.samples_writer import write_samples_csv
from calibrate.sessions import planar_session, spatial_session

SCHEMA = json.loads(
    resources.files("adis_gonio.calibrate").joinpath("schema/calibration-1.json").read_text("utf-8")
)


def calibrations():
    rng = np.random.default_rng(8)
    planar = planar_session(rng)
    yield adis_gonio.fit(planar, method="ml").calibration()
    yield adis_gonio.fit(planar, method="paper").calibration()
    yield adis_gonio.fit(planar_session(rng, unit="counts"), method="ml").calibration()
    space = spatial_session(rng, gains=(1, 1, 1), skews_deg=(0.1, 0.2, 0.3), bias=(1, 2, 3))
    yield adis_gonio.fit(space).calibration()
    bare = planar_session(rng, samples=1, angles_deg=(0, 90, 180, 270))
    yield adis_gonio.fit(replace(bare, fixture_sigma_deg=None), method="four-position").calibration()


ALL = list(calibrations())


@pytest.fixture(params=range(len(ALL)), ids=["ml", "paper", "counts", "space", "no noise"])
def calibration(request):
    return ALL[request.param]


def test_the_schema_is_one_and_every_file_obeys_it(calibration):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.Draft202012Validator(SCHEMA).validate(calibration.as_dict())


def test_the_schema_has_every_method_that_makes_a_calibration():
    assert set(SCHEMA["properties"]["method"]["enum"]) == {*METHODS, FREE_TURN, "trace"}


def test_a_file_is_loaded_and_a_session_refused_without_the_trace(tmp_path):
    ALL[0].save(tmp_path / "c.json")
    GyroCalibration.of({f"gyro_bias_{axis}": Value(0.1, 0.01, "dps") for axis in "xyz"}).save(
        tmp_path / "g.json"
    )
    (tmp_path / "s.csv").write_text("time_s,ax_mg,ay_mg\n0,1,2\n", "utf-8")
    script = (
        "import sys\nfrom adis_gonio.calibrate import Calibration, GyroCalibration\n"
        "from adis_gonio.base.errors import DataError\n"
        "print(Calibration.load('c.json').names)\n"
        "print(GyroCalibration.load('g.json').bias_dps)\n"
        "try: Calibration.load('s.csv')\n"
        "except DataError as error: print(error)\n"
        "assert 'adis_gonio.tracing.trace_calibrations' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
        timeout=300,
        check=True,
    )
    names, bias, refusal = done.stdout.splitlines()
    assert names == str(ALL[0].names)
    assert bias == "[0.1 0.1 0.1]"
    assert refusal.startswith("s.csv: ")


def test_save_and_load_is_bit_exact(calibration, tmp_path):
    calibration.save(tmp_path / "c.json")
    back = Calibration.load(tmp_path / "c.json")
    assert back == calibration
    assert back.values.tobytes() == calibration.values.tobytes()
    back.save(tmp_path / "d.json")
    assert (tmp_path / "d.json").read_bytes() == (tmp_path / "c.json").read_bytes()
    accel = np.random.default_rng(1).uniform(-900, 900, (100, calibration.axes))
    for use in (lambda c: c.apply(accel), lambda c: c.angle(accel, plane="xy").angle_deg):
        assert use(back).tobytes() == use(calibration).tobytes()


@pytest.mark.parametrize("derived", [None, {}, {"delta_k": {"value": 0.01, "u": 1e-4, "unit": "1"}}])
def test_a_file_that_does_not_state_the_degrees_of_freedom_of_the_ratio_is_read(tmp_path, derived):
    document = ALL[0].as_dict()
    del document["derived"]
    path = tmp_path / "c.json"
    path.write_text(json.dumps(document if derived is None else document | {"derived": derived}))
    ratio = Calibration.load(path).delta_k
    assert (ratio.value, ratio.u, ratio.dof) == (ALL[0].delta_k.value, ALL[0].delta_k.u, None)


def test_a_session_is_fitted_when_it_is_loaded(tmp_path):
    session = planar_session(np.random.default_rng(8))
    write_samples_csv(session, tmp_path / "s.csv")
    loaded = Calibration.load(tmp_path / "s.csv")
    fitted = adis_gonio.fit(load_session(tmp_path / "s.csv")).calibration()
    assert loaded == fitted
    assert loaded.provenance.source == "s.csv"


def test_the_hash_is_that_of_the_data_whatever_file_they_are_in(tmp_path):
    session = planar_session(np.random.default_rng(8))
    write_samples_csv(session, tmp_path / "s.csv")
    ours = adis_gonio.fit(session).calibration().provenance
    theirs = Calibration.load(tmp_path / "s.csv").provenance
    assert ours.sha256 == theirs.sha256
    other = adis_gonio.fit(planar_session(np.random.default_rng(9))).calibration().provenance
    assert other.sha256 != ours.sha256


def damaged():
    def put(*path, value):
        def change(document):
            at = document
            for key in path[:-1]:
                at = at[key]
            at[path[-1]] = value

        return change

    def without(name):
        def change(document):
            k = list(document["parameters"]).index(name)
            del document["parameters"][name], document["covariance"]["names"][k]
            for row in document["covariance"]["matrix"]:
                del row[k]
            del document["covariance"]["matrix"][k]

        return change

    yield put("schema", value="other"), "is no calibration"
    yield put("version", value=2), "version 2, this program reads 1: update"
    yield lambda d: d.pop("parameters"), "lacks 'parameters'"
    yield lambda d: d["parameters"].pop("scale_x"), "differ in names: scale_x"
    yield put("parameters", "scale_x", "value", value="big"), "parameters.scale_x.value is 'big'"
    yield put("parameters", "scale_x", "value", value=None), "parameters.scale_x.value is None"
    yield put("parameters", "scale_x", "value", value=10**400), "or too large"
    yield put("parameters", "scale_x", "u", value=-1.0), "scale_x.u is -1.0"
    yield put("parameters", "scale_x", "dof", value=0), "scale_x.dof is 0"
    yield put("offsets_lsb", value=[2**40, 0, 0]), "from -2048 to 2047"
    yield put("assumed", value=7), "assumed is 7"
    yield put("covariance", "matrix", 0, 0, value=-1.0), "variance is negative"
    yield put("covariance", "matrix", 0, 1, value=1e-3), "is not symmetric"
    yield put("covariance", "matrix", value=[[1.0]]), "is no matrix"
    yield lambda d: d["covariance"]["names"].reverse(), "differ in names: the order"
    yield without("delta_phi"), "parameter delta_phi is missing"
    yield put("counts_per_mg", value=[1.0, 1.0]), "counts_per_mg is needed with unit counts"
    for gain in (0.0, 0.9e-6, 1.1e6):
        yield put("parameters", "scale_x", "value", value=gain), "no gain of a sensor"
    yield put("plane", value="zz"), "plane is 'zz'"
    yield (
        put("effects", value=[{"effect": "nosuch", "axes": [], "choices": {}, "parameters": []}]),
        "nosuch",
    )
    yield (
        put("effects", value=[{"effect": "cubic", "axes": ["x"], "choices": {}, "parameters": ["k3_x"]}]),
        "effect cubic needs 1",
    )
    yield put("source", "shoe_size", value="44"), "shoe_size"
    yield (
        put("parameters", "delta_phi", "value", value=120.0),
        "delta_phi is 120: no angle between two axes",
    )
    for name, axes, says in (
        ("hysteresis", ["x"], "does not record approach"),
        ("g_sensitivity", ["x"], "does not record force_g"),
        ("quadratic", ["z"], "z was not recorded"),
    ):
        one = {"effect": name, "axes": axes, "choices": {"force": 1} if name[0] == "g" else {}}
        yield put("effects", value=[{**one, "parameters": ["scale_x"]}]), says
    yield (
        put("reference", "session_temperature_c", value={"least": 1.0}),
        "session_temperature_c lacks 'mean'",
    )
    yield put("covariance", value=7), "damaged"
    yield put("parameters", "delta_phi", "unit", value="rad"), "delta_phi is in rad, has to be in deg"
    yield put("parameters", "bias_y", "unit", value="mps2"), "bias_y is in mps2, has to be in mg"
    yield put("parameters", "scale_x", "unit", value="%"), "scale_x is in %, has to be in 1"
    yield put("reference", "temperature_c", value=20.0), "reference is not 25 °C and 5 V"


@pytest.mark.parametrize(("change", "says"), list(damaged()))
def test_a_damaged_file_is_refused_in_one_line(tmp_path, change, says):
    document = copy.deepcopy(ALL[0].as_dict())
    change(document)
    path = tmp_path / "c.json"
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=says) as raised:
        Calibration.load(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["{", "[1, 2]", '{"a": NaN}', "{}", '{"x": "\\ud800"}'])
def test_a_json_that_is_no_calibration_says_so(tmp_path, text):
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"c\.json: is no"):
        Calibration.load(path)


def test_what_is_not_there_is_named(tmp_path):
    with pytest.raises(DataError, match="there is no such file"):
        Calibration.load(tmp_path / "none.json")


def test_saving_never_overwrites_unless_told(tmp_path):
    path = tmp_path / "c.json"
    path.write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        ALL[0].save(path)
    assert path.read_text() == "mine"
    ALL[0].save(path, force=True)
    assert Calibration.load(path) == ALL[0]


@pytest.mark.parametrize("name", ["a.h", "a.xml", "A.HTML"])
def test_what_export_makes_for_others_is_told_from_a_session(name, tmp_path):
    (tmp_path / name).write_text("/* adis_gonio.h */\n")
    with pytest.raises(DataError, match=r"is made for others to read; give a session, or the \.json"):
        Calibration.load(tmp_path / name)


def test_a_table_with_other_names_gets_advice_that_can_be_taken(tmp_path):
    path = tmp_path / "logger.csv"
    path.write_text("clock,Acc_X,Acc_Y\n0,1,2\n1,2,3\n")
    with pytest.raises(DataError, match="has to be in the file"):
        Calibration.load(path)


def test_texts_of_a_calibration_file_are_printed_as_one_line_each(tmp_path, capsys):
    """A file from a stranger must not steer a terminal, nor a file that is made from it."""
    session = tmp_path / "a.session"
    assert (
        main(["simulate", "--plan", "four-position", "--seed", "3", "--dwell", "1", "-o", str(session)])
        == 0
    )
    path = tmp_path / "a.json"
    assert main(["export", str(session), "-o", str(path)]) == 0
    document = json.loads(path.read_text(encoding="utf-8"))
    evil = "A\n\x1b[31mB\x07\x9b"
    document["method"] = evil
    document["source"] = dict.fromkeys(document["source"], evil)
    document["not_corrected"] = [{"effect": evil, "reason": evil}]
    path.write_text(json.dumps(document), encoding="utf-8")
    capsys.readouterr()
    for ending in ("h", "xml", "txt"):
        made = tmp_path / f"out.{ending}"
        assert main(["export", str(path), "-o", str(made)]) == 0
        assert printable(made.read_text(encoding="utf-8"))
    assert main(["angle", "sim:?seed=1", "--cal", str(path), "--seconds", "0.1"]) == 0
    assert main(["fit", str(session), "--sensor-part", "gyro", "--calibration", str(path)]) == 0
    assert main(["export", str(session), "--gyros", str(path), "-o", "-", "--format", "c-header"]) == 0
    told = capsys.readouterr()
    assert printable(told.out)
    assert printable(told.err)


def printable(text):
    return all(line.isprintable() for line in text.splitlines())
