"""An IIO accelerometer by network: the own server, calibrated and traced; bad servers."""

import contextlib
import socket
import threading
import time

import numpy as np
import pytest

from adis_gonio import fit, load_session, trace
from adis_gonio.base.errors import BusError, CannotOpenError, NotInstalledError, SessionError, UsageError
from adis_gonio.bench.events import DwellDone, ExtensionOffered, Finished, PositionAsked
from adis_gonio.bench.iio_source import NO_FAULTS, IioDevice, load_libiio
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.faces.cli import main
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings, open_source
from faces.serve.raw_client import served

try:
    load_libiio()
except NotInstalledError as missing:
    pytest.skip(str(missing), allow_module_level=True)

QUICK = Settings(dwell_s=0.6, settle_s=0.0)
URL = "sim:?seed=1&move_speed_dps=720"


def url_of(server, more=""):
    return f"iio:ip:127.0.0.1:{server.port}/adis16354{more}"


def run(runner, server, *, stop_after=None):
    """Run a session; the operator is this program, who turns the served sensor's stage."""
    last, done = None, 0
    for last in runner.run(so_far=False):
        if isinstance(last, PositionAsked):
            server.sensor.bus.stage.move_to(last.position.angle_deg, 1)
            runner.answer("confirm")
        elif isinstance(last, ExtensionOffered):
            runner.answer("decline")
        elif isinstance(last, DwellDone):
            done += 1
            if done == stop_after:
                runner.stop()
    return last


def test_samples_by_network_are_those_of_the_sensor():
    with served("sim:?seed=1&realtime=1") as server:
        direct = np.array([server.sensor.quantity(f"{axis}ACCL_OUT").value for axis in "XYZ"])
        with open_source(url_of(server)) as source, source.samples(Settings(), 200) as stream:
            blocks = [next(stream) for _ in range(3)]
            assert source.part.step_mg == pytest.approx(0.4672)
            assert source.measuring.sample_rate_hz == pytest.approx(819.2, rel=1e-4)
    assert blocks[0].registers == ("ax", "ay", "az", "gx", "gy", "gz", "temp_c", "supply_v")
    assert blocks[0].accel_mg.mean(axis=0) == pytest.approx(direct, abs=15)
    steps = np.diff(np.concatenate([block.time_s for block in blocks]))
    assert steps == pytest.approx(np.full(599, 1.2207e-3), rel=0.01)
    assert [block.lost for block in blocks] == [0, 0, 0]
    values = blocks[0].values()
    assert values[:, 6].mean() == pytest.approx(25, abs=10)
    assert values[:, 7].mean() == pytest.approx(5, abs=0.1)


def test_a_session_by_network_finds_the_truth_and_is_traced(tmp_path):
    path = tmp_path / "mmpm.session"
    with served(URL) as server:
        with open_source(url_of(server)) as source:
            runner = SessionRunner.begin(source, path, plan("mmpm"), QUICK, fixture_sigma_deg=0.02)
            finished = run(runner, server)
        truth = server.sensor.bus.world.truth()
    assert isinstance(finished, Finished)
    assert finished.complete
    session = load_session(path)
    assert (session.sensor, session.accel_unit) == ("generic", "mg")
    assert session.facts["configuration"]["device"] == "adis16354"
    assert set(session.facts["settings"]) == {"dwell_s", "settle_s", "still_timeout_s"}
    assert "truth" not in session.facts, "what a network hides stays hidden"
    assert all(dwell["status"] is dwell["alarms"] is None for dwell in session.facts["dwells"])
    assert session.notes.count(NO_FAULTS) == 1
    assert all(len(dwell) == pytest.approx(491, abs=2) for dwell in session.dwells)
    found = fit(session, method="ml").as_dict()["parameters"]
    for name in ("delta_k", "delta_phi", "bias_x", "bias_y"):
        assert abs(found[name]["value"] - truth[name]) < 6 * found[name]["u"], name
    document = trace(session).as_dict()
    assert "bias" in {effect["effect"] for effect in document["found"]}
    assert main(["report", str(path), "-o", str(tmp_path / "page.html")]) == 0
    assert main(["simulate", "--like", str(path), "-o", str(tmp_path / "twin.csv")]) == 0
    assert main(["export", str(path), "--format", "csv", "-o", str(tmp_path / "again.csv")]) == 0
    again = load_session(tmp_path / "again.csv")
    assert again.dwells[3].accel == pytest.approx(session.dwells[3].accel)


def test_a_session_is_resumed_with_the_same_sensor_only(tmp_path):
    path = tmp_path / "two.session"
    with served(URL, allow_writes=True) as server, server.client() as other:
        with open_source(url_of(server)) as source:
            run(SessionRunner.begin(source, path, plan("two-position"), QUICK), server, stop_after=1)
        assert other.write("iio:device0 sampling_frequency", "409.6") > 0
        with (
            open_source(url_of(server)) as source,
            pytest.raises(SessionError, match=r"sample_rate_hz was 819\.2"),
        ):
            run(SessionRunner.resume(source, path), server)
        assert other.write("iio:device0 sampling_frequency", "819.2") > 0
        with open_source(url_of(server)) as source:
            finished = run(SessionRunner.resume(source, path), server)
        assert finished.done == 2
    assert len(load_session(path).dwells) == 2


def test_calibrate_takes_it_from_the_command_line(tmp_path, monkeypatch, capsys):
    path = tmp_path / "cli.session"
    with served(URL) as server:
        monkeypatch.setattr("sys.stdin", Operator(server, [0.0, 90.0]))
        words = ["calibrate", url_of(server), "--plan", "two-position", "--dwell", "0.6", "-o", str(path)]
        assert main(words) == 0
    told = capsys.readouterr()
    assert "generic on iio:ip:127.0.0.1" in told.err
    assert "polled" not in told.err
    assert " ".join((told.out + told.err).split()).count(NO_FAULTS) == 1
    assert len(load_session(path).dwells) == 2


class Operator:
    """Turns the part, presses Enter; declines what is offered then."""

    def __init__(self, server, angles):
        self._server, self._angles = server, angles

    def isatty(self):
        return False

    def readline(self):
        if not self._angles:
            return "n\n"
        self._server.sensor.bus.stage.move_to(self._angles.pop(0), 1)
        return "\n"


def test_auto_needs_a_stage(tmp_path):
    with (
        served() as server,
        open_source(url_of(server)) as source,
        pytest.raises(UsageError, match="stage"),
    ):
        SessionRunner.begin(source, tmp_path / "a.session", plan("mmpm"), QUICK, auto=True)


def test_a_dwell_of_a_few_samples_is_refused(tmp_path):
    with served() as server, open_source(url_of(server, "?poll=20")) as source:
        runner = SessionRunner.begin(source, tmp_path / "a.session", plan("mmpm"), QUICK)
        with pytest.raises(UsageError, match=r"take 0\.8 s or more"):
            run(runner, server)


def test_an_address_without_a_server_is_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    assert main(["stream", f"iio:ip:127.0.0.1:{port}/x"]) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "is iiod or adis-gonio serve running there?" in told


@pytest.mark.parametrize("place", ["ip:", "ip:a:b/c", "ip:host:99999/x", "ip:host:0/x"])
def test_an_address_that_is_none_is_wrong_usage(place):
    with pytest.raises(UsageError, match="iio:ip:HOST"):
        open_source(f"iio:{place}")


@contextlib.contextmanager
def bad_server(answers: bytes, *, hang=False, drip_s=0.0):
    """Send the answers whatever is asked, each byte after `drip_s`, then hang up unless `hang`."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        end = threading.Event()

        def serve():
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                with connection:
                    connection.recv(1)
                    for byte in answers if drip_s else ():
                        connection.sendall(bytes([byte]))
                        end.wait(drip_s)
                    connection.sendall(answers if not drip_s else b"")
                    if hang:
                        end.wait(60)
                    connection.shutdown(socket.SHUT_WR)
                    end.wait(60)  # to close before the client has read would reset the connection

        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        end.set()
        thread.join(60)


def context(channels: str) -> bytes:
    xml = f'<context><device id="iio:device0" name="x">{channels}</device></context>'.encode()
    return b"%d\n%s\n" % (len(xml), xml)


AXES = "".join(f'<channel id="accel_{axis}" type="input"/>' for axis in "xyz")


@pytest.mark.parametrize(
    "answers",
    [
        b"",
        b"hello\n",
        b"-22\n",
        b"99999999999\n",
        b"10\nabc",
        b"5\n<xml>\n",
        b"3\n\xff\xfe\xfd\n",
        b"24\n<!DOCTYPE a [<!ENTITY b \n",
        b"x" * 5000,
        context("") + b"0\n",
        context('<channel id="accel_x" type="input"/>') + b"0\n",
        context(AXES) + b"nonsense\n",
        context(AXES) + b"0\n",
    ],
)
def test_a_server_that_answers_nonsense_is_a_typed_error(answers):
    with bad_server(answers) as port, pytest.raises(BusError, match=r"iio:ip:127\.0\.0\.1"):
        open_source(f"iio:ip:127.0.0.1:{port}/x")


def test_a_server_that_does_not_answer_is_a_time_out(monkeypatch):
    monkeypatch.setattr(
        "adis_gonio.bench.iio_source.IioDevice.__init__.__defaults__", (0.3,), raising=False
    )
    with bad_server(b"", hang=True) as port, pytest.raises(BusError, match="no answer"):
        open_source(f"iio:ip:127.0.0.1:{port}/x")


def test_a_server_that_drips_is_given_one_deadline_for_all_its_bytes():
    answers, drip_s = context(AXES * 20), 0.02
    assert len(answers) * drip_s > 20
    with bad_server(answers, drip_s=drip_s) as port:
        began_s = time.monotonic()
        with pytest.raises(BusError, match="no answer"):
            IioDevice("iio:x", f"ip:127.0.0.1:{port}", "x", timeout_s=0.5)
        assert time.monotonic() - began_s < len(answers) * drip_s / 2


def test_a_device_that_is_not_there_names_those_that_are():
    with served() as server, pytest.raises(CannotOpenError, match=r"iio:device0 \(adis16354\)"):
        open_source(f"iio:ip:127.0.0.1:{server.port}/iio:device7")


def test_a_server_that_ends_in_the_middle_is_a_typed_error():
    with served() as server:
        source = open_source(url_of(server))
        stream = source.samples(Settings(), 50)
        next(stream)
    with source, stream, pytest.raises(BusError, match=r"ended the connection|reset|pipe"):
        for _ in stream:
            pass
