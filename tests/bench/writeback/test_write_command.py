"""`adis-gonio write` as a shell user meets it: plan, question, exit status, JSON, one line a mistake."""

import io
import json
import re
from dataclasses import replace

import pytest

from adis_gonio.bench.writeback import plan_offsets
from adis_gonio.faces.cli import main
from bench.writeback.rig import flash, new_bus, numbers

URL = "sim:?seed=3"
OLD, NEW = (0, 0, 0), (-32, -34, 0)
QUICK = ["--dwell", "0.5"]


@pytest.fixture
def bus(monkeypatch):
    """The part behind the URL, which lives on when a command closes its bus."""
    part = new_bus(3)
    monkeypatch.setattr(part, "_close", lambda: setattr(part, "_closed", False))
    monkeypatch.setattr("adis_gonio.device.sensor.driver.open_bus", lambda url: part)
    return part


def answering(monkeypatch, text):
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    monkeypatch.setattr("adis_gonio.faces.cli.board_commands.on_terminal", lambda: True)


def test_yes_writes_saves_and_says_what_the_sensor_holds(bus, path, capsys):
    assert main(["write", str(path), URL, "--yes", "--save", *QUICK]) == 0
    out, err = capsys.readouterr()
    assert numbers(bus) == flash(bus) == NEW
    rows = [line.split() for line in out.splitlines()]
    assert rows[0][:3] == ["register", "now", "new"]
    assert rows[1][:3] == ["XACCL_OFF", "0", "−32"]
    assert rows[2][:3] == ["YACCL_OFF", "0", "−34"]
    assert out.splitlines()[-1] == "the sensor holds the new offsets, saved to flash"
    assert "ENDURANCE 0 before, 1 after" in err
    assert "at rest, before" in err


def test_enter_changes_nothing_and_y_writes(bus, path, capsys, monkeypatch):
    before = path.read_bytes()
    answering(monkeypatch, "\n")
    assert main(["write", str(path), URL, *QUICK]) == 0
    assert "nothing was changed" in capsys.readouterr().err
    assert (numbers(bus), path.read_bytes()) == (OLD, before)
    answering(monkeypatch, "y\n")
    assert main(["write", str(path), URL, *QUICK]) == 0
    assert (numbers(bus), flash(bus)) == (NEW, OLD)


def test_nobody_to_ask_is_wrong_usage(bus, path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert main(["write", str(path), URL]) == 2
    assert "--yes" in capsys.readouterr().err
    assert numbers(bus) == OLD


def test_dry_run_gives_the_plan_as_json_and_writes_nothing(bus, path, capsys):
    before = path.read_bytes()
    assert main(["write", str(path), URL, "--dry-run", "--json", *QUICK]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["done"] is False
    assert document["state"]["registers"] == "untouched"
    x = document["plan"]["axes"][0]
    assert (x["register"], x["now"], x["new"], x["new_word"]) == ("XACCL_OFF", 0, -32, 0xFE0)
    assert x["effect_mg"] == pytest.approx(-32 * 0.4672)
    assert (numbers(bus), path.read_bytes()) == (OLD, before)


def test_the_plan_tells_doubts_limits_and_what_changed_since_the_recording(bus, path, capsys, monkeypatch):
    def planned(*given):
        plan = plan_offsets(*given)
        x, *others = plan.axes
        return replace(plan, axes=(replace(x, clipped=True), *others), doubts=("a reason", "another one"))

    monkeypatch.setattr("adis_gonio.bench.writeback.offset_checks.plan_offsets", planned)
    command = ["write", str(path), URL, "--even-if-inadequate", *QUICK]
    assert main([*command, "--yes"]) == 0
    assert "when the session was recorded" not in capsys.readouterr().err
    assert main([*command, "--dry-run"]) == 0
    told = capsys.readouterr().err.splitlines()
    assert {"doubtful: a reason", "doubtful: another one"} <= set(told)
    changed = [line.split()[0] for line in told if line.endswith(" was 0 when the session was recorded")]
    assert changed == ["XACCL_OFF", "YACCL_OFF"]
    (line,) = (line for line in told if "at its limit" in line)
    assert re.fullmatch(r"XACCL_OFF is at its limit: [+−]0\.\d mg of the bias remain", line)


def test_json_of_a_write_and_status_and_undo(bus, path, capsys):
    assert main(["write", str(path), URL, "--yes", "--save", "--json", *QUICK]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["done"] is True
    assert document["endurance"] == {"before": 0, "after": 1}
    assert document["state"] | {"text": ""} == {
        "registers": "new",
        "saved": True,
        "open": False,
        "axes": {"XACCL_OFF": "new", "YACCL_OFF": "new"},
        "operation": document["state"]["operation"],
        "text": "",
    }
    assert all(check["agrees"] for check in document["checks"])
    assert main(["write", str(path), URL, "--status"]) == 0
    assert "new offsets, saved" in capsys.readouterr().out
    assert main(["write", str(path), URL, "--undo", "--yes", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["state"]["registers"] == "old"
    assert numbers(bus) == flash(bus) == OLD


def test_a_half_write_is_exit_1_in_status_and_offers_to_finish_or_set_back(bus, path, capsys, monkeypatch):
    from adis_gonio.device.sensor import Adis16354

    assert main(["write", str(path), URL, "--yes", *QUICK]) == 0
    Adis16354(bus).write("YACCL_OFF", 0)
    capsys.readouterr()
    assert main(["write", str(path), URL, "--status"]) == 1
    assert "a part of the new offsets" in capsys.readouterr().out
    answering(monkeypatch, "b\n")
    assert main(["write", str(path), URL, *QUICK]) == 0
    assert numbers(bus) == OLD
    assert main(["write", str(path), URL, "--yes", *QUICK]) == 0
    Adis16354(bus).write("YACCL_OFF", 0)
    answering(monkeypatch, "f\n")
    assert main(["write", str(path), URL, *QUICK]) == 0
    assert numbers(bus) == NEW


@pytest.mark.parametrize(
    ("more", "status", "what"),
    [
        (["--undo", "--status"], 2, "exclude"),
        (["--undo", "--yes"], 1, "nothing to undo"),
        (["--yes", "--method", "two-position"], 1, "gives no bias"),
        (["--yes", "--at", "90"], 1, "another"),
        (["--yes", "--dwell", "0.001"], 2, "too short"),
    ],
)
def test_one_line_for_each_mistake(bus, path, capsys, more, status, what):
    if "--at" in more:
        bus.stage = None
    assert main(["write", str(path), URL, *more]) == status
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("adis-gonio:")]
    assert len(lines) == 1
    assert what in lines[0]
    assert numbers(bus) == OLD


def test_a_source_without_registers_is_refused(path, capsys):
    assert main(["write", str(path), "iio:device0", "--yes"]) == 2
    assert "for the ADIS16354 only" in capsys.readouterr().err


def test_ctrl_c_ends_with_130_and_says_which_offsets_stand(bus, path, capsys, monkeypatch):
    exchange = bus._exchange

    def stopped(frames):
        if frames[0] == 0xA20F or (frames & 0xFF00 == 0xA200).any():
            bus._exchange = exchange
            raise KeyboardInterrupt
        return exchange(frames)

    bus._exchange = stopped
    assert main(["write", str(path), URL, "--yes", "--save", *QUICK]) == 130
    assert "the sensor holds the old offsets" in capsys.readouterr().err
    assert numbers(bus) == flash(bus) == OLD
