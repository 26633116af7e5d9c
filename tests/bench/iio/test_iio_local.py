"""A local IIO accelerometer, by a stand-in for libiio; a real kernel's is in tests/kernel/guest."""

import errno
import json
import sys

import numpy as np
import pytest

from adis_gonio.base.errors import (
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
    UsageError,
)
from adis_gonio.bench import iio_source
from adis_gonio.bench.events import GuardRaised, Watching
from adis_gonio.bench.iio_source import NO_FAULTS, find_devices
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.faces.cli import main
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings, open_source
from bench.iio.fake_libiio import NAME, OFFSET, SCALE, FakeDevice, FakeLibiio

AT_REST_MG = [(raw + OFFSET) * SCALE / 9.80665 * 1000 for raw in (5, -7, -260)]


def present(monkeypatch, tmp_path, *devices):
    """Let this machine have these devices."""
    (tmp_path / "sys").mkdir()
    for device in devices:
        (tmp_path / "sys" / device.id).mkdir()
    monkeypatch.setattr(iio_source, "SYSFS", tmp_path / "sys")
    monkeypatch.setattr(iio_source, "load_libiio", lambda: FakeLibiio(*devices))


@pytest.fixture
def device(monkeypatch, tmp_path):
    device = FakeDevice()
    present(monkeypatch, tmp_path, device)
    return device


def url_of(name="device0", more=""):
    return f"iio:{name}{more}"


def test_scans_are_read_in_units_and_the_buffer_ends_with_the_stream(device):
    with open_source(url_of()) as source, source.samples(Settings(), 50) as stream:
        assert device.buffers == 1
        block = next(stream)
        assert block.registers == ("ax", "ay", "az", "temp_c")
        assert block.accel_mg.mean(axis=0) == pytest.approx(AT_REST_MG, abs=3)
        assert block.values()[:, 3] == pytest.approx([25.0] * 50)
        assert np.diff(block.time_s) == pytest.approx([0.01] * 49)
        assert block.lost == 0
        assert source.part.step_mg == pytest.approx(SCALE / 9.80665 * 1000)
    assert device.buffers == 0


def test_lost_scans_are_counted_by_the_gaps_in_their_times(device):
    device.lost = (70, 71, 72)
    with open_source(url_of()) as source, source.samples(Settings(), 40) as stream:
        lost = [next(stream).lost for _ in range(3)]
    assert lost == [0, 3, 0]


@pytest.mark.parametrize("stamped", [True, False])
def test_scans_of_a_stream_follow_those_of_a_stream_whose_first_block_came_late(device, stamped):
    device.late_s = 0.3
    if not stamped:
        device.channels.pop()
    with open_source(url_of()) as source:
        times = []
        for _ in range(2):
            with source.samples(Settings(), 8) as stream:
                times += [next(stream).time_s for _ in range(4)]
    assert (np.diff(np.concatenate(times)) > 0.009).all()


@pytest.mark.parametrize("name", ["", "device0", "iio:device0", NAME])
def test_a_device_is_found_by_id_or_name(device, name):
    with open_source(url_of(name)) as source:
        assert source.measuring.device == NAME
        assert source.measuring.sample_rate_hz == 100


@pytest.mark.parametrize(("name", "match"), [("device7", "no such"), ("", "more than one")])
def test_a_name_that_does_not_fit_one_device_lists_those_that_are_there(monkeypatch, tmp_path, name, match):
    second = FakeDevice()
    second.id = "iio:device1"
    present(monkeypatch, tmp_path, FakeDevice(), second)
    with pytest.raises(CannotOpenError, match=rf"{match}.*device0 \({NAME}\), iio:device1"):
        open_source(url_of(name))


def test_it_is_listed(device):
    (listed,) = find_devices()
    assert listed.url == "iio:device0"
    assert NAME in listed.description


def test_a_machine_without_iio_has_none_and_needs_no_library(monkeypatch, tmp_path):
    monkeypatch.setattr(iio_source, "SYSFS", tmp_path / "nothing")
    monkeypatch.setitem(sys.modules, "iio", None)
    assert find_devices() == []
    with pytest.raises(CannotOpenError, match="there are: none"):
        open_source("iio:")


@pytest.mark.parametrize(
    ("find_library", "match"), [(None, r"apt install libiio0"), ("missing", r"pip install '.\[iio\]'")]
)
def test_a_missing_library_is_named(monkeypatch, tmp_path, find_library, match):
    monkeypatch.setattr(iio_source, "SYSFS", tmp_path)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: find_library)
    monkeypatch.delitem(sys.modules, "iio", raising=False)
    if find_library:
        monkeypatch.setitem(sys.modules, "iio", None)
    with pytest.raises(NotInstalledError, match=match):
        open_source("iio:")


def test_single_values_are_polled_where_asked(device):
    with open_source(url_of(more="?poll=200")) as source, source.samples(Settings(), 10) as stream:
        block = next(stream)
    assert block.accel_mg == pytest.approx(np.tile(AT_REST_MG, (10, 1)))
    assert (np.diff(block.time_s) > 0).all()
    assert device.buffers == 0


def set_attribute(name, text):
    return lambda device: setattr(device.channel("accel_x").attrs[name], "text", text)


def set_format(name, value):
    return lambda device: setattr(device.channel("accel_x").data_format, name, value)


def forget_rate(device):
    del device.channel("accel_x").attrs["sampling_frequency"]


@pytest.mark.parametrize(
    ("change", "options", "error", "match"),
    [
        (lambda d: setattr(d, "busy", errno.EBUSY), "", CannotOpenError, "busy.*another program"),
        (lambda d: setattr(d, "busy", errno.EINVAL), "", CannotOpenError, "trigger"),
        (set_attribute("scale", "much"), "", CannotOpenError, "scale is 'much'"),
        (set_format("length", 24), "", CannotOpenError, "format of accel_x"),
        (set_format("bits", 17), "", CannotOpenError, "format of accel_x"),
        (set_format("repeat", 3), "", CannotOpenError, "format of accel_x"),
        (forget_rate, "", CannotOpenError, "rate=HZ"),
        (lambda d: None, "?poll=0", UsageError, "poll"),
        (lambda d: None, "?pol=5", UsageError, "did you mean 'poll'"),
    ],
)
def test_what_does_not_work_is_one_typed_error_and_no_buffer_stays_open(
    device, change, options, error, match
):
    change(device)
    with pytest.raises(error, match=match), open_source(url_of(more=options)) as source:
        next(source.samples(Settings(), 5))
    assert device.buffers == 0


def test_a_device_that_is_silent_is_a_time_out(device, monkeypatch):
    device.silent.set()
    monkeypatch.setattr("adis_gonio.bench.iio_source.PATIENCE_S", 0.2)
    with (
        pytest.raises(BusTimeoutError, match="trigger"),
        open_source(url_of()) as source,
        source.samples(Settings(), 5) as stream,
    ):
        next(stream)


@pytest.mark.parametrize("code", [errno.ENODEV, errno.ETIMEDOUT])
def test_a_device_that_is_pulled_out_is_gone_and_not_only_silent(device, tmp_path, code):
    """A kernel keeps the open node, often silent, and takes the attributes away."""
    with open_source(url_of()) as source, source.samples(Settings(), 5) as stream:
        next(stream)
        device.gone = code
        (tmp_path / "sys" / device.id).rmdir()
        with pytest.raises(ProtocolError, match="the device is gone"):
            next(stream)


def test_a_device_without_a_buffer_needs_polling(monkeypatch, tmp_path, capsys):
    present(monkeypatch, tmp_path, FakeDevice(buffered=False))
    with pytest.raises(CannotOpenError, match="poll=HZ"):
        open_source(url_of())
    assert main(["stream", url_of(more="?poll=100"), "--seconds", "0.3"]) == 0
    told = capsys.readouterr().err
    assert "not simultaneous" in told
    assert "alarm in STATUS" not in told
    assert "without new data" not in told


def test_stream_records_a_generic_sensor_that_can_be_read_back(device, tmp_path, capsys):
    out = tmp_path / "rest.csv"
    assert main(["stream", url_of(), "--seconds", "2.5", "-o", str(out)]) == 0
    told = capsys.readouterr().err
    assert "scans by the device's own clock" in told
    assert told.count(NO_FAULTS) == 1
    session = load_session(out)
    assert NO_FAULTS in session.notes
    assert session.sensor == "generic"
    assert session.accel_unit == "mg"
    assert session.dwells[0].accel.mean(axis=0) == pytest.approx(AT_REST_MG, abs=3)


@pytest.mark.parametrize(
    "words",
    [["--rate", "100"], ["--filter", "0"], ["--range", "75"], ["--registers", "XACCL_OUT"], ["--no-check"]],
)
def test_what_only_the_chip_has_is_refused(device, capsys, words):
    assert main(["stream", url_of(), *words]) == 2
    told = capsys.readouterr().err
    assert words[0] in told
    assert told.count("\n") == 1
    assert main(["calibrate", url_of(), "-o", "x.session", "--range", "300"]) == 2


def test_commands_that_need_frames_say_so(device, capsys):
    for command in ("registers", "selftest", "bringup", "serve"):
        assert main([command, url_of()]) == 2
        told = capsys.readouterr().err
        assert "gives samples" in told
        assert told.count("\n") == 1
    assert main(["devices", "--json"]) == 0
    json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e400"])
def test_a_scale_that_is_not_finite_is_refused(device, text):
    set_attribute("scale", text)(device)
    with pytest.raises(CannotOpenError, match=f"scale is '{text}'"):
        open_source(url_of())


@pytest.mark.parametrize("rate", ["1e-300", "0", "-5", "1e12", "nan"])
def test_a_rate_that_no_device_has_is_refused(device, rate):
    set_attribute("sampling_frequency", rate)(device)
    with pytest.raises(CannotOpenError, match=r"samples a second|sampling_frequency"):
        open_source(url_of())


def test_a_long_question_at_a_fast_sensor_is_archived_whole(monkeypatch, tmp_path):
    """At 100 000 scans a second the scans of one question exceed the largest row of the archive."""
    present(monkeypatch, tmp_path, FakeDevice(rate_hz=1e5))
    path, shown = tmp_path / "fast.session", 0
    with open_source(url_of()) as source:
        settings = Settings(dwell_s=0.1, settle_s=0.05, turns=True)
        runner = SessionRunner.begin(source, path, plan("poses", 9), settings)
        for event in runner.run(so_far=False):
            shown += isinstance(event, Watching) and event.state == "idle"
            if shown == 30 and isinstance(event, Watching):
                runner.answer("confirm")
                shown += 1
            if isinstance(event, GuardRaised):
                runner.stop()
    with ArchiveView(path) as view:
        (attempt,) = view.attempts()  # the device lies another way than asked
        assert sum(len(block) for block in view.blocks(attempt, "before")) > 100_000
