"""The C header gives equal bits on every machine, and the numbers of the calibration within its bounds."""

from __future__ import annotations

import re
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.calibrate import Calibration
from adis_gonio.handover.c_header import c_header
from adis_gonio.handover.fixed_point import CORDIC_UDEG, FIXED_UDEG, FLOAT_DEG, ONE, PARTS, polynomial_of
from handover.calibrations import CURVED, EVERY, PLANE, SPACE, calibration, of_counts
from handover.machines import MACHINES, STRICT
from handover.sweep import Printed, Scans, parsed, scans

KINDS = {
    "plain": lambda: calibration(PLANE),
    "curved": lambda: calibration(PLANE, CURVED),
    "every effect": lambda: calibration(PLANE, EVERY),
    "space": lambda: calibration(
        SPACE, {"quadratic": (6.1, -3.4, 2.0), "scale_temperature": (60.0, -45.0, 9.0)}
    ),
    "adis16350": lambda: calibration(PLANE, CURVED, sensor="adis16350"),
    "mg": lambda: calibration(PLANE, EVERY, sensor="generic"),
    "counts": of_counts,
}
SPAN = {"mg": 256 * 2600, "counts": 256 * 6000, "adis16350": 256 * 900}
SCANS = 10_000
ON_MACHINES = 4_000
OTHERS = 400


def span_of(kind: str) -> int:
    return SPAN.get(kind, 256 * 5400)


def machine_named(name: str):
    machine = next(one for one in MACHINES if one.name == name)
    if reason := machine.missing():
        pytest.skip(reason)
    return machine


def shown_by(own: Calibration, drawn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gravity (n, axes) and angle (n,) in degrees by the calibration itself, and rows within the range."""
    sensor = own.provenance.sensor
    lsb = {"adis16354": 0.4672, "adis16350": 2.522}.get(sensor, 1.0)
    numbers = drawn.numbers[:, : own.axes] / PARTS
    if sensor == "generic":
        temperature, supply = drawn.temperature / PARTS, drawn.supply / PARTS / 1000
    else:
        temperature, supply = 25 + 0.1453 * drawn.temperature / PARTS, 1.8315e-3 * drawn.supply / PARTS
    conditions = {"temperature_c": temperature, "supply_v": supply}
    inside = (np.abs(temperature - 25) < 128) & (np.abs(supply - 5) < 8)
    gravity = own.apply(numbers * lsb, **conditions)
    gravity[~inside] = np.nan
    angle = np.degrees(np.arctan2(gravity[:, 1], gravity[:, 0]))
    length = np.hypot(gravity[:, 0], gravity[:, 1])
    with np.errstate(invalid="ignore"):
        rows = np.isfinite(angle) & (length > 0.5) & (np.abs(gravity).max(axis=1) < 1.8)
    return gravity, angle, rows


def off(shown_deg, angle_deg):
    return (shown_deg - angle_deg + 180) % 360 - 180


def shown_on(machine: str, folder: Path, kind: str, n: int, *, words: bool) -> Printed:
    """What the compiled header prints for n scans; `words` draws every second one as register words."""
    own = KINDS[kind]()
    (folder / "own.h").write_text(c_header(own))
    angle = "_angle_##u" if own.planar else "_angle_xy_##u"
    options = [
        '-DHEADER="own.h"', "-DPREFIX=adis_gonio", f"-DSCANS={n}", f"-DSPAN={span_of(kind)}UL",
        f"-DAXES={own.axes}", f"-DANGLE(u)={angle}", *(["-DWORDS"] if words else []),
    ]  # fmt: skip
    return parsed(machine_named(machine).run(folder, *options), own.axes)


@pytest.fixture(scope="module")
def on_host(tmp_path_factory):
    """What the host prints, once for all machines that are compared with it."""

    @cache
    def shown(kind: str, n: int, words: bool) -> Printed:
        return shown_on("host", tmp_path_factory.mktemp("host"), kind, n, words=words)

    return shown


RUNS = [
    (kind, ON_MACHINES if kind == "curved" else OTHERS, machine.name)
    for kind in KINDS
    for machine in MACHINES
    # The other kinds have the operations of "curved" with other numbers: compilers of this host are enough.
    if not machine.runner or kind in ("curved", "every effect", "space", "counts")
]


@pytest.mark.parametrize(("kind", "n", "machine"), RUNS)
def test_every_machine_gives_the_bits_of_the_host_and_float_within_its_bound(
    tmp_path, on_host, machine, kind, n
):
    own = KINDS[kind]()
    words = polynomial_of(own).words
    host = on_host(kind, n, words)
    got = host if machine == "host" else shown_on(machine, tmp_path, kind, n, words=words)
    assert got.self_check == 0
    assert len(got.udeg) == n
    assert np.array_equal(got.fixed, host.fixed)
    assert np.array_equal(got.udeg, host.udeg)
    every = slice(None, None, 2 if words else 1)  # words may be beyond the header's range
    drawn = scans(n, span_of(kind), words=words)
    given = (drawn.numbers, drawn.temperature, drawn.supply)
    gravity, angle, rows = shown_by(own, Scans(*(one[every] for one in given)))
    assert np.abs(off(got.deg[every][rows].astype(float), angle[rows])).max() < FLOAT_DEG
    assert np.abs(got.single[every][rows] - gravity[rows]).max() < 2e-6


@pytest.mark.parametrize("kind", KINDS)
def test_the_fixed_point_gives_the_calibration_s_angle_within_the_bound_of_the_header(on_host, kind):
    own = KINDS[kind]()
    gravity, angle, rows = shown_by(own, scans(SCANS, span_of(kind), words=False))
    assert rows.sum() > 1000
    got = on_host(kind, SCANS, False)
    assert np.abs(off(got.udeg[rows] * 1e-6, angle[rows])).max() * 1e6 < FIXED_UDEG
    at_half_g = 0.5 * np.radians(FIXED_UDEG * 1e-6)
    assert np.abs(got.fixed[rows] / ONE - gravity[rows]).max() < at_half_g


def test_the_angle_of_whole_numbers_is_right_in_every_octant_and_at_every_size(tmp_path):
    rng = np.random.default_rng(1)
    size = 2.0 ** rng.uniform(0, 30.9, 20_000)
    psi = rng.uniform(-np.pi, np.pi, 20_000)
    points = np.rint(size * [np.sin(psi), np.cos(psi)]).astype(np.int64).T
    exact = {(0, 5): 0, (5, 0): 90, (0, -5): 180, (-5, 0): -90, (0, 0): 0, (7, 7): 45, (-7, -7): -135}
    (tmp_path / "own.h").write_text(c_header(calibration(PLANE)))
    listed = ",\n".join(f"{{ {y}, {x} }}" for y, x in [*exact, *points.tolist()])
    source = tmp_path / "angles.c"
    source.write_text(
        f'#include "own.h"\n#include <stdio.h>\nstatic const int32_t points[][2] = {{ {listed} }};\n'
        "int main(void) { unsigned k; for (k = 0; k < sizeof points / sizeof *points; k++)"
        ' printf("%ld\\n", (long)adis_gonio_atan2_udeg_(points[k][0], points[k][1])); return 0; }\n'
    )
    udeg = np.array(machine_named("host").run(tmp_path, source=source).split(), dtype=np.int64)
    few, many = udeg[: len(exact)], udeg[len(exact) :]
    error = many - np.degrees(np.arctan2(*points.T)) * 1e6
    assert np.abs((error + 180e6) % 360e6 - 180e6).max() < CORDIC_UDEG
    assert np.abs(few - 1e6 * np.array(list(exact.values()))).max() <= CORDIC_UDEG


@pytest.mark.parametrize("kind", KINDS)
def test_two_headers_stand_in_one_program_and_two_of_one_name_are_refused(tmp_path, kind):
    machine = machine_named("host")
    (tmp_path / "one.h").write_text(c_header(KINDS[kind](), "one"))
    (tmp_path / "two.h").write_text(c_header(calibration(PLANE), "two"))
    main = "int main(void) { return one_self_check() + two_self_check(); }\n"
    source = tmp_path / "both.c"
    source.write_text('#include "one.h"\n#include "two.h"\n#include "one.h"\n' + main)
    machine.run(tmp_path, "-Wconversion", "-Wshadow", "-Wundef", "-Wcast-qual", source=source)
    (tmp_path / "again.h").write_text(c_header(calibration(PLANE, {"cubic": (1.0, 1.0)}), "one"))
    source.write_text('#include "one.h"\n#include "again.h"\nint main(void) { return 0; }\n')
    done = subprocess.run(
        [*machine.compiler, *STRICT, str(source), "-o", str(tmp_path / "x")],
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode != 0
    assert "two calibrations are called one" in done.stderr


def test_the_self_check_notices_a_changed_number(tmp_path):
    machine = machine_named("host")
    text = c_header(calibration(PLANE, CURVED))
    (bias,) = map(int, re.findall(r"const int32_t raw_x = .* - (\d+)L, ", text))
    source = tmp_path / "check.c"
    source.write_text('#include "own.h"\nint main(void) { return adis_gonio_self_check() == 1 ? 0 : 1; }\n')
    assert f"- {bias}L" in text
    (tmp_path / "own.h").write_text(text.replace(f"- {bias}L", f"- {bias + 1000}L"))
    machine.run(tmp_path, source=source)


def test_words_of_an_author_stay_inside_the_comment(tmp_path):
    machine = machine_named("c++")
    hostile = calibration(PLANE, title="a */ int x; /* b ??/ é\n#error c \\", serial="\\")
    (tmp_path / "own.h").write_text(c_header(hostile))
    (tmp_path / "own.h").read_text("ascii")
    source = tmp_path / "quiet.c"
    source.write_text('#include "own.h"\nint main(void) { return adis_gonio_self_check(); }\n')
    machine.run(tmp_path, source=source)
    for line in (tmp_path / "own.h").read_text().splitlines():
        assert not line.endswith("\\")
