"""The index loses nothing: when interrupted, on a full disk, damaged, or used by two at once."""

import os
import shutil
import sqlite3
import subprocess
import sys

import pytest

from adis_gonio.base.errors import DataError, OutputError
from adis_gonio.fleet import fleet_run as run
from adis_gonio.fleet.fleet_run import scan
from adis_gonio.fleet.fleet_summary import summarise
from adis_gonio.fleet.session_record import record_of
from adis_gonio.fleet.store import NAME, Store
from adis_gonio.record.loading import load_session
from adis_gonio.record.samples_writer import write_samples_csv
from fleet.made_up import made_up
from fleet.recorded import recorded


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("originals")
    with pytest.MonkeyPatch.context() as patch:
        for n in range(3):
            when = f"202{n}-03-01T09:00:00.000+00:00"
            recorded(folder / f"{n}.session", patch, url=f"sim:?seed={n}", when=when)
    return folder


@pytest.fixture
def folder(originals, tmp_path):
    return shutil.copytree(originals, tmp_path / "sessions")


def listed(folder, **more):
    with Store.of([folder]) as store:
        return scan(store, [folder], **more), store.rows()


def test_only_new_and_changed_files_are_computed(folder, originals):
    assert listed(folder)[0].computed == 3
    assert listed(folder)[0].computed == 0
    shutil.copy(originals / "0.session", folder / "1.session")  # other content under an old name
    recorded_again, rows = listed(folder)
    assert recorded_again.computed == 0  # this content is known already
    assert [len(row["copies"]) for row in rows] == [1, 0]
    os.utime(folder / "0.session", ns=(1, 1))  # another time, the same content
    assert listed(folder)[0].computed == 0


def test_a_file_that_was_changed_replaces_what_it_held(folder):
    csv = folder / "x.csv"
    write_samples_csv(load_session(folder / "0.session"), csv)
    listed(folder)
    text = csv.read_text("utf-8").replace("serial: A7", "serial: A8")
    csv.write_text(text, "utf-8")
    found, rows = listed(folder)
    assert found.computed == 1
    assert [row["serial"] for row in rows if row["path"].endswith("x.csv")] == ["A8"]
    assert len(rows) == 4


def test_a_file_that_is_gone_is_remembered_and_one_that_moved_is_the_same(folder):
    listed(folder)
    (folder / "0.session").unlink()
    (folder / "1.session").rename(folder / "renamed.session")
    found, rows = listed(folder)
    assert found.computed == 0
    assert [row["gone"] for row in rows] == [True, False, False]
    assert {row["path"].rsplit("/")[-1] for row in rows} == {"0.session", "renamed.session", "2.session"}


def test_an_archive_and_the_csv_exported_from_it_are_one_session_of_a_history(folder):
    write_samples_csv(load_session(folder / "0.session"), folder / "a.csv")
    with Store.of([folder]) as index:
        scan(index, [folder])
        records = index.records("A7")
    assert [record.path.rsplit("/")[-1] for record in records] == ["0.session", "1.session", "2.session"]


def test_records_come_back_as_they_were(folder):
    with Store.of([folder]) as index:
        scan(index, [folder])
        assert [r.as_dict() for r in index.records("A7")] == [
            record_of(folder / f"{n}.session").as_dict() for n in range(3)
        ]
        for row in index.rows():
            assert {k: v for k, v in row.items() if k not in ("copies", "gone")} == record_of(
                row["path"]
            ).row()
            assert row["traced"] is False


def test_an_interruption_keeps_what_was_computed(folder, monkeypatch):
    real, calls = run.record_of, []

    def interrupted(path, **more):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(path)
        return real(path, **more)

    monkeypatch.setattr(run, "record_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        listed(folder)
    monkeypatch.setattr(run, "record_of", real)
    found, rows = listed(folder)
    assert (found.computed, found.known, len(rows)) == (1, 2, 3)


def test_a_full_disk_loses_nothing_and_is_an_error_with_the_remedy(folder):
    listed(folder)
    with Store.of([folder]) as index:
        before = index.rows()
        index._connection.execute("PRAGMA max_page_count = 1")  # what a full disk is to SQLite
        with pytest.raises(OutputError, match="full; it holds 3 sessions: make room"):
            index.keep(*(made_up(f"20{10 + n}-01-01", serial="Z9") for n in range(40)))
        assert index.rows() == before
    with Store.of([folder]) as index:
        assert index.rows() == before


def test_an_index_that_cannot_be_written_is_an_error_with_the_remedy(tmp_path):
    with pytest.raises(OutputError, match=r"cannot be opened: .*name another file by --index"):
        Store(tmp_path / "no folder" / "index")


@pytest.mark.parametrize("harm", ["middle", "head", "cut"])
def test_a_damaged_index_is_refused_left_as_it_is_and_made_again_once_it_is_removed(folder, harm):
    before = listed(folder)[1]
    path = folder / NAME
    content = bytearray(path.read_bytes())
    if harm == "middle":
        content[4096:-4096] = os.urandom(len(content) - 8192)
    elif harm == "head":
        content[:100] = os.urandom(100)
    else:
        del content[len(content) // 2 :]
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"is damaged .*; remove it"):
        listed(folder)
    assert path.read_bytes() == bytes(content)
    path.unlink()
    found, rows = listed(folder)
    assert (found.computed, rows) == (3, before)


def test_another_database_is_refused_and_left_as_it_is(folder, tmp_path):
    path = tmp_path / "mine.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE t (x)")
    connection.close()
    content = path.read_bytes()
    for other in (path, folder / "0.session"):
        with pytest.raises(DataError, match="is no index of sessions"):
            Store(other)
    text = tmp_path / "text"
    text.write_text("words " * 100)
    with pytest.raises(DataError, match="is no index of sessions"):
        Store(text)
    assert path.read_bytes() == content


def test_two_programs_at_once_compute_one_index(folder):
    command = [sys.executable, "-m", "adis_gonio", "archive", str(folder)]
    both = [subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE) for _ in range(2)]
    for program in both:
        _, error = program.communicate(timeout=120)
        assert program.returncode == 0, error
    found, rows = listed(folder)
    assert (found.computed, len(rows)) == (0, 3)


def test_a_trace_that_is_asked_for_later_is_made_once(folder, monkeypatch):
    from dataclasses import replace

    real, traced = run.record_of, []

    def quick(path, *, trace, evidence):
        traced.append(trace)
        return replace(real(path), traced=trace)

    monkeypatch.setattr(run, "record_of", quick)
    listed(folder)
    assert listed(folder, trace=True)[0].computed == 3
    assert listed(folder, trace=True)[0].computed == 0
    assert listed(folder)[0].computed == 0  # what was traced stays so
    assert traced == [False] * 3 + [True] * 3


def test_the_index_is_no_session_and_hidden_files_are_none(folder):
    listed(folder)
    (folder / ".hidden.csv").write_text("x")
    found, rows = listed(folder)
    assert (found.known, len(rows)) == (3, 3)


def test_a_summary_counts_what_is_there(tmp_path):
    with Store(tmp_path / "index") as index:
        index.keep(*(made_up(f"20{10 + n}-01-01", serial=f"S{n % 3}", bias_x=float(n)) for n in range(9)))
        found = summarise([record.row() for record in index.records()])
    assert [found.sessions[name] for name in ("n", "failed", "traced", "units")] == [9, 0, 0, 3]
    (bias_x,) = (one for one in found.parameters if one.name == "bias_x")
    assert bias_x.mean == 4
    probable = {"2.5": 0.2, "5": 0.4, "25": 2, "50": 4, "75": 6, "95": 7.6, "97.5": 7.8}
    assert bias_x.quantiles == pytest.approx(probable)
    assert bias_x.sd == pytest.approx(2.7386128)
    assert "bias_z" not in {one.name for one in found.parameters}
