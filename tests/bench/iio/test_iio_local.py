"""A local IIO accelerometer, on a tree written by the kernel's documentation of its ABI."""

import json
import os
import shutil
import sys

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.bench.iio_source import NO_FAULTS, find_devices
from adis_gonio.faces.cli import main
from adis_gonio.record.loading import load_session
from adis_gonio.record.source import Settings, open_source
from bench.iio.sysfs_tree import NAME, OFFSET, SCALE, SysfsTree

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="IIO is Linux'")

AT_REST_MG = [(raw + OFFSET) * SCALE / 9.80665 * 1000 for raw in (5, -7, -260)]


@pytest.fixture
def tree(tmp_path):
    tree = SysfsTree(tmp_path / "root")
    tree.start()
    yield tree
    tree.stop()


def url_of(tree, name="device0", more=""):
    return f"iio:{name}?root={tree.root}{more}"


def test_scans_are_read_in_units_and_what_was_changed_is_set_back(tree):
    before = tree.state()
    with open_source(url_of(tree)) as source, source.samples(Settings(), 50) as stream:
        assert tree.read("buffer/enable") == "1"
        block = next(stream)
        assert block.registers == ("ax", "ay", "az", "temp_c")
        assert block.accel_mg.mean(axis=0) == pytest.approx(AT_REST_MG, abs=3)
        assert block.values()[:, 3] == pytest.approx([25.0] * 50)
        assert np.diff(block.time_s) == pytest.approx([0.01] * 49)
        assert block.lost == 0
        assert source.part.step_mg == pytest.approx(SCALE / 9.80665 * 1000)
    assert tree.state() == before


def test_lost_scans_are_counted_by_the_gaps_in_their_times(tree):
    tree.lose_after = 70
    with open_source(url_of(tree)) as source, source.samples(Settings(), 40) as stream:
        lost = [next(stream).lost for _ in range(3)]
    assert lost == [0, 3, 0]


@pytest.mark.parametrize("name", ["", "device0", "iio:device0", NAME])
def test_a_device_is_found_by_id_or_name(tree, name):
    with open_source(url_of(tree, name)) as source:
        assert source.measuring.device == NAME
        assert source.measuring.sample_rate_hz == 100


def test_it_is_listed(tree, tmp_path):
    (device,) = find_devices(tree.root)
    assert device.url == "iio:device0"
    assert NAME in device.description
    assert find_devices(tmp_path / "nothing") == []


def test_single_values_are_polled_where_asked(tree):
    with open_source(url_of(tree, more="&poll=200")) as source, source.samples(Settings(), 10) as stream:
        block = next(stream)
    assert block.accel_mg == pytest.approx(np.tile(AT_REST_MG, (10, 1)))
    assert (np.diff(block.time_s) > 0).all()
    assert tree.read("buffer/enable") == "0"


@pytest.mark.parametrize(
    ("change", "options", "error", "match"),
    [
        (lambda t: t.write("buffer/enable", "1"), "", CannotOpenError, "in use"),
        (lambda t: t.node.unlink(), "", CannotOpenError, "trigger"),
        (lambda t: t.write("in_accel_scale", "much"), "", CannotOpenError, "scale is 'much'"),
        (lambda t: t.write("scan_elements/in_accel_x_type", "le:s3"), "", CannotOpenError, "format"),
        (lambda t: (t.device / "in_accel_sampling_frequency").unlink(), "", CannotOpenError, "rate=HZ"),
        (lambda t: None, "&poll=0", UsageError, "poll"),
        (lambda t: None, "&pol=5", UsageError, "did you mean 'poll'"),
    ],
)
def test_what_does_not_work_is_one_typed_error_and_nothing_stays_changed(
    tree, change, options, error, match
):
    change(tree)
    before = tree.state()
    with pytest.raises(error, match=match), open_source(url_of(tree, more=options)) as source:
        next(source.samples(Settings(), 5))
    assert tree.state() == before


def test_a_device_that_is_silent_is_a_time_out(tree, monkeypatch):
    tree.stop()
    monkeypatch.setattr("adis_gonio.bench.iio_source.PATIENCE_S", 0.2)
    keep = os.open(tree.node, os.O_RDWR)  # a writer that says nothing
    try:
        with pytest.raises(BusTimeoutError, match="trigger"), open_source(url_of(tree)) as source:
            next(source.samples(Settings(), 5))
    finally:
        os.close(keep)


def test_a_device_that_is_pulled_out_is_gone_and_not_only_silent(tree, monkeypatch):
    """A kernel keeps the open node, silent, and takes the attributes away."""
    tree.stop()
    monkeypatch.setattr("adis_gonio.bench.iio_source.PATIENCE_S", 0.2)
    keep = os.open(tree.node, os.O_RDWR)
    try:
        with open_source(url_of(tree)) as source, source.samples(Settings(), 5) as stream:
            shutil.rmtree(tree.device)
            with pytest.raises(ProtocolError, match="the device is gone"):
                next(stream)
    finally:
        os.close(keep)


def test_a_device_that_goes_away_is_an_error(tree):
    with open_source(url_of(tree)) as source:
        stream = source.samples(Settings(), 5)
        next(stream)
        tree.stop()
        with pytest.raises(ProtocolError, match="gone"):
            for _ in stream:
                pass
        stream.close()


def test_a_device_without_a_buffer_needs_polling(tmp_path, capsys):
    tree = SysfsTree(tmp_path / "root", buffered=False)
    with pytest.raises(CannotOpenError, match="poll=HZ"):
        open_source(url_of(tree))
    assert main(["stream", url_of(tree, more="&poll=100"), "--seconds", "0.3", "--json"]) == 0
    told = capsys.readouterr()
    assert "not simultaneous" in told.err
    document = json.loads(told.out)
    assert document["alarm"] is None
    assert document["dropped"] == 0


def test_stream_records_a_generic_sensor_that_can_be_read_back(tree, tmp_path, capsys):
    out = tmp_path / "rest.csv"
    assert main(["stream", url_of(tree), "--seconds", "2.5", "-o", str(out)]) == 0
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
def test_what_only_the_chip_has_is_refused(tree, capsys, words):
    assert main(["stream", url_of(tree), *words]) == 2
    told = capsys.readouterr().err
    assert words[0] in told
    assert told.count("\n") == 1
    assert main(["calibrate", url_of(tree), "-o", "x.session", "--range", "300"]) == 2


def test_commands_that_need_frames_say_so(tree, capsys):
    for command in ("registers", "selftest", "bringup", "serve"):
        assert main([command, url_of(tree)]) == 2
        told = capsys.readouterr().err
        assert "gives samples" in told
        assert told.count("\n") == 1
    assert main(["devices", "--json"]) == 0
    json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e400"])
def test_a_scale_that_is_not_finite_is_refused(tree, text):
    tree.write("in_accel_scale", text)
    with pytest.raises(CannotOpenError, match=f"scale is '{text}'"):
        open_source(url_of(tree))


@pytest.mark.parametrize("rate", ["1e-300", "0", "-5", "1e12", "nan"])
def test_a_rate_that_no_device_has_is_refused(tree, rate):
    tree.write("in_accel_sampling_frequency", rate)
    with pytest.raises(CannotOpenError, match=r"samples a second|sampling_frequency"):
        open_source(url_of(tree))
