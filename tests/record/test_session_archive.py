from __future__ import annotations

import math
import os
import re
import sqlite3
import tempfile
import threading
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import DataError, SessionError, UsageError
from adis_gonio.device.sensor.driver import DEFAULT_SCAN
from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.record.archive import Archive, ArchiveView, is_archive
from adis_gonio.record.archive_tables import APPLICATION_ID, Attempt, Header, Move, utc_now
from adis_gonio.record.blocks import WITHOUT_NEWS
from adis_gonio.record.plans import Plan, Position, plan
from adis_gonio.record.session_reader import GOES_ON, read_session
from adis_gonio.record.source import Settings


def header(**changes: object) -> Header:
    values = {
        "url": "test:",
        "variant": "adis16354",
        "plan": plan("four-position"),
        "settings": Settings().as_dict(),
        "gravity_mps2": 9.81,
        "fixture_sigma_deg": 0.1,
    }
    return Header(**(values | changes))


def block(seed: int, scans: int = 50, lost: int = 0) -> ScanBlock:
    rng = np.random.default_rng(seed)
    words = rng.integers(0, 1 << 16, (scans, len(DEFAULT_SCAN))).astype(np.uint16)
    return ScanBlock(DEFAULT_SCAN, words, seed + np.arange(scans) * 1e-3, lost)


def attempt(place: int, outcome: str = "complete", seed: int | None = None, **more: object) -> Attempt:
    seed = 10 * place if seed is None else seed
    parts = [("before", block(seed + 5)), ("dwell", block(seed)), ("dwell", block(seed + 1, 30, 2))]
    position = plan("four-position").positions[place]
    return Attempt(place, position, outcome, utc_now(), seed, seed + 2.0, parts, **more)


def begun(path: Path, **changes: object) -> Archive:
    archive = Archive.create(path, header(**changes))
    archive.begin_run(100.0, -100.0)
    return archive


def session_file(path: Path, places: int = 4) -> Path:
    with begun(path) as archive:
        for place in range(places):
            archive.add_attempt(attempt(place))
    return path


def test_a_free_turn_counts_the_scans_that_it_lost_itself_and_states_its_end(tmp_path):
    path = tmp_path / "a.session"
    with begun(path, plan=Plan("free-turn", (Position(None, 0),), turns=2)) as archive:
        archive.add_record("scanning", {"how": "polled", "caveat": "rows may mix updates"}, 100.0)
        for seed, lost, ended, reason in (
            (0, 70, "interrupted", "the cable"), (10, 1, "interrupted", GOES_ON), (20, 2, "complete", "")
        ):  # fmt: skip
            words = replace(block(seed, lost=lost), dropped=lost)
            began = f"2026-03-01T23:59:{30 + seed}Z"
            turn = Attempt(0, Position(None, 0), ended, began, seed, seed + 2.0, [("dwell", words)])
            archive.add_attempt(replace(turn, reason=reason))
    session = read_session(path)
    assert len(session.recording) == 100
    assert session.facts["ended_utc"] == "2026-03-01T23:59:50Z"
    assert session.notes == (
        "3 scans lost on the bus during the turn",
        f"3 scans during the turn left out: {WITHOUT_NEWS}",
        "rows may mix updates",
    )


def test_every_word_and_time_comes_back(tmp_path):
    with begun(tmp_path / "a.session") as archive:
        given = attempt(0)
        archive.add_attempt(given)
    with ArchiveView(tmp_path / "a.session") as view:
        (stored,) = view.attempts()
        for phase in ("before", "dwell"):
            wanted = [part for name, part in given.blocks if name == phase]
            for want, have in zip(wanted, view.blocks(stored, phase), strict=True):
                assert np.array_equal(want.words, have.words)
                assert have.words.dtype == np.uint16
                assert np.array_equal(want.time_s, have.time_s)
                assert have.lost == want.lost
        assert len(view.blocks(stored)) == 3


def test_a_session_has_what_was_archived(tmp_path):
    path = tmp_path / "a.session"
    with begun(path, title="one", note="left side") as archive:
        archive.add_record("registers-before", {"SMPL_PRD": 1}, 100.0)
        archive.add_record("configuration", {"smpl_prd": 1}, 100.0)
        for place in (0, 2):
            archive.add_attempt(attempt(place, status=16))
        archive.add_record("skipped", 1, 100.0)
    session = read_session(path)
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, 180.0]
    assert [dwell.position for dwell in session.dwells] == [0, 1]
    assert session.dwells[0].time_s[0] == pytest.approx(-100.0)
    assert session.gravity_mps2 == 9.81
    assert session.fixture_sigma_deg == 0.1
    assert (session.sensor, session.accel_unit, session.gyro_unit) == ("adis16354", "lsb", "dps")
    assert session.source == str(path)
    assert session.title == "one"
    assert session.facts["registers"] == {"before": {"SMPL_PRD": 1}, "configured": None, "after": None}
    assert session.facts["note"] == "left side"
    assert session.facts["skipped"] == [1]
    assert not session.facts["complete"]
    assert [entry["status"] for entry in session.facts["dwells"]] == [16, 16]
    assert "truth" not in session.facts
    unfinished, skipped, lost, *alarms = session.notes
    assert "2 of 4" in unfinished
    assert "90°" in skipped
    assert lost.startswith("4 scans")
    assert [note.split(":")[0] for note in alarms] == ["dwell 0 (0°)", "dwell 1 (180°)"]  # random words
    words = np.concatenate([block(0).words, block(1, 30).words])
    numbers = (words[:, :3].astype(np.int64) & 0x3FFF) - ((words[:, :3] & 0x2000) != 0) * 0x4000
    assert np.array_equal(session.dwells[0].accel, numbers)
    assert session.dwells[0].gyro.shape == (80, 3)


def test_truth_stands_only_in_simulated_sessions(tmp_path):
    for simulated in (True, False):
        path = tmp_path / f"{simulated}.session"
        with begun(path, simulated=simulated) as archive:
            archive.add_record("truth", {"delta_k": np.float64(0.01), "alpha": np.int64(2)}, 0.0)
            archive.add_attempt(attempt(0))
        facts = read_session(path).facts
        assert facts.get("truth") == ({"delta_k": 0.01, "alpha": 2} if simulated else None)


def test_free_attitudes_come_back_as_infinite_fixture(tmp_path):
    with begun(tmp_path / "a.session", fixture_sigma_deg=math.inf) as archive:
        archive.add_attempt(attempt(0))
    assert read_session(tmp_path / "a.session").free_attitudes


def test_an_interrupted_attempt_is_kept_and_is_no_dwell(tmp_path):
    path = tmp_path / "a.session"
    with begun(path) as archive:
        archive.add_attempt(attempt(0, "interrupted", reason="knock"))
        archive.add_attempt(attempt(0, seed=70))
        archive.add_attempt(attempt(1, "interrupted", reason="knock"))
        assert archive.pending() == [1, 2, 3]
        assert [a.reason for a in archive.attempts()] == ["knock", "", "knock"]
        assert len(archive.blocks(archive.attempts()[0])) == 3
    assert len(read_session(path).dwells) == 1


def test_of_a_repeated_dwell_the_last_counts_and_order_is_that_of_recording(tmp_path):
    path = tmp_path / "a.session"
    with begun(path) as archive:
        for place, seed in ((0, 0), (1, 10), (0, 50)):
            archive.add_attempt(attempt(place, seed=seed))
        assert [a.number for a in archive.dwells()] == [2, 3]
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [90.0, 0.0]


@pytest.mark.parametrize("table", ["meta", "runs", "records", "attempts", "blocks", "moves"])
@pytest.mark.parametrize("verb", ["UPDATE", "DELETE"])
def test_what_was_written_cannot_be_changed(tmp_path, table, verb):
    path = tmp_path / "a.session"
    with begun(path) as archive:
        archive.add_record("truth", 1, 0.0)
        archive.add_attempt(attempt(0, moves=[Move(1.0, 0.0, 1)]))
    connection = sqlite3.connect(path)
    column = connection.execute(f"PRAGMA table_info({table})").fetchall()[-1][1]
    sql = f"DELETE FROM {table}" if verb == "DELETE" else f"UPDATE {table} SET {column} = 0"
    with pytest.raises(sqlite3.IntegrityError, match="append-only"):
        connection.execute(sql)
    connection.close()


def test_one_file_is_left_and_it_says_whose_it_is(tmp_path):
    path = session_file(tmp_path / "a.session")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.session"]
    assert is_archive(path)
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA application_id").fetchone() == (APPLICATION_ID,)
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("delete",)
    connection.close()


def test_a_commit_survives_a_power_cut():
    # EXTRA also syncs the folder once the journal is gone; with less a commit may come undone.
    connection = sqlite3.connect(":memory:")
    from adis_gonio.record.archive import make_durable

    make_durable(connection)
    assert connection.execute("PRAGMA synchronous").fetchone() == (3,)
    connection.close()


def test_an_existing_file_is_never_overwritten(tmp_path):
    path = session_file(tmp_path / "a.session")
    other = tmp_path / "notes.txt"
    other.write_text("mine")
    for victim in (path, other, tmp_path):
        before = victim.read_bytes() if victim.is_file() else None
        with pytest.raises(UsageError, match=r"exists already.*choose another"):
            Archive.create(victim, header())
        assert victim.is_dir() or victim.read_bytes() == before


def test_a_file_that_was_left_empty_can_be_begun_anew(tmp_path):
    path = tmp_path / "a.session"
    path.touch()
    with pytest.raises(SessionError, match="no session yet"):
        Archive.open_existing(path)
    with pytest.raises(SessionError, match="no session yet"):
        read_session(path)
    begun(path).close()


def test_a_place_that_does_not_exist_is_one_line(tmp_path):
    with pytest.raises(SessionError, match=r"cannot be made: No such file or directory"):
        Archive.create(tmp_path / "none" / "a.session", header())
    with pytest.raises(DataError, match="no such file"):
        read_session(tmp_path / "none.session")
    with pytest.raises(SessionError, match="cannot be read"):
        read_session(tmp_path)


@pytest.fixture
def plain_user_folder():
    """A folder that a plain user may read and not write; root becomes that user for the test's time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        yield folder
        folder.chmod(0o700)


@contextmanager
def as_plain_user():
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.skipif(os.name != "posix", reason="permissions of this kind are of POSIX")
def test_a_read_only_file_is_read_and_not_resumed(plain_user_folder):
    path = session_file(plain_user_folder / "a.session")
    path.chmod(0o444)
    plain_user_folder.chmod(0o555)
    with as_plain_user():
        assert len(read_session(path).dwells) == 4
        with pytest.raises(SessionError, match="cannot be written"):
            Archive.open_existing(path).begin_run(0.0, 0.0)


@pytest.mark.parametrize("table", ["meta", "records", "attempts", "moves"])
def test_a_row_that_damage_hides_is_missed(tmp_path, table):
    path = tmp_path / "a.session"
    with begun(path) as archive:
        for place in range(4):
            archive.add_record("skipped", place, 0.0)
            archive.add_attempt(attempt(place, moves=[Move(1.0, 2.0, 1)]))
    connection = sqlite3.connect(path)
    (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
    sql = "SELECT rootpage FROM sqlite_master WHERE name = ?"
    (page,) = connection.execute(sql, (table,)).fetchone()
    connection.close()
    content = bytearray(path.read_bytes())
    start = (page - 1) * page_bytes
    assert content[start] == 0x0D  # a leaf of a table
    content[start + 4] -= 1  # one cell fewer, and the file is a valid one else
    path.write_bytes(content)
    with pytest.raises(DataError, match="is damaged"):
        read_session(path)


@pytest.mark.parametrize("kept", [5000, 20_000, 40_000])
def test_of_a_truncated_file_the_message_says_how_much_is_missing(tmp_path, kept):
    path = session_file(tmp_path / "a.session")
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(DataError, match=f"is truncated, {kept} of {size} bytes"):
        read_session(path)


@pytest.mark.parametrize("kept", [8, 60, 1000, 4096, 5000, 20_000])
def test_a_truncated_file_is_one_line_and_left_as_it_is(tmp_path, kept):
    path = session_file(tmp_path / "a.session")
    content = path.read_bytes()[:kept]
    path.write_bytes(content)
    for use in (read_session, Archive.open_existing):
        with pytest.raises(DataError, match=r"truncated|damaged|no session file") as caught:
            use(path)
        assert "\n" not in str(caught.value)
        assert "a.session" in str(caught.value)
    assert path.read_bytes() == content


def test_a_file_of_full_length_with_a_destroyed_table_of_contents_is_not_called_truncated(tmp_path):
    path = session_file(tmp_path / "a.session")
    content = bytearray(path.read_bytes())
    content[100:4096] = b"\xff" * 3996
    path.write_bytes(content)
    with pytest.raises(DataError, match="is damaged"):
        read_session(path)


def test_a_flipped_bit_in_the_samples_is_found(tmp_path):
    path = session_file(tmp_path / "a.session")
    content = bytearray(path.read_bytes())
    needle = block(20).words.astype("<u2").tobytes()[:64]
    at = content.find(needle)
    assert at > 0
    content[at + 7] ^= 4
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"damaged \(checksum of row 1 of table blocks\)"):
        read_session(path)


def test_random_damage_never_gives_a_traceback_nor_wrong_samples(tmp_path):
    path = session_file(tmp_path / "a.session")
    whole = path.read_bytes()
    good = read_session(path)
    rng = np.random.default_rng(11)
    messages: list[str] = []
    for _ in range(150):
        content = bytearray(whole)
        for at in rng.integers(0, len(whole), 40):
            content[at] ^= int(rng.integers(1, 256))
        path.write_bytes(content)
        try:
            damaged = read_session(path)
        except (DataError, SessionError) as error:
            messages.append(str(error))
            continue
        for a, b in zip(damaged.dwells, good.dwells, strict=True):
            assert np.array_equal(a.accel, b.accel)
    assert len(messages) > 100
    assert not [text for text in messages if "\n" in text or len(text) > 400]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"time_s,position,ax,ay\n0,1,2,3\n" * 50, "no session file"),
        (b"\x1f\x8b" + bytes(999), "no session"),
    ],
)
def test_a_file_of_another_kind_is_one_line(tmp_path, content, words):
    path = tmp_path / "a.session"
    path.write_bytes(content)
    for use in (read_session, Archive.open_existing):
        with pytest.raises(DataError, match=words):
            use(path)
    assert not is_archive(path)


def test_another_programs_database_is_refused(tmp_path):
    path = tmp_path / "a.session"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE meta (key, value)")
    connection.commit()
    connection.close()
    with pytest.raises(DataError, match="SQLite file, but no session file"):
        read_session(path)


def test_a_newer_schema_asks_for_a_newer_program(tmp_path):
    path = session_file(tmp_path / "a.session")
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(DataError, match=r"schema 99.*update adis-gonio"):
        read_session(path)


def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path):
    path = tmp_path / "a.session"
    with begun(path) as archive:
        archive.add_attempt(attempt(0))
        (pages,) = archive._connection.execute("PRAGMA page_count").fetchone()
        archive._connection.execute(f"PRAGMA max_page_count = {pages + 1}")
        big = Attempt(1, plan().positions[1], "complete", utc_now(), 0.0, 1.0, [("dwell", block(1, 9000))])
        with pytest.raises(SessionError, match=r"a\.session: the disk is full.*kept"):
            archive.add_attempt(big)
        archive._connection.execute(f"PRAGMA max_page_count = {1 << 20}")
        archive.add_attempt(attempt(2))
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [0.0, 180.0]


def test_a_failed_attempt_leaves_nothing_behind(tmp_path):
    path = tmp_path / "a.session"
    with begun(path) as archive:
        bad = attempt(0)
        with pytest.raises(SessionError):
            archive.add_attempt(Attempt(**(vars(bad) | {"outcome": "half"})))
        assert archive.attempts() == []
        (blocks,) = archive._connection.execute("SELECT count(*) FROM blocks").fetchone()
        assert blocks == 0


def test_a_session_is_read_while_it_is_written(tmp_path):
    path = tmp_path / "a.session"
    counts: list[int] = []
    done = threading.Event()

    def read() -> None:
        while not done.is_set():
            counts.append(len(read_session(path).dwells))

    with begun(path, plan=plan("tumble", 40)) as archive:
        archive.add_attempt(attempt(0))
        reader = threading.Thread(target=read)
        reader.start()
        for place in range(1, 40):
            archive.add_attempt(Attempt(**(vars(attempt(0)) | {"place": place})))
        done.set()
        reader.join(600)
    assert counts == sorted(counts)
    assert len(read_session(path).dwells) == 40


def test_the_program_that_was_overtaken_stops(tmp_path):
    path = tmp_path / "a.session"
    first = begun(path)
    second = Archive.open_existing(path)
    second.begin_run(0.0, 0.0)
    with pytest.raises(SessionError, match="another program has resumed"):
        first.add_attempt(attempt(0))
    second.add_attempt(attempt(1))
    first.close()
    second.close()
    assert len(read_session(path).dwells) == 1


def test_moves_follow_the_line_that_leads_to_an_attempt(tmp_path):
    def moved(place: int, angle: float, outcome: str = "complete") -> Attempt:
        return attempt(place, outcome, moves=[Move(angle, angle, 1)])

    with begun(tmp_path / "a.session") as archive:
        archive.add_attempt(moved(0, 1.0))
        archive.add_attempt(moved(1, 2.0, "interrupted"))
        archive.begin_run(0.0, 0.0, continues=1)
        archive.add_attempt(moved(1, 3.0))
        archive.add_attempt(moved(2, 4.0))
        archive.begin_run(0.0, 0.0, continues=3)
        archive.add_attempt(moved(2, 5.0))
        assert [move.angle_deg for move in archive.moves_before(5)] == [1.0, 3.0, 5.0]
        assert [move.angle_deg for move in archive.moves_before(4)] == [1.0, 3.0, 4.0]
        assert [move.angle_deg for move in archive.moves_before(2)] == [1.0, 2.0]


def test_a_session_without_a_dwell_says_so(tmp_path):
    begun(tmp_path / "a.session").close()
    with pytest.raises(DataError, match="no dwell is complete yet"):
        read_session(tmp_path / "a.session")


def test_the_wall_clock_is_utc():
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", utc_now())
