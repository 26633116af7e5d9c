"""Long work: what it says meanwhile, Ctrl-C in the midst of it, outputs that cannot be written."""

import io
import itertools
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from rich.console import Console

from adis_gonio.base.budget import Budget, current, with_progress, within
from adis_gonio.faces.cli import main, show
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.tracing.trace import trace

TWO = (
    "# accel_unit: mg\n# reading_u_mg: 0.1\ntime_s,position,angle_deg,ax,ay\n0,0,0,999,3\n60,1,90,4,-1001\n"
)


@pytest.fixture(autouse=True)
def ctrl_c_is_heard():
    """A run of the tests in the background has SIGINT ignored, and its children inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def two(tmp_path):
    path = tmp_path / "two.csv"
    path.write_text(TWO, encoding="utf-8")
    return path


def turn(path, dwells):
    """A turn with a bias, a curved axis and a fixture's errors, one row a dwell."""
    rng = np.random.default_rng(1)
    lines = [
        "# accel_unit: mg\n# reading_u_mg: 0.1\n# fixture_sigma_deg: 0.003\ntime_s,position,angle_deg,ax,ay"
    ]
    for k, angle in enumerate(np.linspace(0, 720, dwells, endpoint=False)):
        psi = np.radians(10 - angle) + np.radians(0.003) * rng.standard_normal()
        x = 1000 * np.cos(psi) + 8 + 3 * np.cos(psi) ** 2 + 0.1 * rng.standard_normal()
        y = 1001 * np.sin(psi) - 5 + 0.1 * rng.standard_normal()
        lines.append(f"{20 * k},{k},{angle % 360:.6f},{x:.5f},{y:.5f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


# What is said meanwhile


def test_in_a_log_a_line_comes_seldom_and_says_stage_and_share(capsys, monkeypatch):
    go = [threading.Event() for _ in range(2)]

    def times():
        for event in go:
            event.wait(600)
            yield 0.0

    monkeypatch.setattr(show, "report_times_s", times)

    def line_after(event):
        event.set()
        while not (text := capsys.readouterr().err):
            time.sleep(0.001)
        return text

    with show.report_progress("tracing 24 dwells of a.session"):
        assert line_after(go[0]) == "tracing 24 dwells of a.session …\n"
        current().tell("the error on left-out dwells")
        current().share(0.4)
        assert line_after(go[1]).startswith(
            "tracing 24 dwells of a.session: the error on left-out dwells, 40 % …"
        )
    assert capsys.readouterr().err == ""


def test_a_log_of_an_hour_is_short():
    times = list(itertools.takewhile(lambda t: t < 3600, show.report_times_s()))
    assert 5 < len(times) < 20
    assert times[0] == 1.0
    assert times == sorted(times)


def test_what_is_done_at_once_says_nothing(capsys):
    with show.report_progress("reading"):
        pass
    assert capsys.readouterr().err == ""


def test_on_a_terminal_stage_share_and_time_stand_in_one_place(monkeypatch):
    screen = io.StringIO()
    terminal = Console(file=screen, force_terminal=True, width=80, highlight=False)
    monkeypatch.setattr(show, "console", lambda *, stderr: terminal)
    with show.report_progress("fitting 4 dwells of [odd] name"):
        current().tell("every method")
        current().share(0.25)
    shown = screen.getvalue()
    assert "fitting 4 dwells of [odd] name: every method, 25 %" in shown
    assert "0:00:00" in shown
    assert not shown.endswith("25 %\n")  # it is taken away at the end


def test_a_loop_tells_its_share():
    heard = []
    with within(Budget(share=heard.append)):
        assert list(with_progress("ab", 1, 4)) == ["a", "b"]
        assert list(with_progress([])) == []
    assert heard == [0.25, 0.5, 0.75, 0.0]


def test_a_trace_tells_stages_and_the_share_of_the_longest(tmp_path):
    shares = {}
    budget = Budget(tell=lambda stage: shares.setdefault(stage, []))
    budget.share = lambda done: [*shares.values()][-1].append(done)  # noqa: PLW0108 (the last one of then)
    with within(budget):
        trace(load_session(turn(tmp_path / "turn.csv", 36)), time_limit=600)
    assert {"the search for effects", "what to measure next"} <= shares.keys()
    left_out = shares["the error on held-out dwells, effects chosen again"]
    assert len(left_out) > 5
    assert min(left_out) == 0.0
    assert max(left_out) == 1.0


# Ctrl-C


@pytest.mark.parametrize("command", ["trace", "report"])
def test_ctrl_c_in_the_midst_of_a_trace_leaves_everything_as_it_was(tmp_path, command):
    session, page = turn(tmp_path / "turn.csv", 200), tmp_path / "page.html"
    page.write_text("old", encoding="utf-8")
    more = ["-o", str(page), "--force"] if command == "report" else []
    with program([command, str(session), *more]) as process:
        assert process.stderr is not None
        first = process.stderr.readline()  # after a second of work
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=600)[1]
    assert process.returncode == 130
    assert first.endswith("…\n")
    assert rest.splitlines()[-1] == "adis-gonio: stopped by the operator; recorded data are kept"
    assert "Traceback" not in rest
    assert page.read_text(encoding="utf-8") == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html", "turn.csv"]


@pytest.mark.parametrize("name", ["out.session", "out.csv"])
def test_ctrl_c_in_a_simulation_keeps_what_was_measured_and_counts_it(tmp_path, name):
    out = tmp_path / name
    with program(["simulate", "-o", str(out), "--plan", "tumble", "--dwell", "120"]) as process:
        assert process.stderr is not None
        lines = iter(process.stderr.readline, "")  # ends with the process, if it fails
        assert any("mg  0°" in line for line in lines), "no dwell was shown"
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=600)[1]
    assert process.returncode == 130
    held = len(load_session(out).dwells)
    assert 0 < held < 24
    assert f"{out}: {held} of 24 dwells" in rest
    if name.endswith("session"):
        with ArchiveView(out) as view:
            assert len(view.dwells()) == held


def program(arguments, room=None):
    """The command line as a process of its own, which heeds Ctrl-C whatever its parent does.

    `room` is the size in bytes beyond which no file grows. The program then keeps no compiled modules:
    Python would write truncated ones, without an error, which no later process can read.
    """
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    if room is not None:
        code += "sys.dont_write_bytecode = True; "
        code += f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room})); "
    code += "from adis_gonio.faces.cli import main; sys.exit(main(sys.argv[1:]))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)


# Outputs


def places(folder, session):
    """Where nothing can be written: arguments, exit status, what is said."""
    (folder / "taken").mkdir()
    return {
        "no folder": (folder / "none" / "page.html", 1, "there is no folder"),
        "a folder": (folder / "taken", 2, "is a folder"),
        "a file for a folder": (session / "page.html", 1, "there is no folder"),
        "the input": (session, 2, "exists already"),
    }


@pytest.mark.parametrize("where", ["no folder", "a folder", "a file for a folder", "the input"])
def test_an_output_that_cannot_be_is_refused_before_any_work(capsys, monkeypatch, two, tmp_path, where):
    output, status, says = places(tmp_path, two)[where]
    monkeypatch.setattr("adis_gonio.record.loading.load_session", lambda path: pytest.fail("it was read"))
    assert main(["report", str(two), "-o", str(output)]) == status
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1
    assert two.read_text(encoding="utf-8") == TWO


def test_a_board_is_not_touched_where_its_page_could_not_be_written(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("adis_gonio.device.bus.open_bus", lambda url: pytest.fail("it was opened"))
    assert main(["bringup", "sim:?seed=1", "-o", str(tmp_path / "none" / "a.html")]) == 1
    assert "there is no folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a.session", "a.csv"])
def test_no_simulation_begins_where_its_file_could_not_be_written(capsys, monkeypatch, tmp_path, name):
    monkeypatch.setattr(
        "adis_gonio.device.sensor.open_sensor", lambda *_, **__: pytest.fail("it was opened")
    )
    assert main(["simulate", "-o", str(tmp_path / "none" / name)]) == 1
    assert "there is no folder" in capsys.readouterr().err


def test_a_full_disk_leaves_the_old_page(tmp_path, two):
    page = tmp_path / "page.html"
    page.write_text("old", encoding="utf-8")
    with program(["report", str(two), "-o", str(page), "--force"], room=2000) as process:
        said = process.communicate(timeout=600)[1]
    assert process.returncode == 1
    assert said.splitlines()[-1] == f"adis-gonio: {page}: cannot be written: File too large"
    assert "Traceback" not in said
    assert page.read_text(encoding="utf-8") == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html", "two.csv"]


def test_a_full_disk_leaves_the_old_page_of_a_board(tmp_path):
    (tmp_path / "a.html").write_text("old", encoding="utf-8")
    arguments = ["bringup", "sim:?seed=1", "-o", str(tmp_path / "a.html"), "--force"]
    with program(arguments, room=10000) as process:  # less than the document and the page
        said = process.communicate(timeout=600)[1]
    assert process.returncode == 1
    assert "a.json: cannot be written: File too large" in said
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == "old"


@pytest.mark.parametrize(
    "command",
    [
        ["selftest", "sim:?seed=3"],
        ["registers", "sim:?seed=3", "SMPL_PRD"],
        ["stream", "sim:?seed=3", "--seconds", "0.1"],
        ["angle", "sim:?seed=3", "--seconds", "0.5"],
        ["calibrate", "sim:?seed=3", "--auto", "--dwell", "1", "-o", "q.session"],
    ],
    ids=lambda command: command[0],
)
def test_every_opening_of_a_sensor_reports_what_it_waits_for(command, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("adis_gonio.device.sensor.driver.CHECK_S", 0.001)
    monkeypatch.chdir(tmp_path)
    assert main(command) == 0
    assert "sim:?seed=3: reads 3 samples, 0 s" in capsys.readouterr().err


def test_a_new_rate_of_a_stream_reports_that_the_filter_settles(capsys):
    assert main(["stream", "sim:?seed=3", "--seconds", "0.1", "--filter", "6", "--rate", "0.413"]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "sim:?seed=3: waits until the filter has settled, 5 min 8 s" in told
    assert "reads 3" not in told
