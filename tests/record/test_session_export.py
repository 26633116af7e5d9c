from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import OutputError, UsageError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.device.sensor.scanning import PolledScans
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.samples_writer import SamplesRecorder, session_dict, write_samples_csv
from adis_gonio.record.source import Settings


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "a.session"
    with open_sensor("sim:?seed=2") as sensor:
        runner = SessionRunner.begin(
            sensor,
            path,
            plan("tumble", 3, check=1),
            Settings(dwell_s=0.5, settle_s=0.1),
            auto=True,
            gravity_mps2=9.81,
            fixture_sigma_deg=0.1,
            title="Δ bench",
        )
        list(runner.run(so_far=False))
    return path


def test_notes_of_a_recording_are_in_its_header_and_come_back_as_the_session_s(tmp_path):
    path = tmp_path / "rest.csv"
    with open_sensor("sim:?seed=2") as sensor, SamplesRecorder(path, "adis16354") as recorder:
        recorder.notes = ["rows may mix\ntwo updates: beware", "second"]
        recorder.add(sensor.read_scans(3000))
    assert "# note: rows may mix two updates: beware\n# note: second\ntime_s," in path.read_text()
    assert load_session(path).notes[:2] == ("rows may mix two updates: beware", "second")


class FullDisk:
    """A file whose disk takes half of a block and no more."""

    def __init__(self, file):
        self._file = file

    def write(self, data):
        self._file.write(data[: len(data) // 2])

    def flush(self):
        self._file.flush()
        raise OSError(errno.ENOSPC, "No space left on device")

    def close(self):
        self._file.close()


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
def test_the_rows_before_a_full_disk_or_a_kill_can_be_read(tmp_path, name):
    path = tmp_path / name
    with open_sensor("sim:?seed=2") as sensor:
        recorder = SamplesRecorder(path, "adis16354", title="\udcff")
        for _ in range(3):
            recorder.add(sensor.read_scans(1000))
        assert sum(map(len, load_session(path).dwells)) > 2500  # as after a kill: nothing was closed
        recorder._file = FullDisk(recorder._file)
        with pytest.raises(OutputError, match="its 3000 rows from before are complete"):
            recorder.add(sensor.read_scans(1000))
    assert sum(map(len, load_session(path).dwells)) > 2500


def test_a_recorder_leaves_a_file_that_came_to_exist_before_its_first_block(tmp_path):
    path = tmp_path / "a.csv"
    with open_sensor("sim:?seed=2") as sensor, SamplesRecorder(path, "adis16354") as recorder:
        path.write_text("of another program")
        with pytest.raises(UsageError, match=r"a\.csv: exists already"):
            recorder.add(sensor.read_scans(10))
    assert path.read_text() == "of another program"


def test_slow_polling_is_noted_in_a_session(tmp_path, monkeypatch):
    path, caveat = tmp_path / "a.session", "rows may mix updates"
    monkeypatch.setattr(PolledScans, "caveat", property(lambda stream: caveat))
    with open_sensor("sim:?seed=2&stream=0") as sensor:
        settings = Settings(dwell_s=0.5, settle_s=0.1)
        list(SessionRunner.begin(sensor, path, plan(), settings, auto=True).run())
    session = load_session(path)
    assert session.facts["scanning"]["how"].startswith("this bus cannot use data-ready; polling")
    assert caveat in session.notes
    write_samples_csv(session, tmp_path / "a.csv")
    assert f"# note: {caveat}\n" in (tmp_path / "a.csv").read_text()


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
def test_the_csv_of_an_archive_is_the_same_session(archive, tmp_path, name):
    session = load_session(archive)
    write_samples_csv(session, tmp_path / name)
    back = load_session(tmp_path / name)
    assert (back.sensor, back.accel_unit, back.plane) == (session.sensor, session.accel_unit, session.plane)
    assert (back.gravity_mps2, back.fixture_sigma_deg) == (9.81, 0.1)
    assert back.title == "Δ bench"
    assert len(back.dwells) == len(session.dwells) == 7
    for ours, theirs in zip(session.dwells, back.dwells, strict=True):
        assert (ours.angle_deg, ours.approach, ours.use) == (theirs.angle_deg, theirs.approach, theirs.use)
        assert np.array_equal(ours.accel, theirs.accel)
        assert np.array_equal(ours.time_s, theirs.time_s)
        assert np.array_equal(ours.gyro, theirs.gyro)
        assert np.array_equal(ours.supply_v, theirs.supply_v)


def test_the_json_holds_the_facts(archive, tmp_path):
    session = load_session(archive)
    document = json.loads(json.dumps(session_dict(session), allow_nan=False))
    assert document["title"] == "Δ bench"
    assert document["facts"]["truth"] == session.facts["truth"]
    assert document["facts"]["registers"]["before"]["SMPL_PRD"] == 1


def test_the_package_itself_imports_without_scipy():
    import subprocess
    import sys

    code = (
        "import sys, adis_gonio.record as r, adis_gonio.bench as b; "
        "b.SessionRunner; r.load_session; r.plan; import adis_gonio.bench.events; "
        "print('scipy' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=600
    )
    assert result.stdout.strip() == "False"
