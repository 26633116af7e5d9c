"""Every command writes in every character set: what it lacks is said in readable letters."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence

import pytest

from adis_gonio.faces.cli import COMMANDS, main
from adis_gonio.faces.cli.terminal import ASCII_FORMS, ascii_form

SETS = {
    "cp1252": {"PYTHONIOENCODING": "cp1252"},
    "koi8-r": {"PYTHONIOENCODING": "koi8-r"},
}
"""A set of Windows and one that lacks most of the letters; neither has Greek ones."""
C_LOCALE = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}


def written(
    variables: dict[str, str],
    *arguments: str,
    program: Sequence[str] = ("-m", "adis_gonio"),
) -> tuple[str, str, int]:
    """Standard output and error, as bytes of the character set decode, and the status."""
    plain = {k: v for k, v in os.environ.items() if k not in ("PYTHONIOENCODING", "PYTHONUTF8", "LC_ALL")}
    done = subprocess.run(
        [sys.executable, *program, *arguments],
        env={**plain, **variables}, capture_output=True, timeout=600, check=False,
    )  # fmt: skip
    encoding = variables.get("PYTHONIOENCODING", "utf-8")
    return done.stdout.decode(encoding), done.stderr.decode(encoding), done.returncode


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("sets") / "two.session"
    title = "Sch\u00f6n \u2014 [usb] \U0001f600"
    assert (
        main(["simulate", "--plan", "four-position", "--dwell", "1", "--title", title, "-o", str(path)])
        == 0
    )
    return path


EACH = """
import json, sys
from adis_gonio.faces.cli import run
for words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    status = 0
    try:
        run()
    except SystemExit as end:
        status = end.code
    for stream in (sys.stdout, sys.stderr):
        print("-----", status, file=stream, flush=True)
"""
"""The program as often as its argument, a list in JSON, has calls: most take less time than its start."""

CALLS = {
    "devices": "simulated ADIS16354",
    "registers sim:?seed=1": "reads -1 g",
    "selftest sim:?seed=1": "supply",
    "stream sim:?seed=1 --seconds 1": "XACCL/mg",
    "simulate --list-effects": "bias_drift",
    "simulate --list-settings": "delta_k",
    "fit SESSION": "dphi",
    "bringup sim:?seed=1": "No fault was found",
    "calibrate sim:?seed=1 --auto --dwell 1 -o OUT": "dphi",
    "--help": "Compute dK, dphi and the other parameters",
    "fit SESSION --json": "{",
}
"""Calls and a part of their output."""


def written_each(variables: dict[str, str], calls: Sequence[Sequence[str]]) -> list[tuple[str, str, int]]:
    """Standard output and error and the status of each call."""
    out, err, status = written(variables, json.dumps(calls), program=("-c", EACH))
    assert status == 0, err
    ended = [int(code) for code in re.findall(r"^----- (\d+)$", out, re.M)]
    shown, told = (re.split(r"^----- \d+\n", text, flags=re.M)[:-1] for text in (out, err))
    return list(zip(shown, told, ended, strict=True))


@pytest.fixture(scope="module", params=SETS)
def shown(request, session, tmp_path_factory):
    """Each of `CALLS` in a character set."""
    places = {"SESSION": str(session), "OUT": str(tmp_path_factory.mktemp("sets") / "out.session")}
    calls = [[places.get(word, word) for word in call.split()] for call in CALLS]
    return dict(zip(CALLS, written_each(SETS[request.param], calls), strict=True))


@pytest.mark.parametrize("name", SETS)
def test_the_help_of_every_command_comes_in_every_set(name):
    each = written_each(SETS[name], [[command, "--help"] for command in COMMANDS])
    assert [(err, status) for _, err, status in each] == [("", 0)] * len(COMMANDS)
    assert re.findall(r"Usage: adis-gonio (\S+)", "".join(out for out, _, _ in each)) == [*COMMANDS]


@pytest.mark.parametrize("call", CALLS)
def test_what_commands_show_comes_in_every_set(call, shown):
    out, err, status = shown[call]
    assert "Traceback" not in err
    assert "UnicodeEncodeError" not in err
    assert "\\u" not in out + err or "--json" in call
    assert status == 0
    assert CALLS[call] in out


def test_json_holds_every_letter_whatever_the_set(shown):
    out, _, _ = shown["fit SESSION --json"]
    json.loads(out)


def test_in_the_c_locale_a_command_and_its_help_come_whole(session):
    for call in (["--help"], ["fit", str(session)]):
        out, err, status = written(C_LOCALE, *call)
        assert status == 0
        assert all(line.startswith("fitting ") for line in err.splitlines()), "its stages on a slow machine"
        assert re.search("dphi|Δφ", out)


def test_a_title_survives_in_the_file_and_gives_way_on_the_screen(session):
    out, _, _ = written(SETS["koi8-r"], "fit", str(session))
    assert "Schon - [usb] ?: 4 dwells" in out
    out, _, _ = written(SETS["cp1252"], "fit", str(session))
    assert "Sch\u00f6n \u2014 [usb] ?: 4 dwells" in out


def test_an_error_is_one_line_in_every_set(tmp_path):
    _, err, status = written(SETS["koi8-r"], "registers", "sim:?seed=1", "XACCL_OFF=5\u00b5")
    assert status == 2
    assert err.count("\n") == 1
    assert "XACCL_OFF=5u" in err


@pytest.mark.parametrize("name", SETS)
def test_an_export_to_standard_output_is_the_file_in_utf8(name, session):
    done = subprocess.run(
        [sys.executable, "-m", "adis_gonio", "export", str(session), "--format", "json"],
        env={**os.environ, **SETS[name]}, capture_output=True, timeout=600, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert json.loads(done.stdout.decode("utf-8"))["session"]["title"].startswith("Sch\u00f6n")


def test_files_are_utf8_whatever_the_set(tmp_path):
    path = tmp_path / "a.csv"
    _, _, status = written(
        {**C_LOCALE, "LC_ALL": "C.UTF-8", **SETS["koi8-r"]},
        "simulate", "--plan", "two-position", "--dwell", "0.5", "--title", "\u0394\u03c6", "-o", str(path),
    )  # fmt: skip
    assert status == 0
    assert "\u0394\u03c6" in path.read_bytes().decode("utf-8")


def test_what_stands_for_a_letter_is_ascii_and_ends_no_string_of_json():
    for letter, text in ASCII_FORMS.items():
        assert text.isascii(), letter
        assert not set('"\\\n') & set(text), letter
    assert ascii_form("\u00e9") == "e"
    assert ascii_form("\u4e2d") == "?"


def test_a_message_never_steers_the_terminal(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("time_s,ax,ay\n0,\x1b[31m1\u202e,2\n", encoding="utf-8")
    assert main(["fit", str(path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert "a.csv, row 2" in line


def test_a_long_cell_leaves_a_message_its_beginning_and_its_end(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text(f"time_s,ax,ay\n0,{'1' * 5000},2\n", encoding="utf-8")
    assert main(["fit", str(path)]) == 1
    line = capsys.readouterr().err
    assert len(line) < 700
    assert line.startswith("adis-gonio: a.csv, row 2")
    assert line.endswith("leave such rows out\n")
