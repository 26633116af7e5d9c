"""Registers that change while a session runs: no dwell of another register state counts."""

import math

import pytest

from adis_gonio import fit, load_session, open_bus
from adis_gonio.base.errors import ChipError, SessionError
from adis_gonio.bench.events import DwellDone, DwellProgress
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.faces.cli import main
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.plans import plan
from adis_gonio.record.source import MARK, ChipSource, Settings
from fakes.faulty_chip import FaultyBus, Window

POLLED = "sim:?seed=3&stream=0"
SHORT = Settings(dwell_s=1.0, settle_s=0.1)


def restart(bus, sensor) -> None:
    """The chip takes its flash copies, as after a supply dip; the driver does not know."""
    bus.chip.hard_reset(bus.now_s())
    bus.sleep_s(0.3)


def write(register: str, number: int):
    """Another program writes a register; the driver does not know."""

    def act(bus, sensor) -> None:
        Adis16354(bus, "adis16354").write(register, number)

    return act


def offset_by(lsb: int):
    return write("XACCL_OFF", lsb)


CHANGES = {
    "restart": restart,
    "offset of 1 LSB": offset_by(1),
    "offset of 32 LSB": offset_by(32),
    "offset of 128 LSB": offset_by(128),
    "gyro offset": write("ZGYRO_OFF", 9),
    "filter": write("SENS_AVG", 0x0404),
    "range": write("SENS_AVG", 0x0202),
    "compensation": write("MSC_CTRL", 0x80),
    "rate": write("SMPL_PRD", 0x04),
}


def run(path, change, when, ram_offset=0):
    """Run a session of four positions; act once, between two dwells or within one."""
    with open_bus(POLLED) as bus:
        sensor = Adis16354(bus, "adis16354")
        if ram_offset:
            sensor.write("XACCL_OFF", ram_offset)
        runner = SessionRunner.begin(sensor, path, plan("four-position"), SHORT, auto=True)
        done = 0
        for event in runner.run(so_far=False):
            done += isinstance(event, DwellDone)
            if change is not None and done == 2 and isinstance(event, when):
                change(bus, sensor)
                change = None


@pytest.mark.parametrize("when", [DwellDone, DwellProgress])
@pytest.mark.parametrize("kind", CHANGES)
@pytest.mark.parametrize("ram_offset", [0, 40])
def test_a_changed_register_ends_the_session_and_the_dwell_does_not_count(tmp_path, kind, when, ram_offset):
    path = tmp_path / "q.session"
    with pytest.raises(SessionError, match="settings changed"):
        run(path, CHANGES[kind], when, ram_offset)
    with ArchiveView(path) as view:
        assert [attempt.place for attempt in view.dwells()] == [0, 1]
        kept = [attempt for attempt in view.attempts() if attempt.place == 2]
        assert kept
        assert all(attempt.outcome == "interrupted" for attempt in kept)
        assert sum(len(block) for attempt in kept for block in view.blocks(attempt))


def test_a_session_without_a_change_leaves_the_alarm_level_as_it_was(tmp_path):
    path = tmp_path / "q.session"
    run(path, None, DwellDone)
    session = load_session(path)
    assert session.facts["doubts"] == []
    registers = session.facts["registers"]
    assert registers["before"]["ALM_MAG2"] == registers["after"]["ALM_MAG2"] == 0
    with ArchiveView(path) as view:
        assert len(view.dwells()) == 4


def test_the_mark_of_a_killed_session_is_cleared_and_a_used_alarm_is_left_alone(tmp_path):
    path = tmp_path / "q.session"
    with open_bus(POLLED) as bus:
        sensor = Adis16354(bus, "adis16354")
        sensor.write("ALM_MAG2", MARK)  # a killed program left it
        sensor.write("ALM_MAG1", 77)
        sensor.write("ALM_CTRL", 0x2000)  # alarm 2 watches a gyro
        for _ in SessionRunner.begin(sensor, path, plan("two-position"), SHORT, auto=True).run(
            so_far=False
        ):
            pass
        assert sensor.read("ALM_MAG2") == 0
        assert sensor.read("ALM_MAG1") == 77
        assert sensor.read("ALM_CTRL") == 0x2000


def test_a_mark_does_not_get_into_flash_and_registers_explains_it(capsys):
    with open_bus(POLLED) as bus:
        sensor = Adis16354(bus, "adis16354")
        sensor.write("ALM_MAG2", MARK)
        sensor.save_to_flash()
        sensor.reset()
        assert sensor.read("ALM_MAG2") == 0
    assert main(["registers", POLLED, f"ALM_MAG2=0x{MARK:X}"]) == 0
    assert "ALM_MAG2 holds the mark of an interrupted session" in capsys.readouterr().err


def test_a_restart_shows_if_both_alarms_are_in_use(tmp_path):
    with open_bus(POLLED) as bus:
        sensor = Adis16354(bus, "adis16354")
        sensor.write("ALM_CTRL", 0x2200)
        runner = SessionRunner.begin(sensor, tmp_path / "q.session", plan("two-position"), SHORT, auto=True)
        events = runner.run(so_far=False)
        while not isinstance(next(events), DwellDone):
            pass
        restart(bus, sensor)
        with pytest.raises(SessionError, match=r"ALM_CTRL 8704 → 0"):
            list(events)


@pytest.mark.parametrize("polled", [True, False])
@pytest.mark.parametrize(("word", "end"), [(0x0200, "0x0"), (0x0384, "0x84")])
def test_no_session_begins_while_the_manual_self_test_shifts_readings(tmp_path, polled, word, end):
    path = tmp_path / "q.session"
    with open_bus(POLLED if polled else "sim:?seed=3") as bus:
        sensor = Adis16354(bus, "adis16354")
        sensor.write("MSC_CTRL", word)
        runner = SessionRunner.begin(sensor, path, plan("two-position"), SHORT, auto=True)
        with pytest.raises(ChipError, match=f"self-test.* MSC_CTRL={end} --no-check'"):
            list(runner.run(so_far=False))
        assert sensor.read("MSC_CTRL") == word


@pytest.mark.parametrize(
    ("register", "number"), [("SENS_AVG", 0x0202), ("SENS_AVG", 0x0404), ("SMPL_PRD", 3)]
)
def test_a_setting_that_changes_while_the_session_begins_is_refused(
    tmp_path, monkeypatch, register, number
):
    lend = Adis16354.lend_data_ready

    def lend_and_change(sensor, names):
        loan = lend(sensor, names)
        Adis16354(sensor.bus, "adis16354").write(register, number)
        return loan

    monkeypatch.setattr(Adis16354, "lend_data_ready", lend_and_change)
    with pytest.raises(ChipError, match="changed while the session began"):
        run(tmp_path / "q.session", None, DwellDone)


def test_a_data_line_stuck_at_ones_is_not_taken_for_a_self_test(tmp_path, monkeypatch):
    read = Adis16354.read

    def stuck(sensor, name):
        return 0xFFFF if name is BY_NAME["MSC_CTRL"] else read(sensor, name)

    monkeypatch.setattr(Adis16354, "read", stuck)
    run(tmp_path / "q.session", None, DwellDone)


@pytest.fixture
def mixed(tmp_path, monkeypatch):
    """An older program compared nothing; its archive holds the registers before and after."""
    path = tmp_path / "q.session"
    monkeypatch.setattr("adis_gonio.bench.session_bench.SessionBench.settings_lost", lambda bench: "")
    run(path, restart, DwellDone, 40)
    return path


@pytest.mark.parametrize("ending", ["h", "xml", "txt"])
def test_coefficients_of_a_session_whose_registers_changed_are_not_exported(mixed, capsys, ending):
    made = mixed.with_name(f"out.{ending}")
    assert main(["export", str(mixed), "-o", str(made)]) == 1
    assert not made.exists()
    told = capsys.readouterr().err
    assert "XACCL_OFF 40 → 0" in told
    assert "record the session again" in told


@pytest.mark.parametrize("ending", ["json", "csv"])
def test_data_of_a_session_whose_registers_changed_are_exported_with_the_remark(mixed, capsys, ending):
    made = mixed.with_name(f"out.{ending}")
    for output in (str(made), "-"):
        assert main(["export", str(mixed), "-o", output, "--format", ending]) == 0
        assert "XACCL_OFF 40 → 0" in capsys.readouterr().err
    assert "XACCL_OFF 40 → 0" in made.read_text(encoding="utf-8")
    if ending == "json":  # no calibration, which other commands would take without the session's remark
        assert main(["export", str(made), "-o", str(mixed.with_name("out.h"))]) == 1


def test_fit_of_an_archive_whose_registers_changed_says_so(mixed, capsys):
    path = mixed
    (doubt,) = load_session(path).facts["doubts"]
    assert "XACCL_OFF 40 → 0" in doubt["message"]
    assert any("XACCL_OFF 40 → 0" in warning for warning in fit(load_session(path)).warnings)
    assert main(["fit", str(path)]) == 0
    assert "XACCL_OFF 40 → 0" in " ".join(capsys.readouterr().out.split())
    with open_bus(POLLED) as bus:
        sensor = Adis16354(bus, "adis16354")
        sensor.write("XACCL_OFF", 40)
        for gyros in (False, True):
            writer = OffsetWriter(sensor, path, WriteSettings(dwell_s=1.0, gyros=gyros))
            with pytest.raises(SessionError, match=r"not reliable enough.*XACCL_OFF 40 → 0"):
                writer.plan()


LINES = {"high": "replies are ones", "low": "replies are zeros", "noise": "read differently each time"}


def run_with_dead_line(path, monkeypatch, line, method, call):
    """Run two positions; the data line dies as the source's method is called for the n-th time."""
    bus = FaultyBus(BusUrl.parse("faulty:?seed=3&stream=0"))
    inner, calls = getattr(ChipSource, method), []

    def dying(source):
        calls.append(method)
        if len(calls) == call:
            bus.chip.windows.append(Window(bus.now_s(), math.inf, line, deaf=False))
        return inner(source)

    monkeypatch.setattr(ChipSource, method, dying)
    with bus:
        sensor = Adis16354(bus, "adis16354")
        for _ in SessionRunner.begin(sensor, path, plan("two-position"), SHORT, auto=True).run(
            so_far=False
        ):
            pass


@pytest.mark.parametrize("line", LINES)
def test_a_line_that_dies_as_a_dwell_ends_is_no_change_of_the_settings(tmp_path, monkeypatch, line):
    with pytest.raises(SessionError, match=LINES[line]) as caught:
        run_with_dead_line(tmp_path / "q.session", monkeypatch, line, "status", 2)
    assert "settings changed" not in str(caught.value)
    assert "--resume" in str(caught.value)
    with ArchiveView(tmp_path / "q.session") as view:
        assert [attempt.place for attempt in view.dwells()] == [0]


@pytest.mark.parametrize(("line", "level"), [("high", "ones"), ("low", "zeros")])
def test_a_line_that_dies_behind_the_last_dwell_is_no_change_of_the_settings(
    tmp_path, monkeypatch, line, level
):
    run_with_dead_line(tmp_path / "q.session", monkeypatch, line, "registers", 3)
    (doubt,) = load_session(tmp_path / "q.session").facts["doubts"]
    assert f"replies were {level}" in doubt["message"]
    assert "settings changed" not in doubt["message"]


def test_a_gyro_range_that_is_cleared_behind_the_last_dwell_is_a_change_of_the_settings(
    tmp_path, monkeypatch
):
    registers, calls = ChipSource.registers, []

    def clearing(source):
        calls.append(source)
        if len(calls) == 3:
            source.sensor.bus.chip.memory["SENS_AVG"] = 0
        return registers(source)

    monkeypatch.setattr(ChipSource, "registers", clearing)
    path = tmp_path / "q.session"
    with open_bus(POLLED) as bus:
        sensor = Adis16354(bus, "adis16354")
        list(SessionRunner.begin(sensor, path, plan("two-position"), SHORT, auto=True).run(so_far=False))
    (doubt,) = load_session(path).facts["doubts"]
    assert "settings changed" in doubt["message"]
    assert "SENS_AVG 1026 → 0" in doubt["message"]
