"""Files that somebody made on purpose: values with fitting checksums, endless views, bombs."""

from __future__ import annotations

import gzip
import json
import random
import resource
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import adis_gonio
from adis_gonio.base.errors import AdisGonioError, DataError
from adis_gonio.base.output import write_utf8
from adis_gonio.calibrate.calibration_document import calibration_from
from adis_gonio.faces import cli
from adis_gonio.fitting.estimation.spectrum import covariance_of_means
from adis_gonio.record import archive, samples_reader
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import document_of, plan, read_plan
from adis_gonio.record.samples_reader import read_samples_csv
from adis_gonio.record.samples_writer import session_dict, write_samples_csv
from adis_gonio.tracing.trace_calibrations import load_calibration
from record.forging import DEEP, HUGE, exchanged_in, forge, put

LONGEST_S = 60
MEMORY_BYTES = 1_500_000_000
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A session file of four dwells, as the simulator records it."""
    path = tmp_path_factory.mktemp("recorded") / "a.session"
    run_cli("simulate", "--dwell", "1", "--rate", "60", "-o", str(path))
    return path


def run_cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line within bounds of time and memory."""

    def bounded() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))

    command = [sys.executable, "-m", "adis_gonio", *arguments]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=LONGEST_S,
        preexec_fn=bounded,
        check=False,
    )


def refused(path: Path) -> str:
    with pytest.raises(DataError) as caught:
        load_session(path)
    message = str(caught.value)
    assert path.name in message
    assert "\n" not in message
    return message


def use(path: Path, *, fits: bool) -> None:
    """What the commands do with a session file."""
    session = load_session(path)
    if session.turns_from is not None:
        session.turns_from()
    json.dumps(session_dict(session), allow_nan=False)
    write_samples_csv(session, path.with_suffix(".csv"))
    if fits:
        adis_gonio.fit(session).calibration()


def one_line(message: str) -> bool:
    return message.isprintable() and len(message) < 500


def message_of(action: Callable[[], object], what: str) -> str:
    """Message of the error of this package that an action raises; empty if it does its work."""
    try:
        action()
    except AdisGonioError as error:
        return str(error)
    except Exception as error:
        raise AssertionError(f"a traceback: {what}") from error
    return ""


def check_messages(messages: list[str], least: int) -> None:
    """Every refusal is one line; both outcomes happen, or the changes would prove nothing."""
    assert [message for message in messages if not one_line(message)] == []
    refusals = sum(map(bool, messages))
    assert least < refusals < len(messages) - least


def test_a_forged_value_is_refused_in_one_line_or_harmless(recorded, tmp_path):
    path = tmp_path / "forged.session"
    messages = []
    for seed in range(100):
        what = forge(recorded, path, random.Random(seed))
        messages.append(message_of(partial(use, path, fits=seed % 5 == 0), f"seed {seed}, {what}"))
    check_messages(messages, 10)


def read_all(path: Path) -> None:
    """Read every table."""
    with ArchiveView(path) as view:
        for attempt in view.attempts():
            view.blocks(attempt)
            view.moves_before(attempt.number)
        view.records()


@pytest.mark.parametrize(
    ("table", "rowid", "column", "value", "words"),
    [
        ("runs", 1, 3, "null", "clock_offset_s is 'null'"),
        ("runs", 1, 4, 1, "run 1 goes on after attempt 1"),
        ("attempts", 2, 1, 9, "attempt 2 has run 9"),
        ("attempts", 2, 2, 4, "place 4 of a plan with 4"),
        ("attempts", 2, 3, float("inf"), "angle_deg is inf"),
        ("attempts", 2, 11, '["XACCL_OUT", "YACCL_OUT"]', "cannot be scanned together"),
        ("attempts", 2, 12, "adis16350", "samples of 'adis16350'"),
        ("attempts", 2, 13, 301, "gyro_range_dps is 301"),
        ("blocks", 1, 6, b"\xff" * 8, "does not hold"),
        ("meta", 5, 1, "1e400", "too large"),
        ("meta", 5, 1, str(HUGE), "too large"),
        ("meta", 5, 1, "NaN", "too large"),
        ("meta", 5, 1, DEEP, "nested more than 100 deep"),
        ("meta", 5, 1, "-9.8", "gravity_mps2 is -9.8"),
        ("meta", 7, 0, "weight\n", "not known"),
        ("records", 2, 5, '{"filter_m": 7}', "configuration.filter_m is 7"),
        ("records", 2, 5, '{"smpl_prd": 0}', "configuration.smpl_prd is 0"),  # the data sheet forbids it
        ("records", 2, 5, '{"smpl_prd": 256}', "configuration.smpl_prd is 256"),
        ("moves", 1, 5, "[0, 1]", "direction is [0, 1]"),
    ],
)
def test_the_message_names_the_value(recorded, tmp_path, table, rowid, column, value, words):
    path = tmp_path / "forged.session"
    shutil.copyfile(recorded, path)
    put(path, table, rowid, column, value)
    with pytest.raises(DataError) as caught:
        read_all(path)
    assert words in str(caught.value)
    assert one_line(str(caught.value))


def test_times_of_a_block_that_go_back_are_refused(recorded, tmp_path):
    path = tmp_path / "forged.session"
    shutil.copyfile(recorded, path)
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT rowid, time_s FROM blocks WHERE phase = 'dwell' AND scans > 1"
        rowid, times = connection.execute(query).fetchone()
    put(path, "blocks", rowid, 6, times[8:16] + times[:8] + times[16:])
    assert "times of block" in refused(path)


def test_a_view_in_the_place_of_a_table_is_refused_at_once(recorded, tmp_path):
    path = tmp_path / "view.session"
    shutil.copyfile(recorded, path)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("DROP TABLE moves")
        connection.execute("DROP TABLE records")
        connection.execute(f"CREATE VIEW records AS {ENDLESS} SELECT i, 1, '', 0.0, 'x', '{{}}', 0 FROM n")
    done = run_cli("fit", str(path))
    assert done.returncode == 1
    assert "'records' is no table" in done.stderr


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER more AFTER INSERT ON runs BEGIN SELECT zeroblob(1000000000); END",
        "CREATE INDEX more ON meta(hex(randomblob(1000000000)))",
        "CREATE TABLE more (value CHECK (length(hex(zeroblob(500000000))) > 0))",
    ],
)
def test_expressions_of_a_stranger_are_refused(recorded, tmp_path, statement):
    path = tmp_path / "more.session"
    shutil.copyfile(recorded, path)
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        if "INDEX" in statement:
            statement = statement.replace("hex(randomblob(1000000000))", "hex(value)")
        connection.execute(statement)
    assert "'more' is no part of a session file" in refused(path)


def test_a_statement_that_goes_on_is_stopped(recorded, monkeypatch):
    monkeypatch.setattr(archive, "MOST_STEPS", 100_000)
    with ArchiveView(recorded) as view:
        with pytest.raises(DataError, match="within bounds"), archive.translated_errors(recorded):
            view._connection.execute(f"{ENDLESS} SELECT max(i) FROM n").fetchone()
        assert len(view.attempts()) == 4  # another statement has steps of its own


def test_functions_of_a_schema_are_not_trusted(recorded):
    with ArchiveView(recorded) as view:
        assert view._connection.execute("PRAGMA trusted_schema").fetchone() == (0,)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"# note: a\n" * 10_000, "no header within"),
        (b"time_s," * 150_000, "has more than"),
        (b"#" * 1_000_000, "has more than"),
        (b"time_s,ax,ay\n" + b"1" * 1_000_000, "has more than"),
        (b"time_s,ax,ay\n" + b"1" * 65_000 + b"x,0,0\n", "is not a number"),
        (b"time_s" + b" " * 65_000 + b",ax,ay\n", "is not a number"),
        (b"# x: " + b"a" * 60_000 + b"\n", "no header within"),
    ],
)
def test_a_compressed_file_that_grows_without_end_needs_little_memory(tmp_path, content, words):
    path = tmp_path / "bomb.csv.gz"
    with gzip.open(path, "wb", 1) as file:
        for _ in range(200):
            file.write(content)
    done = run_cli("fit", str(path))
    assert (done.returncode, words in done.stderr) == (1, True), done.stderr[-500:]


def test_equal_rows_without_end_in_a_compressed_file_are_refused(tmp_path):
    path = tmp_path / "equal.csv.gz"
    row = b"0.%060d,1,2\n" % 0  # long, so that fewer rows reach the limit, which counts bytes
    path.write_bytes(gzip.compress(b"time_s,ax,ay\n") + gzip.compress(row * 100_000) * 8)
    assert "more than 200 times its size" in refused(path)


def test_a_header_of_ten_thousand_columns_is_refused(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text("time_s,ax,ay" + ",angl" * 10_000 + "\n0,1,2\n")
    assert "10003 columns" in refused(path)


def test_changed_bytes_of_a_csv_are_refused_in_one_line_or_harmless(tmp_path):
    lines = [
        "# sensor: adis16354",
        "# fixture_sigma_deg: 0.1",
        "time_s,position,angle_deg,approach,ax,ay,use",
    ]
    lines += [f"{k / 10},{k // 5},{k // 5 * 90},+1,{2000 - k},{k},fit" for k in range(20)]
    text, path = "\n".join(lines), tmp_path / "changed.csv"
    strange = [
        "",
        "nan",
        "1e400",
        str(HUGE),
        '"',
        "\x00",
        "-",
        ",,,",
        "'",
        "é",
        "=1",
        "١",
        "1_0",
        "#",
        "\r",
    ]
    messages = []
    for seed in range(300):
        rng = random.Random(seed)
        at = rng.randrange(len(text))
        path.write_text(text[:at] + rng.choice(strange) + text[at + rng.randrange(12) :], "utf-8")
        messages.append(
            message_of(
                lambda: write_samples_csv(read_samples_csv(path), tmp_path / "o.csv"), f"seed {seed}"
            )
        )
    check_messages(messages, 30)


def use_calibration(path: Path) -> None:
    json.dumps(load_calibration(path).as_dict(), allow_nan=False)


@pytest.mark.parametrize("kind", ["calibration", "plan"])
def test_a_changed_value_of_a_document_is_refused_in_one_line_or_harmless(recorded, tmp_path, kind):
    document = document_of(plan("mmpm")) | {"name": "mine"}
    if kind == "calibration":
        document = adis_gonio.fit(load_session(recorded)).calibration().as_dict()
    path = tmp_path / "changed.json"
    messages = []
    for seed in range(300):
        path.write_text(json.dumps(exchanged_in(document, random.Random(seed))))
        read = read_plan if kind == "plan" else use_calibration
        messages.append(message_of(partial(read, path), f"seed {seed}"))
    check_messages(messages, 5)


@pytest.mark.parametrize(
    "text", [DEEP, '{"a":' * 5000, "[1e400]", f"[{HUGE}]", '{"schema": ' + "1" * 5000 + "}"]
)
@pytest.mark.parametrize("read", [load_calibration, read_plan])
def test_json_beyond_bounds_is_refused_in_one_line(tmp_path, read, text):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        read(path)
    assert one_line(str(caught.value))


def test_a_huge_integer_in_a_calibration_is_one_line_of_export(recorded, tmp_path):
    document = adis_gonio.fit(load_session(recorded)).calibration().as_dict()
    document["offsets_lsb"] = [HUGE, 0, 0]
    path = tmp_path / "huge.json"
    path.write_text(json.dumps(document))
    done = run_cli("export", str(path), "-o", str(tmp_path / "x.h"))
    assert done.returncode == 1
    assert done.stderr.count("\n") <= 1
    assert "huge.json" in done.stderr


def test_a_trigger_with_a_name_of_sqlites_own_is_refused(recorded, tmp_path):
    path = tmp_path / "hidden.session"
    shutil.copyfile(recorded, path)
    sql = "CREATE TRIGGER sqlite_x AFTER INSERT ON runs BEGIN SELECT zeroblob(1000000000); END"
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("INSERT INTO sqlite_master VALUES ('trigger', 'sqlite_x', 'runs', 0, ?)", (sql,))
    assert "'sqlite_x' is no part of a session file" in refused(path)


@pytest.mark.parametrize("column", [4, 5])
def test_a_row_of_megabytes_is_refused(recorded, tmp_path, column):
    path = tmp_path / "long.session"
    shutil.copyfile(recorded, path)
    put(path, "records", 2, column, json.dumps("x" * (archive.LONGEST_ROW_BYTES + 1)))
    assert "within bounds" in refused(path)


def test_rows_of_many_characters_together_are_refused(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "MOST_TEXT", 2000)
    path = tmp_path / "long.session"
    shutil.copyfile(recorded, path)
    assert "holds more than 2000 characters" in refused(path)


@pytest.mark.parametrize("sigma", ["1e-300", "5e-324"])
def test_an_uncertainty_of_angles_whose_square_is_nothing_is_refused(recorded, tmp_path, sigma):
    path = tmp_path / "fixture.session"
    shutil.copyfile(recorded, path)
    put(path, "meta", 6, 1, sigma)
    assert "fixture_sigma_deg is" in refused(path)
    table = tmp_path / "fixture.csv"
    table.write_text(f"# fixture_sigma_deg: {sigma}\ntime_s,position,ax,ay\n0,0,1,2\n")
    assert "fixture_sigma_deg" in refused(table)


def test_times_that_no_model_can_weigh_are_one_line(recorded, tmp_path):
    path = tmp_path / "times.session"
    shutil.copyfile(recorded, path)
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT rowid, scans FROM blocks WHERE phase = 'dwell' AND scans > 0"
        found = connection.execute(query).fetchall()
    for rowid, scans in found:
        put(path, "blocks", rowid, 6, (np.arange(scans) * 1.4e8).astype("<f8").tobytes())
    done = run_cli("fit", str(path))
    assert (done.returncode, done.stderr.count("Traceback")) in ((0, 0), (1, 0)), done.stderr[-500:]


def test_a_matrix_without_an_inverse_is_told_with_the_file(recorded, monkeypatch, capsys):
    def fail(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(cli.app, "main", fail)
    assert cli.main(["fit", str(recorded)]) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(f"adis-gonio: {recorded}: no fit is possible")


def test_more_positions_than_a_fit_can_hold_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(samples_reader, "MOST_DWELLS", 3)
    path = tmp_path / "many.csv"
    path.write_text("time_s,position,ax,ay\n" + "".join(f"{k},{k},1,2\n" for k in range(4)))
    assert "row 5: more than 3 positions" in refused(path)


def test_a_lone_surrogate_is_written_as_a_question_mark(tmp_path):
    path = tmp_path / "text"
    assert write_utf8(path, "a\udcffé\ud800") == 5
    assert path.read_bytes() == "a?é?".encode()


def test_a_report_of_a_file_whose_name_is_no_text(recorded, tmp_path):
    path = tmp_path / "bad\udcff.session"
    shutil.copyfile(recorded, path)
    done = run_cli("report", str(path), "-o", str(tmp_path / "page.html"), "--time-limit", "1")
    assert done.returncode == 0, done.stderr[-500:]
    assert (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("gain", [0, 1e-320, -1e14])
def test_a_gain_of_nothing_is_no_calibration(recorded, gain):
    document = adis_gonio.fit(load_session(recorded)).calibration().as_dict()
    document["parameters"]["scale_x"]["value"] = gain
    with pytest.raises(DataError, match=r"scale_x is .* no gain"):
        calibration_from(document)


def test_dwells_shorter_than_a_nanosecond_are_as_dwells_without_times():
    begin = np.arange(4) * 1e-300
    assert np.isfinite(covariance_of_means(begin, begin + 1e-300)).all()
