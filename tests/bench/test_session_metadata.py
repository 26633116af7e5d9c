"""What the operator writes down goes from the bench into every file and page that leaves it."""

from __future__ import annotations

import json
import sqlite3

import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.handover.calibration_report import build_page
from adis_gonio.model.records import ON_EARTH_MPS2, checked_gravity_mps2
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.samples_writer import session_dict, write_samples_csv
from adis_gonio.record.source import Settings

WRITTEN = {"operator": "A. Müller", "serial": "SN 0815", "stage": "dividing head, 40:1"}


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    made = tmp_path_factory.mktemp("metadata") / "a.session"
    with open_sensor("sim:?seed=3") as sensor:
        runner = SessionRunner.begin(
            sensor, made, plan("four-position"), Settings(dwell_s=0.5), auto=True, **WRITTEN
        )
        list(runner.run(so_far=False))
    return made


def test_operator_serial_and_stage_survive_archive_csv_and_json(path, tmp_path):
    session = load_session(path)
    assert {name: getattr(session, name) for name in WRITTEN} == WRITTEN
    write_samples_csv(session, tmp_path / "a.csv")
    back = load_session(tmp_path / "a.csv")
    assert {name: getattr(back, name) for name in WRITTEN} == WRITTEN
    document = json.loads(json.dumps(session_dict(session)))
    assert {name: document[name] for name in WRITTEN} == WRITTEN


def test_the_report_shows_who_measured_which_part_on_which_stage(path):
    session = load_session(path)
    html = build_page(session, [fit(session)], "not traced here")
    assert all(text in html for text in WRITTEN.values())


def test_a_session_file_of_an_older_program_loads_with_empty_metadata(path, tmp_path):
    old = tmp_path / "old.session"
    old.write_bytes(path.read_bytes())
    with sqlite3.connect(old) as connection:
        for (name,) in connection.execute(
            "SELECT name FROM sqlite_master WHERE type = 'trigger'"
        ).fetchall():
            connection.execute(f"DROP TRIGGER {name}")
        connection.execute("DELETE FROM meta WHERE key IN ('operator', 'serial', 'stage')")
    connection.close()
    session = load_session(old)
    assert (session.operator, session.serial, session.stage) == ("", "", "")


@pytest.mark.parametrize(
    ("value", "unit"), [(980.665, "cm/s² (Gal)"), (1.0, "g"), (980665.0, "mGal"), (32.174, "ft/s²")]
)
def test_gravity_out_of_range_is_refused_with_the_unit_that_was_meant(value, unit):
    for anywhere in (False, True):
        with pytest.raises(UsageError, match=r"m/s², 9\.7 to 9\.9 on Earth") as caught:
            checked_gravity_mps2(value, anywhere=anywhere)
        assert f"; {value:g} {unit}" in str(caught.value)


def test_another_place_than_earth_is_taken_where_it_is_said_to_be_one():
    assert checked_gravity_mps2(1.62, anywhere=True) == 1.62
    with pytest.raises(UsageError, match="on Earth"):
        checked_gravity_mps2(1.62)


def test_all_of_the_earth_is_in_range():
    low, high = ON_EARTH_MPS2
    # WGS 84: the equator at 9000 m and the pole at sea level, 3.086e-6 (m/s²)/m between.
    assert low <= 9.7803 - 9000 * 3.086e-6
    assert high >= 9.8322 + 500 * 3.086e-6
