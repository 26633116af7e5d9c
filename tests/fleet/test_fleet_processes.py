"""Many sessions by processes of this machine: nothing lost, nothing twice, whatever dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path

import pytest

from adis_gonio import __version__
from adis_gonio.base.budget import Budget, within
from adis_gonio.fleet.fleet_run import run_fleet
from adis_gonio.fleet.session_record import Options, work
from adis_gonio.fleet.store import IN_MEMORY, Store
from adis_gonio.fleet.workers import LocalPool
from adis_gonio.record.provenance import digest_of_file
from fleet.mortal_worker import work_or_die
from fleet.sessions import write_fleet

FITS = Options(trace=False)
pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills processes as POSIX does")


def test_a_worker_killed_in_the_middle_loses_nothing_and_changes_nothing(tmp_path):
    files = write_fleet(tmp_path / "fleet", 8, seed=1)
    with LocalPool(1) as pool, Store(IN_MEMORY) as store:
        calm = run_fleet(files, FITS, store, pool)
    killed = []

    def kill(progress):
        if progress.startswith("3 of 8 sessions"):
            killed.append(multiprocessing.active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    with LocalPool(2) as pool, Store(tmp_path / "journal", strict=True) as journal:
        with within(Budget(tell=kill)):
            stormy = run_fleet(files, FITS, journal, pool)
        assert journal.sessions == len(files)
    assert killed
    assert stormy.failed == 0
    for name in ("a.json", "a.parquet", "a.html"):
        calm.write(tmp_path / name)
        calm_bytes = (tmp_path / name).read_bytes()
        stormy.write(tmp_path / name)
        assert (tmp_path / name).read_bytes() == calm_bytes


def test_a_file_that_kills_every_worker_is_a_row_with_its_reason_and_is_tried_again_next_time(tmp_path):
    files = write_fleet(tmp_path / "fleet", 4, seed=2)
    deadly = tmp_path / "fleet" / "deadly.csv"
    Path(files[1]).rename(deadly)
    left = [*files[:1], *files[2:], str(deadly)]
    with LocalPool(2, work_or_die) as pool, Store(tmp_path / "journal", strict=True) as journal:
        fleet = run_fleet(left, FITS, journal, pool)
    failed = [record for record in fleet.records if record.status != "ok"]
    assert [record.path for record in failed] == [str(deadly)]
    assert "its process died twice" in failed[0].reason
    with LocalPool(1) as pool, Store(tmp_path / "journal", strict=True) as journal:
        again = run_fleet(left, FITS, journal, pool)
    assert (again.known, again.failed) == (3, 0)


def test_a_worker_of_another_version_or_before_another_file_does_not_answer_for_it(tmp_path):
    path = write_fleet(tmp_path, 1, seed=3)[0]
    digest = digest_of_file(path)
    asked = FITS.as_dict()
    assert work(path, digest, asked, __version__).status == "ok"
    for record, reason in (
        (
            work(path, digest, asked, "0.0.1"),
            f"the worker has adis-gonio {__version__}, the fleet 0.0.1",
        ),
        (work(path, "0" * 64, asked, __version__), "is another file"),
        (
            work(f"{path}.not", digest, asked, __version__),
            "cannot be read by the worker: No such file",
        ),
    ):
        assert record.status == "failed"
        assert reason in record.reason
        assert record.sha256 is None  # no store keeps it
