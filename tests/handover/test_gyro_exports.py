"""Gyros in exports: the compiled header gives `correct`, offsets take zero rates away; none where none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import date
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import Calibration, load_session, open_sensor
from adis_gonio.base.errors import FitError
from adis_gonio.calibrate import GyroCalibration
from adis_gonio.faces.cli import main
from adis_gonio.fitting import fit
from adis_gonio.handover.c_header import c_header
from adis_gonio.handover.certificate import SI_UNITS, certificate_text
from adis_gonio.handover.fixed_point import (
    FIXED_UDPS,
    FLOAT_DPS,
    PARTS,
    STEP_DPS,
    rate_polynomial_of,
)
from adis_gonio.handover.register_offsets import gyro_offset_words, registers_text
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing import trace_calibrations
from handover.calibrations import CURVED, PLANE, SPACE, calibration, of_counts
from handover.dcc_structure import judge
from handover.gyros import EVERY, FULL, UNITS, ZERO, Estimated, gyros, with_gyros
from handover.machines import HERE, MACHINES
from handover.test_certificate import quantities

LSB = 0.018315
KINDS = {
    "zero rates alone": lambda: with_gyros(calibration(PLANE), ZERO),
    "plane": lambda: with_gyros(calibration(PLANE, CURVED), FULL),
    "space, every effect": lambda: with_gyros(calibration(SPACE), EVERY),
    "sibling": lambda: with_gyros(calibration(PLANE, sensor="adis16350"), EVERY),
    "mg": lambda: with_gyros(calibration(PLANE, sensor="generic"), EVERY),
}
TURNS = round(2 * 300 / STEP_DPS)
SPAN = {"sibling": 256 * 900, "mg": 256 * 2600}
RUNS = [
    (kind, machine.name, 300 if machine.runner else 3000)
    for kind in KINDS
    for machine in MACHINES
    if not machine.runner or kind in ("plane", "space, every effect")
]


def drawn(n, span, *, words):
    """Turns and scans of sweep_rates.c: (n, 3), (n, 3), (n,), (n,)."""
    state, rows = 12345, []

    def following():
        nonlocal state
        state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
        return state >> 8

    def signed(number):
        data = number & 0x3FFF
        return data - 0x4000 if data & 0x2000 else data

    for k in range(n):
        turn = [following() % TURNS - TURNS // 2 for _ in range(3)]
        scan = [following() % span - span // 2 for _ in range(3)]
        temperature, supply = following() % 200_000 - 100_000, following() % 2_000_000
        if words and k % 3 == 0:
            parts = 1024 if k % 2 else 512 if k % 4 else 256
            turn = [parts * signed(one) for one in turn]
        rows.append([*turn, *scan, temperature, supply])
    table = np.array(rows, dtype=np.int64)
    return table[:, :3], table[:, 3:6], table[:, 6], table[:, 7]


def exact_rates(own, turn, scan, warm, volts):
    """Rates by the calibration itself, in double precision, and the rows (n,) within its range."""
    step_mg = {"adis16354": 0.4672, "adis16350": 2.522}.get(own.provenance.sensor, 1.0)
    if own.provenance.sensor == "generic":
        temperature, supply = warm / PARTS, volts / PARTS / 1000
    else:
        temperature, supply = 25 + 0.1453 * warm / PARTS, 1.8315e-3 * volts / PARTS
    force, rate = scan / PARTS * step_mg / 1000, turn / PARTS * LSB
    rows = (np.abs(temperature - 25) < 128) & (np.abs(supply - 5) < 8) & (np.abs(force) < 2).all(axis=1)
    exact = own.gyro.correct(rate, force, temperature, supply_v=supply)[rows]
    return exact, rows


def shown_on(name: str, folder: Path, kind: str, n: int, span: int, *, words: bool) -> np.ndarray:
    """Rates (n, 6) of n turns by the compiled header: fixed point (int32), and the bits of float."""
    machine = next(one for one in MACHINES if one.name == name)
    if reason := machine.missing():
        pytest.skip(reason)
    folder.mkdir(exist_ok=True)
    (folder / "own.h").write_text(c_header(KINDS[kind]()), encoding="ascii")
    options = [
        '-DHEADER="own.h"', "-DPREFIX=adis_gonio", f"-DSCANS={n}", f"-DSPAN={span}UL", f"-DTURNS={TURNS}UL",
        *(["-DWORDS"] if words else []),
        *(["-Os"] if name == "avr" else []),  # by speed two copies of the gyros fill its 32 kB
    ]  # fmt: skip
    printed = machine.run(folder, *options, source=HERE / "sweep_rates.c").splitlines()
    lines = [line.removeprefix("O:").strip() for line in printed]
    lines = [line for line in lines if re.fullmatch("([0-9a-f]{8} ?)+", line)]  # simavr talks between them
    assert int(lines[0], 16) == 0, "the header's own check"
    table = np.array([[int(word, 16) for word in line.split()] for line in lines[1:]], dtype=np.uint32)
    assert table.shape == (n, 6)
    return table


@pytest.fixture(scope="module")
def on_host(tmp_path_factory):
    """What the host prints, once for all machines that are compared with it."""

    @cache
    def shown(kind: str, n: int, span: int, words: bool) -> np.ndarray:
        return shown_on("host", tmp_path_factory.mktemp("host"), kind, n, span, words=words)

    return shown


@pytest.mark.parametrize(("kind", "name", "n"), RUNS)
def test_every_machine_gives_the_rates_of_the_host_bit_by_bit_and_float_within_its_bound(
    tmp_path, on_host, kind, name, n
):
    own = KINDS[kind]()
    words, span = rate_polynomial_of(own, own.gyro).words, SPAN.get(kind, 256 * 5400)
    host = on_host(kind, n, span, words)
    table = host if name == "host" else shown_on(name, tmp_path, kind, n, span, words=words)
    assert np.array_equal(table[:, :3], host[:, :3])
    given = drawn(n, span, words=words)
    every = np.arange(n) % 3 > 0 if words else np.full(n, True)  # words may be beyond the header's range
    exact, rows = exact_rates(own, *(one[every] for one in given))
    assert np.abs(table[every, 3:].copy().view(np.float32)[rows] - exact).max() < FLOAT_DPS


@pytest.mark.parametrize("kind", KINDS)
def test_the_fixed_point_gives_the_calibration_s_rates_within_the_bound_of_the_header(tmp_path, kind):
    span = SPAN.get(kind, 256 * 4000)
    exact, rows = exact_rates(KINDS[kind](), *drawn(4000, span, words=False))
    assert rows.sum() > 1000
    assert np.abs(exact).max() > 250
    table = shown_on("host", tmp_path, kind, 4000, span, words=False)
    assert np.abs(table[rows, :3].astype(np.int32) - 1e6 * exact).max() < FIXED_UDPS


def test_the_self_check_notices_a_changed_zero_rate(tmp_path):
    machine = next(one for one in MACHINES if one.name == "host")
    if reason := machine.missing():
        pytest.skip(reason)
    own = KINDS["plane"]()
    text = c_header(own)
    bias = int(re.findall(r"const int32_t raw_x = .* - (\d+)L, ", text)[-1])
    assert f" - {bias}L, " in text
    (tmp_path / "own.h").write_text(text.replace(f" - {bias}L, ", f" - {bias + 1000}L, "))
    source = tmp_path / "check.c"
    source.write_text(
        '#include "own.h"\nint main(void) { return adis_gonio_self_check() == 201 ? 0 : 1; }\n'
    )
    machine.run(tmp_path, "-Wconversion", "-Wshadow", "-Wundef", "-Wcast-qual", source=source)


def test_without_gyros_no_export_knows_of_them():
    bare = calibration(PLANE, CURVED, sensor="adis16354")
    for text in (
        c_header(bare),
        registers_text(calibration(PLANE)),
        certificate_text(bare, date(2026, 5, 4)),
    ):
        assert not re.search("gyro|rates|dps", text, re.IGNORECASE)


def test_with_gyros_the_functions_of_the_accelerometers_are_the_same():
    bare, whole = calibration(PLANE, CURVED), with_gyros(calibration(PLANE, CURVED), FULL)

    def angles(text):
        begin, end = text.index("/* ---- fixed point ---- */"), text.index("/* ---- self-check ---- */")
        return re.sub(r"/\* ---- gyros.*", "", text[begin:end], flags=re.DOTALL)

    assert angles(c_header(whole)) == angles(c_header(bare))
    assert registers_text(with_gyros(calibration(PLANE), FULL)).startswith(
        registers_text(calibration(PLANE))
    )


def test_every_parameter_stands_in_the_header_with_its_u_and_what_is_missing_is_said():
    text = c_header(with_gyros(calibration(PLANE), ZERO))
    for name, value in ZERO.items():
        row = next(line for line in text.splitlines() if line.startswith(f" * {name} "))
        assert (float(row.split()[2]), row.split()[3], float(row.split()[4])) == (value, "deg/s", 2e-3)
    assert "gyro_scale_x: not determined" in text
    assert "12, -5, 0 in XGYRO_OFF" in text


def test_a_part_in_counts_has_no_force_and_is_refused():
    with pytest.raises(FitError, match="force"):
        c_header(replace(of_counts(), gyro=gyros(FULL)))


# -- registers -------------------------------------------------------------------------------------------


def test_the_offsets_take_the_zero_rates_of_a_simulated_part_away(capsys):
    url = "sim:?seed=4&gyro_g_dps_per_g=0&gyro_supply_dps_per_v=0&gyro_instability_dps=0"
    url += "".join(f"&{name}_dps={value}" for name, value in ZERO.items())
    own = with_gyros(calibration(PLANE), ZERO, offsets_lsb=None)
    lines = dict(re.findall(r"^(\w+)=(-?\d+)$", registers_text(own), re.MULTILINE))
    assert {name: int(lines[name]) for name in ("XGYRO_OFF", "YGYRO_OFF", "ZGYRO_OFF")} == {
        "XGYRO_OFF": -66, "YGYRO_OFF": 40, "ZGYRO_OFF": -21,
    }  # fmt: skip
    with open_sensor(url) as sensor:
        before = sensor.read_scans(4000).gyro_dps.mean(axis=0)
        for name, number in lines.items():
            sensor.write(name, int(number))
        after = sensor.read_scans(4000).gyro_dps.mean(axis=0)
    assert np.abs(before - list(ZERO.values())).max() < 0.05
    assert np.abs(after).max() < 0.05
    assert main(["registers", "sim:?seed=1", *(f"{name}={number}" for name, number in lines.items())]) == 0
    assert "−66" in capsys.readouterr().out


def test_offsets_that_stood_already_are_kept_in_the_sum_and_rounding_leaves_half_an_lsb():
    words = gyro_offset_words(gyros(ZERO))
    assert [(word.number, word.before) for word in words] == [(12 - 66, 12), (-5 + 40, -5), (-21, 0)]
    for word in words:
        assert word.remainder == pytest.approx(word.bias + (word.number - word.before) * LSB)
        assert abs(word.remainder) <= LSB / 2 + 1e-12


def test_a_zero_rate_beyond_thirteen_bits_is_refused_with_what_the_register_holds():
    far = gyros(ZERO | {"gyro_bias_y": 75.2}, offsets_lsb=None)
    with pytest.raises(FitError, match=r"YGYRO_OFF holds -4096 to 4095 \(-75.0 to 75.0 °/s\)"):
        gyro_offset_words(far)
    near = gyros(ZERO | {"gyro_bias_y": 74.9}, offsets_lsb=None)
    assert gyro_offset_words(near)[1].number == -4090


@pytest.mark.parametrize("gyro", [(12, -5, 0), None])
@pytest.mark.parametrize("accel", [(5, -7, 0), None])
def test_the_offsets_say_above_their_numbers_that_they_assume_zeros(accel, gyro):
    bare = calibration(PLANE)
    bare = replace(bare, provenance=replace(bare.provenance, offsets_lsb=accel))
    text = registers_text(with_gyros(bare, ZERO, offsets_lsb=gyro))
    assumption = "# The session does not state the contents of these registers: the numbers assume 0."
    lists = text.split("# The values hold at ")
    assert [assumption in one for one in lists] == [False, accel is None, gyro is None]


# -- certificate -----------------------------------------------------------------------------------------


def test_the_certificate_holds_every_parameter_in_si_units_and_keeps_its_structure():
    root = judge(certificate_text(with_gyros(calibration(PLANE), EVERY), date(2026, 5, 4)))
    found = quantities(root)
    g = 9.80665
    for name, factor in (
        ("gyro_bias_x", 1.0),
        ("g_sensitivity_yz", 1 / g),
        ("g2_sensitivity_xx", 1 / g**2),
    ):
        assert float(found[name]["value"]) == pytest.approx(EVERY[name] * factor, rel=1e-12)
    assert found["gyro_bias_x"]["unit"] == r"\degree\second\tothe{-1}"
    assert found["gyro_bias_x"]["coverageProbability"] == "0.95"
    assert set(EVERY) <= set(found)
    assert set(UNITS.values()) <= set(SI_UNITS)


def test_the_certificate_names_the_gyro_and_what_was_not_determined():
    text = certificate_text(with_gyros(calibration(PLANE), ZERO), date(2026, 5, 4))
    assert "Zero rate of gyro X (gyro_bias_x)" in text
    assert "Accelerometers and gyros of sensor adis16354" in text
    assert "gyro_scale_x" in text
    poor = replace(
        with_gyros(calibration(PLANE), ZERO),
        gyro=gyros(ZERO).of({k: Estimated(v, None, "dps") for k, v in ZERO.items()}),
    )
    assert "expandedUnc" not in certificate_text(poor).split("Parameters of the gyros")[1]


def test_a_calibration_file_with_gyros_is_exported_on(tmp_path):
    path = tmp_path / "own.json"
    own = with_gyros(calibration(PLANE), FULL)
    own.save(path)
    for name in ("own.h", "own.xml", "own.txt"):
        assert main(["export", str(path), "-o", str(tmp_path / name)]) == 0
    assert (tmp_path / "own.h").read_text() == c_header(own)
    assert "ZGYRO_OFF=" in (tmp_path / "own.txt").read_text()
    assert "Parameters of the gyros" in Path(tmp_path / "own.xml").read_text("utf-8")


def test_registers_show_the_chip_s_offsets_beside_what_the_calibration_would_write(tmp_path, capsys):
    path = tmp_path / "own.json"
    with_gyros(calibration(PLANE), ZERO, offsets_lsb=(0, 0, 0)).save(path)
    assert main(["registers", "sim:?seed=1", "XGYRO_OFF=12", "--cal", str(path)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    row = next(line for line in lines if line[:1] == ["XGYRO_OFF"])
    assert row[2:5] == ["12", "0.21978", "°/s"]
    assert row[5:10] == ["-66", "=", "−1.209", "°/s", "(u"]
    assert main(["registers", "sim:?seed=1", "--cal", str(path), "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["registers"]}
    assert rows["YGYRO_OFF"]["calibration"] == {
        "number": 40, "value": pytest.approx(40 * LSB), "u": 2e-3, "unit": "°/s",
    }  # fmt: skip
    assert rows["XACCL_OFF"]["calibration"]["number"] == -26
    assert "calibration" not in rows["SMPL_PRD"]
    assert main(["registers", "sim:?seed=1", "--json"]) == 0
    assert "calibration" not in capsys.readouterr().out
    assert main(["registers", "--cal", str(path)]) == 2


@pytest.fixture(scope="module")
def two_sessions(tmp_path_factory):
    """Accelerometers on a stage and gyros on a table, of one simulated part, and files of these gyros."""
    folder = tmp_path_factory.mktemp("two")
    for name, plan in (("stage", ["four-position"]), ("table", ["gyro-turns", "--turns", "1"])):
        words = ["--auto", "--dwell", "2", "-o", str(folder / f"{name}.session"), "--serial", "A7"]
        assert main(["calibrate", "sim:?seed=4", "--plan", *plan, *words]) == 0
    assert main(["export", str(folder / "table.session"), "-o", str(folder / "exported.json")]) == 0
    GyroCalibration.load(folder / "table.session").save(folder / "gyros.json")
    return folder


@pytest.fixture(scope="module")
def table(two_sessions):
    return GyroCalibration.load(two_sessions / "table.session")


@pytest.fixture(scope="module")
def stage(two_sessions):
    return Calibration.load(two_sessions / "stage.session")


@pytest.mark.parametrize("name", ["table.session", "gyros.json"])
def test_the_gyros_of_another_session_stand_beside_these_accelerometers(two_sessions, table, stage, name):
    out = two_sessions / "both.json"
    words = ["--gyros", str(two_sessions / name), "--force", "-o"]
    assert main(["export", str(two_sessions / "stage.session"), *words, str(out)]) == 0
    both = Calibration.load(out)
    assert both.gyro["gyro_scale_z"].value == table["gyro_scale_z"].value
    assert both.parameters == stage.parameters
    stage.save(two_sessions / "stage.json", force=True)
    assert main(["export", str(two_sessions / "stage.json"), *words, str(two_sessions / "both.h")]) == 0
    text = (two_sessions / "both.h").read_text()
    assert text == c_header(both)
    assert "gyro_scale_z: not determined" not in text
    assert "file: stage.session" in text
    assert "gyros: method gyro, file table.session" in text


def test_gyros_of_another_part_or_of_none_are_refused_in_one_line(two_sessions, capsys):
    bare, other = two_sessions / "bare.json", two_sessions / "other.session"
    session = load_session(two_sessions / "stage.session")
    fit(session).calibration().save(bare, force=True)
    words = ["--plan", "four-position", "--dwell", "2", "--auto", "--serial", "B1", "-o", str(other)]
    assert main(["calibrate", "sim:?seed=5", *words]) == 0
    capsys.readouterr()
    for file, told in (
        (other, "its gyros are of B1, the accelerometers of A7"),
        (bare, "without gyros"),
        (two_sessions / "exported.json", "is no calibration; give a session"),
    ):
        words = ["export", str(two_sessions / "stage.session"), "--gyros", str(file), "-o"]
        assert main([*words, str(two_sessions / "x.json"), "--force"]) != 0
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1
        assert told in said[0]


def test_a_session_of_the_gyros_alone_says_how_they_are_handed_over(two_sessions, capsys):
    table, out = two_sessions / "table.session", two_sessions / "alone.h"
    assert main(["export", str(table), "-o", str(out)]) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert "--gyros table.session" in said
    assert not out.exists()
    with pytest.raises(FitError, match="its gyros are calibrated"):
        Calibration.load(table)


@pytest.mark.parametrize("name", ["table.session", "gyros.json"])
def test_registers_stand_beside_the_offsets_of_gyros_that_are_calibrated_alone(
    two_sessions, table, name, capsys
):
    capsys.readouterr()
    words = [
        "registers",
        "sim:?seed=4",
        "--cal",
        str(two_sessions / name),
        "XGYRO_OFF",
        "XACCL_OFF",
        "--json",
    ]
    assert main(words) == 0
    gyro, accelerometer = json.loads(capsys.readouterr().out)["registers"]
    assert gyro["calibration"]["number"] == gyro_offset_words(table)[0].number
    assert gyro["calibration"]["u"] == table["gyro_bias_x"].u
    assert "calibration" not in accelerometer


def test_names_of_where_the_gyros_come_from_survive_the_file_and_stand_in_every_export(
    two_sessions, table, stage
):
    both = replace(stage, gyro=table)
    assert both.gyro.source == "table.session"
    both.save(two_sessions / "named.json", force=True)
    assert Calibration.load(two_sessions / "named.json").gyro.source == "table.session"
    assert "# Gyros from table.session." in registers_text(both)
    assert "The gyros were calibrated in table.session." in certificate_text(both, date(2026, 5, 4))


@pytest.mark.parametrize("write", [registers_text, c_header])
def test_gyros_that_a_session_does_not_calibrate_are_named_with_the_reason(write):
    rest = Dwell(0, np.arange(9.0), np.zeros((9, 2)), gyro=np.eye(9, 3))
    session = Session((rest,), accel_unit="mg", gyro_unit="counts")
    made = trace_calibrations.with_gyros(calibration(PLANE), session)
    assert "corrected: gyros: session: gyros in counts have no known scale" in write(made)
    alone = trace_calibrations.with_gyros(calibration(PLANE), replace(session, dwells=()))
    assert not alone.not_corrected
