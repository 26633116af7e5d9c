"""What was done is on the disk, and is not done again."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import __version__
from adis_gonio.base.errors import DataError, OutputError
from adis_gonio.fleet.fleet_run import run_fleet as run_in
from adis_gonio.fleet.population_trace import trace_population
from adis_gonio.fleet.session_evidence import SessionEvidence, evidence_of
from adis_gonio.fleet.session_record import Options, work
from adis_gonio.fleet.store import Store
from adis_gonio.record.loading import load_session
from fleet.sessions import kept_in, write_fleet, write_session

FITS = Options(trace=False)


class Here:
    """Works in this process, in an order of its own, and keeps what it was given."""

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self.given: list[str] = []

    def results(self, jobs, options):
        for k in self._rng.permutation(len(jobs)):
            job = jobs[k]
            self.given.append(job.path)
            yield work(job.path, job.digest, options.as_dict(), __version__)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_fleet(tmp_path_factory.mktemp("fleet"), 6, seed=4)


def journal_at(path):
    return Store(path, strict=True)


def run_fleet(files, options, workers, store=None):
    with store or journal_at(":memory:") as held:
        return run_in(files, options, held, workers)


def test_the_order_of_arrival_changes_no_byte(files, tmp_path):
    written = []
    for seed in (1, 2):
        fleet = run_fleet(files, FITS, Here(seed))
        path = tmp_path / "a.parquet"
        fleet.write(path)
        written.append((fleet.as_dict(), path.read_bytes()))
    assert written[0] == written[1]


def test_a_full_disk_loses_nothing_and_the_run_goes_on_where_it_stopped(files, tmp_path):
    resource = pytest.importorskip("resource")
    path = tmp_path / "journal"
    whole = run_fleet(files, FITS, Here())
    with journal_at(path) as journal:
        run_fleet(files[:2], FITS, Here(), journal)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with journal_at(path) as journal:
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, limits[1]))  # as on a full disk
        try:
            with pytest.raises(OutputError, match=r"it holds \d sessions: make room"):
                run_fleet(files, FITS, Here(), journal)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    held = len(kept_in(path))
    again = Here()
    with journal_at(path) as journal:
        fleet = run_fleet(files, FITS, again, journal)
    assert 2 <= held < 6
    assert (fleet.known, len(again.given)) == (held, 6 - held)
    assert fleet.as_dict() == whole.as_dict()
    nobody = Here()
    with journal_at(path) as journal:
        assert run_fleet(files, FITS, nobody, journal).as_dict() == whole.as_dict()
    assert nobody.given == []


def test_other_options_and_other_bytes_are_done_and_another_name_is_not(files, tmp_path):
    path = tmp_path / "journal"
    one = Path(files[0])
    copy = tmp_path / "renamed.csv"
    copy.write_bytes(one.read_bytes())
    changed = tmp_path / "changed.csv"
    changed.write_bytes(one.read_bytes().replace(b"# title: ", b"# title: new"))
    with journal_at(path) as journal:
        run_fleet([str(one)], FITS, Here(), journal)
    for name, options, done in (
        (copy, FITS, False), (changed, FITS, True), (one, Options(trace=False, evidence=True), True),
    ):  # fmt: skip
        hands = Here()
        with journal_at(path) as journal:
            fleet = run_fleet([str(name)], options, hands, journal)
        assert bool(hands.given) == done
        assert fleet.records[0].path == str(name)


def test_the_same_session_by_two_names_or_in_two_files_counts_once(files, tmp_path):
    one = Path(files[0])
    copy, retitled = tmp_path / "copy.csv", tmp_path / "retitled.csv"
    copy.write_bytes(one.read_bytes())
    retitled.write_bytes(one.read_bytes().replace(b"# title: ", b"# title: new"))
    fleet = run_fleet([str(copy), *files, files[0], str(retitled)], FITS, Here())
    assert len(fleet.records) == len(files)
    first, *others = sorted([files[0], str(copy), str(retitled)])
    assert [(r.path, r.same_as) for r in fleet.repeated] == [(other, first) for other in others]


def test_of_two_files_with_the_same_data_that_counts_that_says_more(files, tmp_path):
    text = Path(files[0]).read_text("utf-8")
    bare, whole = tmp_path / "0.csv", tmp_path / "1.csv"
    whole.write_text(text, "utf-8")
    bare.write_text(text.replace("# serial: ", "# title: "), "utf-8")
    fleet = run_fleet([str(bare), str(whole)], FITS, Here())
    (kept,) = fleet.records
    assert kept.serial
    assert [(r.path, r.same_as) for r in fleet.repeated] == [(str(bare), str(whole))]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes of POSIX")
def test_a_pipe_is_a_row_with_its_reason_and_nothing_waits_for_it(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe.csv")
    monkeypatch.setattr(
        "adis_gonio.fleet.fleet_run.digest_of_file", lambda path: pytest.fail(f"{path}: read")
    )
    (row,) = run_fleet([str(tmp_path / "pipe.csv")], FITS, Here()).records
    assert "no regular file" in row.reason


def test_the_population_is_traced_from_the_journal_as_from_the_files(files, tmp_path):
    asked = Options(trace=False, evidence=True)
    with journal_at(tmp_path / "journal") as journal:
        run_fleet(files, asked, Here(), journal)
    with journal_at(tmp_path / "journal") as journal:
        kept = run_fleet(files, asked, Here(), journal)
    told = [evidence_of(load_session(path)).as_dict() for path in files]  # rounded, as evidence is kept
    own = trace_population([SessionEvidence.from_dict(one) for one in told])
    assert kept.as_dict()["population"] == own.as_dict()
    assert kept.population_lines == own.summary()
    few = run_fleet(files[:2], asked, Here())
    assert "needs at least 5" in few.as_dict()["population"]["reason"]


def test_what_is_no_journal_is_refused_and_left_as_it_is(tmp_path):
    path = write_session(tmp_path / "a.csv", np.random.default_rng(5))
    before = path.read_bytes()
    with pytest.raises(DataError, match="is no index of sessions; name another file by --journal"):
        journal_at(path)
    assert path.read_bytes() == before


def test_a_damaged_journal_is_refused_and_left_as_it_is(tmp_path, files):
    path = tmp_path / "journal"
    with journal_at(path) as journal:
        run_fleet(files, FITS, Here(), journal)
    content = bytearray(path.read_bytes())
    content[4096:-4096] = bytes(len(content) - 8192)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"is damaged .*; remove it"):
        journal_at(path)
    assert path.read_bytes() == content


def test_two_runs_at_one_journal_lose_nothing(files, tmp_path):
    path = tmp_path / "journal"
    with journal_at(path) as one, journal_at(path) as other:
        run_in(files[:4], FITS, one, Here())
        both = run_in(files, FITS, other, Here())
    assert both.known == 4
    assert len(kept_in(path)) == len(files)
