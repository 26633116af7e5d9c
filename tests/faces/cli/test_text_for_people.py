"""Text for people: one minus sign, lines that fit the screen, and lists that follow from their tables."""

from __future__ import annotations

import io
import re
import sys
from dataclasses import fields

import pytest

import adis_gonio
from adis_gonio.base.numbers import format_fixed, format_uncertain, signed
from adis_gonio.base.uncertainty import Value
from adis_gonio.device.sensor import REGISTERS
from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.show import say
from adis_gonio.fitting.methods import METHOD_TABLE
from adis_gonio.handover.formats import FORMATS
from adis_gonio.sim import WorldSettings
from adis_gonio.sim.settings import described_settings

SIM = "sim:?seed=1"
MIXED = "the words of a row may come from neighbouring updates, " * 3 + "since polling was slow"
COMMANDS = [
    ["fit", "SESSION"],
    ["fit", "SESSION", "--all"],
    ["trace", "SESSION"],
    ["registers"],
    ["registers", SIM],
    ["write", "SESSION", f"{SIM}&day=202002290000&variant=adis16354", "--dry-run", "--dwell", "0.5"],
    ["simulate", "--list-settings"],
    ["simulate", "--list-effects"],
    ["export", "--help"],
    ["history", "17", "FOLDER"],
    ["plan", "--plan", "tumble", "--fixture", "0.02"],
]


def test_a_number_that_rounds_to_zero_has_no_minus_sign():
    assert format_fixed(-0.04, 1) == "0.0"
    assert signed(-0.04, 1) == "+0.0"
    assert signed(-0.06, 1) == "−0.1"


class Terminal(io.StringIO):
    """An error output that says it is a terminal."""

    def isatty(self):
        return True


@pytest.mark.parametrize("screen", [io.StringIO, Terminal])
def test_an_error_is_folded_on_a_terminal_and_one_line_elsewhere(monkeypatch, screen):
    monkeypatch.setattr("sys.stderr", screen())
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    assert main(["simulate", "--plan", "circle", "-o", "never-written.session"]) == 2
    lines = sys.stderr.getvalue().splitlines()
    assert " ".join(" ".join(lines).split()) == (
        "adis-gonio: no plan is called 'circle'; known: two-position, four-position, mmpm, tumble, poses,"
        " free-turn, gyro-turns, or a plan file (.json)"
    )
    assert (len(lines) == 1) == (screen is io.StringIO)
    assert screen is io.StringIO or max(map(len, lines)) < 80


@pytest.mark.parametrize("text", ["written: {}, 3 kB", "{}: renamed to {}", "{}"])
def test_a_path_that_is_wider_than_the_terminal_stays_in_one_piece(monkeypatch, text):
    monkeypatch.setattr("sys.stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    path = "/some-folder" * 8
    say(text.format(path, path))
    assert sys.stderr.getvalue().split() == text.format(path, path).split()


def test_warnings_of_a_stream_are_folded_on_a_terminal(monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("adis_gonio.device.sensor.scanning.PolledScans.caveat", MIXED)
    assert main(["stream", SIM, "--poll", "--seconds", "0.1"]) == 0
    text = sys.stderr.getvalue()
    assert MIXED in " ".join(text.split())
    assert max(map(len, text.splitlines())) < 80


def test_conclusions_on_the_paper_are_folded_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("adis_gonio.faces.cli.show.Console.is_terminal", True)
    monkeypatch.setattr("adis_gonio.handover.paper_study.reproduce", lambda *_: None)
    monkeypatch.setattr("adis_gonio.handover.paper_study.verdicts", lambda _: [MIXED, "Short."])
    assert main(["paper"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(lines) == f"{MIXED} Short."
    assert max(map(len, lines)) < 80


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("text") / "a.session"
    words = ["simulate", "--plan", "tumble", "--dwell", "0.5", "--seed", "1", "--serial", "17"]
    assert main([*words, "--date", "2020-02-29", "-o", str(path)]) == 0
    return path


def said(capsys, session, words):
    capsys.readouterr()
    places = {"SESSION": str(session), "FOLDER": str(session.parent)}
    assert main([places.get(word, word) for word in words]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_numbers_have_one_minus_sign_and_lines_fit_80_columns(words, session, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = said(capsys, session, words)
    assert not re.findall(r"(?:^|[\s(])-\d", text)
    assert max(map(len, text.splitlines())) <= 80


def test_a_date_of_a_simulated_session_is_in_its_history(session, capsys):
    assert "2020-02-29" in said(capsys, session, ["history", "17", "FOLDER"])


def test_the_truth_has_the_digits_of_its_estimate(session, tmp_path, capsys):
    path = tmp_path / "b.session"
    words = ["calibrate", SIM, "--auto", "--plan", "four-position", "--dwell", "0.5", "-o", str(path)]
    rows = [line.split() for line in said(capsys, session, words).splitlines()]
    head = next(row for row in rows if row[:3] == ["parameter", "unit", "truth"])
    table = [row for row in rows[rows.index(head) + 1 :] if row and row[-1].replace("> ", "")][:7]
    for row in table:
        truth, value = row[-7 if row[-2] == ">" else -6], row[-6 if row[-2] == ">" else -5]
        assert len(truth.partition(".")[2]) == len(value.partition(".")[2]), row


def test_lists_in_the_help_follow_from_their_tables(session, capsys):
    helped = said(capsys, session, ["fit", "--help"])
    assert all(name in helped for name in METHOD_TABLE)
    helped = said(capsys, session, ["export", "--help"])
    rows = [line.split(maxsplit=1) for line in helped.splitlines() if line.strip()]
    rest = {row[0]: row[-1] for row in reversed(rows)}
    assert all(one.endings[0] in rest[one.name] and one.meaning in rest[one.name] for one in FORMATS)
    assert all(one.meaning for one in FORMATS)


def test_the_evidence_of_each_register_is_explained(session, capsys):
    text = said(capsys, session, ["registers"])
    assert {f"evidence {row.confidence}:" for row in REGISTERS} <= set(re.findall(r"evidence .:", text))


def test_every_setting_is_described_once():
    listed = [name for names, text in described_settings() if text for name in names.split(", ")]
    assert len(set(listed) - {"…"}) == len([name for name in listed if name != "…"])
    axes = re.compile(r"_(x|y|z|[xyz]{2})(?=_|$)")
    known = {axes.sub("_#", name) for name in listed}
    missing = {f.name for f in fields(WorldSettings) if axes.sub("_#", f.name) not in known}
    assert not missing


def test_a_value_is_shown_with_its_expanded_uncertainty():
    value = Value(-1.0, 0.5, "deg", 4.0)
    assert str(value) == format_uncertain(-1.0, value.U, "deg")
    assert pytest.approx(2.776 * 0.5, rel=1e-3) == value.U  # Student's t for 95 % at 4 degrees of freedom


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [(1.25, 1, "+1.2"), (-1.25, 2, "−1.25"), (30.0, None, "+30"), (-0.5, None, "−0.5"), (None, 1, "–")],
)
def test_a_signed_number_has_a_plus_or_the_minus_sign(value, decimals, text):
    assert signed(value, decimals) == text


def test_dir_of_the_package_has_its_public_names():
    assert set(dir(adis_gonio)) == set(adis_gonio.__all__)


def test_small_numbers_have_one_form_and_zero_has_no_sign():
    assert signed(-6.9e-7, digits=2) == "−6.9·10⁻⁷"
    assert signed(0.05, digits=2) == "+0.05"
    assert format_fixed(1.2e-11, 12) == "1.2·10⁻¹¹"
    assert format_uncertain(-2.7e-7, 1.1e-4) == "0.00000\u00a0±\u00a00.00011"
    assert format_uncertain(1.2345678, 0.0, "mg").replace("\u00a0", " ") == "1.235 mg"
