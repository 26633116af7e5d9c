"""`adis-gonio bringup`: page and JSON, questions, exit status."""

import html
import json
import re
import sys

import pytest

from adis_gonio.bench.bringup import STEPS
from adis_gonio.bench.bringup.bringup_step import QUESTIONS
from adis_gonio.faces.cli import main
from fakes.boards import FAULTY, SOUND

SIM = "sim:?seed=1"


@pytest.fixture
def board(monkeypatch):
    """Put a board behind the URL `board:`."""

    def put(made, seed=1):
        bus = made.open(seed)
        monkeypatch.setattr("adis_gonio.device.bus.open_bus", lambda url: bus)
        return bus

    return put


def test_page_and_json_are_written_beside_each_other_and_say_the_same(tmp_path, capsys, board):
    board(SOUND)
    out = tmp_path / "first.html"
    assert main(["bringup", "board:", "--allow-writes", "--flash", "--yes", "-o", str(out), "--json"]) == 0
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert json.loads((tmp_path / "first.json").read_text()) == document
    assert document["format"] == "adis-gonio bringup 1"
    assert document["sound"] is True
    assert [step["name"] for step in document["steps"]] == [step.name for step in STEPS]
    assert [answer["name"] for answer in document["answers"]] == [question.name for question in QUESTIONS]
    assert document["undone"]["verified"] is True
    for answer in document["answers"]:
        assert answer["outcome"] in ("confirms", "contradicts", "measured", "open", "not measured")
        assert answer["source"]
        assert answer["confidence"] in "ABCD?"
        for figure in answer["measured"]:
            assert set(figure) == {"name", "value", "u", "unit", "expected"}
    page = out.read_text()
    assert not re.search(r'(src|href)="(?!#)|url\((?!#)|@import', page), "a page that loads nothing"
    shown = html.unescape(page)
    for question in QUESTIONS:
        assert question.text in shown
    assert document["headline"] in shown


def test_every_line_says_a_steps_verdict(capsys, board):
    made, step, word = FAULTY["supply at 4.7 V"]
    board(made)
    assert main(["bringup", "board:"]) == 1
    lines = capsys.readouterr().out.splitlines()
    line = next(line for line in lines if line.split()[1] == step)
    assert line.startswith("fault")
    assert word in line
    assert lines[-1].startswith("Fault: supply;")


def test_a_difference_from_the_table_is_no_failure_of_the_board(board, capsys):
    board(FAULTY["offset LSB twice as large"][0])
    assert main(["bringup", "board:", "--writes", "--yes"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("No fault was found; differs from the table: offset;")


def test_a_ctrl_c_keeps_what_was_found(tmp_path, board, capsys):
    bus = board(SOUND)
    exchange = bus._exchange

    def interrupted(frames):
        if bus.now_s() > 2 and any(frame >> 8 == 0xA0 for frame in frames):  # XACCL_OFF is written
            bus._exchange = exchange
            raise KeyboardInterrupt
        return exchange(frames)

    bus._exchange = interrupted
    out = tmp_path / "b.html"
    assert main(["bringup", "board:", "--allow-writes", "--yes", "-o", str(out)]) == 130
    document = json.loads((tmp_path / "b.json").read_text())
    assert document["stopped"] is True
    assert document["undone"]["verified"] is True
    verdicts = [step["verdict"] for step in document["steps"]]
    assert verdicts[:8] == ["ok"] * 8
    assert set(verdicts[8:]) == {"not measured"}
    assert bus.chip.memory["XACCL_OFF"] == 0
    assert out.stat().st_size > 5000


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--flash"], "--flash: goes with --allow-writes"),
        (["--yes"], "--yes: goes with --allow-writes"),
        (["--allow-writes"], "no terminal: add --yes"),
        (["-o", "a.pdf"], "name it a.html"),
        (["--sensor", "adis16999"], "no variant is called"),
    ],
)
def test_a_wrong_call_is_one_line_and_opens_nothing(arguments, says, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("adis_gonio.device.bus.open_bus", lambda url: pytest.fail("it was opened"))
    assert main(["bringup", SIM, *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_at_a_terminal_each_step_that_writes_asks(monkeypatch, capsys, board):
    bus = board(SOUND)
    answers = iter("ynnnny")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    asked = []

    def confirm(question, **how):
        asked.append(question)
        return next(answers) == "y"

    monkeypatch.setattr("click.confirm", confirm)
    assert main(["bringup", "board:", "--allow-writes", "--flash"]) == 0
    assert asked == [step.question for step in STEPS if step.question]
    out = capsys.readouterr().out
    assert out.count("the answer to its question was no") == 4
    assert bus.chip.memory["ENDURANCE"] == 1


def test_a_simulated_sensor_goes_through_it(capsys):
    assert main(["bringup", SIM]) == 0
    assert "No fault was found" in capsys.readouterr().out


def test_a_port_that_is_not_there_is_one_line(capsys):
    pytest.importorskip("serial")
    assert main(["bringup", "serial:/dev/nothing-there"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
