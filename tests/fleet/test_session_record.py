"""A record holds the numbers of the one answer, and a broken file is a record too."""

import hashlib
import json
import math
import sqlite3

import pytest

import adis_gonio
from adis_gonio import __version__
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.answer import Answer
from adis_gonio.fleet.session_record import COLUMNS, Options, SessionRecord, record_of, work
from adis_gonio.record.loading import load_session
from adis_gonio.record.provenance import digest_of_file
from adis_gonio.record.samples_writer import write_samples_csv
from adis_gonio.tracing.traced_answer import answer_with_trace
from fleet.recorded import recorded
from fleet.sessions import write_fleet


@pytest.fixture
def archive(tmp_path, monkeypatch):
    return recorded(tmp_path / "one.session", monkeypatch)


def test_facts_are_those_of_the_archive(archive):
    record = record_of(archive)
    assert record.status == "ok"
    assert (record.serial, record.operator, record.stage) == ("A7", "Ada", "rotary 3")
    assert (record.sensor, record.plan, record.dwells) == ("adis16354", "four-position", 4)
    assert record.when == "2024-03-01T09:00:00+00:00"
    assert record.sha256 == hashlib.sha256(archive.read_bytes()).hexdigest()
    assert record.measuring_s == pytest.approx(4 * 0.5, rel=0.01)
    assert 15 < record.temperature_c < 35


def test_numbers_are_those_that_fit_shows(archive):
    record = record_of(archive)
    shown = Answer.of(adis_gonio.fit(archive), own=False).as_dict()
    assert record.method == shown["recommended"]["method"]
    document = record.as_dict()["values"]
    for name in ("delta_k", "delta_phi", "bias_x", "bias_y", "scale_x", "scale_y"):
        assert document[name] == shown["parameters"][name]
    assert document["angle"] == shown["answer"]["angle"]
    assert record.angle_max_deg == shown["scores"][record.method]["angle_max_deg"]
    assert not record.traced
    assert record.adequate is None


def test_what_a_csv_lacks_is_none_and_its_data_are_the_archives(archive, tmp_path):
    csv = tmp_path / "one.csv"
    write_samples_csv(load_session(archive), csv)
    record = record_of(csv)
    assert (record.when, record.plan, record.simulated) == (None, None, None)
    assert record.data_sha256 == record_of(archive).data_sha256
    assert record.sha256 != record_of(archive).sha256


def test_json_and_back_is_the_same_record(archive):
    record = record_of(archive)
    text = json.dumps(record.as_dict(), allow_nan=False)
    assert SessionRecord.from_dict(json.loads(text)).as_dict() == record.as_dict()


def test_rows_have_the_columns_of_the_table_and_their_names_differ_without_capitals(archive, tmp_path):
    row = record_of(archive).row()
    broken = record_of(tmp_path / "none").row()
    assert set(row) == set(broken) == set(COLUMNS)
    assert len({name.lower() for name in row}) == len(row)
    for name, value in row.items():
        kind = list if COLUMNS[name][0] in ("names", "numbers") else str | int | float
        assert value is None or isinstance(value, kind)
    assert row["delta_phi_u95"] == pytest.approx(row["delta_phi_k"] * row["delta_phi_u"])


def test_a_bias_in_counts_is_not_in_the_column_of_a_bias_in_mg():
    values = {"bias_x": Value(650.0, 2.0, "counts"), "bias_y": Value(3.0, 0.1, "mg")}
    row = SessionRecord("a.csv", values=values).row()
    assert (row["bias_x"], row["bias_x_u"]) == (None, None)
    assert (row["bias_y"], row["bias_y_u"]) == (3.0, 0.1)


def _truncated(archive, folder):
    path = folder / "cut.session"
    path.write_bytes(archive.read_bytes()[:-9000])
    return path


def _foreign_database(archive, folder):
    path = folder / "other.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE t (x)")
    connection.close()
    return path


def _text(archive, folder):
    path = folder / "notes.csv"
    path.write_text("a list\nof what to buy\n", "utf-8")
    return path


def _flat(archive, folder):
    path = folder / "flat.csv"
    rows = "".join(f"{k / 100},{p},0,0,0\n" for k, p in enumerate([0] * 5 + [1] * 5))
    path.write_text("time_s,position,angle_deg,ax,ay\n" + rows, "utf-8")
    return path


@pytest.mark.parametrize("make", [_truncated, _foreign_database, _text, _flat, lambda a, f: f])
def test_a_broken_file_is_a_record_with_its_reason_in_one_line(archive, tmp_path, make):
    path = make(archive, tmp_path)
    record = record_of(path)
    assert record.status == "failed"
    assert record.reason
    assert "\n" not in record.reason
    assert path.name in record.reason or record.dwells
    assert record.values == {}


def test_an_error_that_nobody_thought_of_is_a_reason_too(archive, monkeypatch):
    def fails(*_, **__):
        raise ZeroDivisionError("of\nsomething")

    monkeypatch.setattr("adis_gonio.fitting.methods.fit", fails)
    record = record_of(archive)
    assert record.status == "failed"
    assert "ZeroDivisionError: of something" in record.reason
    assert record.serial == "A7"


def test_a_trace_says_which_effects_and_the_answer_is_that_of_the_traced_model(tmp_path, monkeypatch):
    path = recorded(tmp_path / "biased.session", monkeypatch, url="sim:?seed=3", name="tumble")
    record = record_of(path, trace=True)
    trace = adis_gonio.trace(path)
    assert record.traced
    assert [e.effect for e in record.effects] == ["bias"]
    assert record.adequate == trace.adequate
    assert [e.as_dict() for e in record.effects] == [
        {key: found[key] for key in ("effect", "axes", "p_value", "parameters")}
        for found in trace.as_dict()["found"]
    ]
    answer = answer_with_trace(adis_gonio.fit(path), trace)
    assert record.model_effects == answer.recommended.effects
    assert record.values["delta_k"].as_dict() == answer.values["delta_k"].as_dict()
    assert math.isfinite(record.values["delta_phi"].U)


def test_a_traced_session_without_a_bias_states_that_it_is_zero(tmp_path, monkeypatch):
    """A session after the biases were compensated in the chip; its ΔK and Δφ belong in a history."""
    url = "sim:?seed=3&bias_x_mg=0&bias_y_mg=0&effects=quadratic:k2_x=8"
    path = recorded(tmp_path / "written.session", monkeypatch, url=url, name="tumble")
    record = record_of(path, trace=True)
    assert record.model_effects == ("quadratic",)
    fitted = adis_gonio.fit(path).parameters
    for name in ("bias_x", "bias_y"):
        assert (record.values[name].value, record.values[name].u) == (0.0, fitted[name].u)


def test_a_session_is_read_once_for_record_and_evidence(tmp_path, monkeypatch):
    (path,) = write_fleet(tmp_path / "fleet", 1, seed=9)
    read = []
    monkeypatch.setattr(
        "adis_gonio.record.loading.load_session", lambda *a: read.append(a) or load_session(*a)
    )
    record = work(path, digest_of_file(path), Options(trace=False, evidence=True).as_dict(), __version__)
    assert record.status == "ok"
    assert record.evidence is not None
    assert len(read) == 1
