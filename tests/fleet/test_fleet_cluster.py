"""A real scheduler and workers of dask as processes of their own, one of which is killed."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from adis_gonio import load_session
from adis_gonio.faces.cli import main
from adis_gonio.fleet.session_record import Job, Options
from adis_gonio.fleet.workers import Cluster
from adis_gonio.tracing.joint_trace import trace_sessions
from fleet.sessions import kept_in, write_fleet
from fleet.test_fleet_command import FLEET, SOON_S, until
from programs import running

if find_spec("distributed") is None:  # its import would take each collection half a second
    pytest.skip("distributed is not installed", allow_module_level=True)
PAGE = Path(__file__).parents[2] / "docs" / "many_sessions.md"
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


class Dask:
    """A scheduler without workers."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        about = folder / "scheduler.json"
        # dask may write beside itself nowhere else.
        self.scheduler = self._started(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", about
        )
        limit = time.monotonic() + SOON_S
        while not (about.exists() and about.read_text("utf-8").strip().endswith("}")):
            assert time.monotonic() < limit, "the scheduler does not start"
            time.sleep(0.05)
        self.address = json.loads(about.read_text("utf-8"))["address"]

    def worker(self, **environment: str) -> subprocess.Popen[str]:
        """A worker with one thread and nobody to start it again."""
        return self._started(
            "worker",
            self.address,
            "--nthreads",
            "1",
            "--no-nanny",
            "--local-directory",
            self._folder,
            **environment,
        )

    def _started(self, *arguments: object, **environment: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "dask", *map(str, arguments), "--no-dashboard"]
        return self._stack.enter_context(running(command, env={**os.environ, **environment}, **QUIET))


@contextmanager
def dask(folder: Path) -> Iterator[Dask]:
    with ExitStack() as stack:
        made = Dask(folder, stack)
        yield made
        for program in (made.scheduler,):
            program.kill()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[Dask]:
    """A scheduler for all tests that leave it alive."""
    with dask(tmp_path_factory.mktemp("dask")) as made:
        yield made


@pytest.fixture(scope="module")
def worker(cluster) -> Iterator[subprocess.Popen[str]]:
    """A worker that the tests from its first use on share; the first test needs a scheduler without one."""
    started = cluster.worker(OPENBLAS_NUM_THREADS="1")
    yield started
    started.kill()


def test_a_worker_of_another_version_and_a_cluster_without_any_are_said(tmp_path, cluster):
    files = write_fleet(tmp_path / "fleet", 1, seed=11)
    old = tmp_path / "old" / "adis_gonio"
    old.mkdir(parents=True)
    (old / "__init__.py").write_text('__version__ = "0.0.1"\n')
    empty = subprocess.run(
        [*FLEET, *files, "--scheduler", cluster.address],
        capture_output=True, text=True, timeout=SOON_S, check=False,
    )  # fmt: skip
    foreign = cluster.worker(PYTHONPATH=str(old.parent))
    other = subprocess.run(
        [*FLEET, *files, "--scheduler", cluster.address],
        capture_output=True, text=True, timeout=SOON_S, check=False,
    )  # fmt: skip
    foreign.kill()
    assert (empty.returncode, other.returncode) == (1, 1)
    assert f"the scheduler at {cluster.address} has no worker: start some" in empty.stderr
    assert "adis-gonio 0.0.1, here is adis-gonio" in other.stderr
    assert "Traceback" not in empty.stderr + other.stderr


def test_a_worker_killed_in_the_middle_loses_nothing_and_changes_nothing(tmp_path, cluster, worker):
    write_fleet(tmp_path / "fleet", 10, seed=10)
    out, journal = tmp_path / "a.json", tmp_path / "a.json.journal"
    killed = cluster.worker()
    command = [*FLEET, str(tmp_path / "fleet"), "--scheduler", cluster.address, "-o", str(out)]
    with running(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as program:
        until(journal, 3, program)
        killed.kill()
        at_death = len(kept_in(journal))
        _, said = program.communicate(timeout=SOON_S)
    assert program.returncode == 0, said
    assert at_death < 10, "it was killed after the work"
    assert len(kept_in(journal)) == 10
    assert main(["fleet", "--no-trace", str(tmp_path / "fleet"), "-o", str(tmp_path / "local.json")]) == 0
    assert out.read_bytes() == (tmp_path / "local.json").read_bytes()


def test_a_record_that_cannot_be_read_here_is_a_row_with_its_reason(tmp_path, monkeypatch, cluster, worker):
    class Foreign:  # such as a number of another version of NumPy
        def __reduce__(self):
            return eval, ("1 / 0",)

    monkeypatch.setattr("adis_gonio.fleet.workers.work", lambda *_: Foreign())
    with Cluster(cluster.address) as client:
        (record,) = client.results([Job("a.csv", "0")], Options())
    assert record.reason == "a.csv: its workers failed: division by zero"


def test_a_scheduler_that_goes_away_ends_the_run_with_a_line_and_what_was_done_is_kept(tmp_path):
    write_fleet(tmp_path / "fleet", 10, seed=12)
    journal = tmp_path / "a.json.journal"
    with dask(tmp_path) as cluster:
        worker = cluster.worker()
        command = [
            *FLEET, str(tmp_path / "fleet"), "--scheduler", cluster.address, "-o", str(tmp_path / "a.json"),
        ]  # fmt: skip
        with running(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as program:
            until(journal, 2, program)
            cluster.scheduler.kill()
            _, said = program.communicate(timeout=SOON_S)
        worker.kill()
    assert program.returncode == 1
    assert (
        said.strip().splitlines()[-1].startswith(f"adis-gonio: the scheduler at {cluster.address} has gone")
    )
    assert len(kept_in(journal)) >= 2


def test_the_joint_traces_of_the_page_run_on_a_cluster_and_are_those_of_this_process(
    tmp_path, cluster, worker
):
    files = write_fleet(tmp_path / "fleet", 4, seed=13)
    sessions = [files[:2], files[2:]]
    (block,) = (
        text for text in re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
        if "trace_sessions" in text
    )  # fmt: skip
    names = {"sessions": sessions}
    exec(block.replace("tcp://127.0.0.1:8786", cluster.address), names)
    here = trace_sessions([load_session(file) for file in sessions[1]]).as_dict()
    assert len(names["results"]) == 2
    assert json.dumps(names["results"][1]) == json.dumps(here)
