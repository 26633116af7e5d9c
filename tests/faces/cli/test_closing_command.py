"""`calibrate --trace` as a shell user meets it."""

from __future__ import annotations

import io
import json
import re

import pytest

from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.trace_commands import loop_line
from adis_gonio.record.loading import load_session

URL = "sim:?seed=3&bias_instability_mg=0&fixture_sigma_deg=0.002&effects=quadratic:k2_x=3"
SHORT = ["calibrate", URL, "--plan", "four-position", "--dwell", "2", "--trace"]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.session"


def test_json_is_one_document_with_the_trace_and_every_round(capsys, path):
    assert main([*SHORT, "--auto", "--max-extra", "3", "--json", "-o", str(path)]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document["complete"]
    assert set(document["trace"]) >= {"adequate", "found", "next", "measurements"}
    first, *_, last = document["rounds"]
    assert first["planned"] == 4
    assert first["positions"] >= 1
    assert last["positions"] == 0
    assert last["ended"]
    assert len(load_session(path).dwells) == 4 + sum(entry["positions"] for entry in document["rounds"])
    assert "tracing 4 dwells" in err


def test_the_screen_ends_with_the_reason_for_the_end(capsys, path):
    assert main([*SHORT, "--auto", "--max-extra", "2", "-o", str(path)]) == 0
    out, err = capsys.readouterr()
    assert "Measure at " in err
    assert "With 4 dwells: " in err
    heading, ended = out[out.index("Closing the loop") :].splitlines()[:2]
    assert heading == "Closing the loop"
    assert ended.strip() == load_session(path).facts["advised"][-1]["ended"]
    assert "Error before and after" in out
    assert "What to measure next" in out


def test_an_operator_is_asked_and_may_end_it(capsys, path, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n\n\nn\n"))
    assert main([*SHORT, "-o", str(path)]) == 0
    out, err = capsys.readouterr()
    assert re.search(r"Go on with .*\(y yes, n no", " ".join(err.split()))
    assert len(load_session(path).dwells) == 4
    assert "further positions were declined" in out
    # Asked again when the session is resumed with --trace; without it there is nothing to do.
    assert main(["calibrate", URL, "--resume", "-o", str(path)]) == 0
    assert "nothing is left to do" in capsys.readouterr().err
    resumed = ["calibrate", URL, "--resume", "--trace", "--auto", "--max-extra", "1", "-o", str(path)]
    assert main(resumed) == 0
    assert len(load_session(path).dwells) == 5


def test_a_limit_without_a_loop_is_wrong_use(capsys, path):
    assert main(["calibrate", URL, "--max-extra", "3", "-o", str(path)]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "--trace" in err
    assert not path.exists()


def test_where_the_model_stands_is_told_in_a_line():
    summary = {"dwells": 9, "adequate": True, "tested": True, "found": ["bias"]}
    assert loop_line(summary) == "With 9 dwells: the model is adequate; found: bias"
    untested = loop_line({**summary, "tested": False, "found": []})
    assert untested == "With 9 dwells: no readings remain to test the model; found: –"
