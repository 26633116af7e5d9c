"""Ctrl-C between two steps loses nothing, and while something is waited for it ends the wait at once."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from adis_gonio.faces.cli.terminal import Interrupt
from programs import running


def test_ctrl_c_within_a_step_lets_it_end_and_breaks_the_next_wait() -> None:
    done, waits = [], iter(range(3))
    with Interrupt() as interrupt:
        for step in interrupt.steps(waits):
            signal.raise_signal(signal.SIGINT)
            done.append(step)
    assert interrupt.asked
    assert done == [0]
    assert list(waits) == [1, 2]


def test_ctrl_c_ends_a_wait_at_once() -> None:
    ended = []

    def waits() -> Iterator[int]:
        yield 0
        signal.raise_signal(signal.SIGINT)
        ended.append(1)
        yield 1

    with Interrupt() as interrupt:
        assert list(interrupt.steps(waits())) == [0]
    assert interrupt.asked
    assert not ended


def test_a_second_ctrl_c_ends_a_step_that_hangs() -> None:
    with Interrupt():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_afterwards_ctrl_c_is_as_before() -> None:
    before = signal.getsignal(signal.SIGINT)
    with Interrupt():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_after_the_work_changes_nothing_of_the_exit_status():
    """As from somebody who presses it while the program goes down."""
    late = (
        "import atexit, os, signal, sys;"
        "from adis_gonio.faces import cli;"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT));"
        "sys.argv[1:] = ['--version'];"
        "cli.run()"
    )
    with running([sys.executable, "-c", late], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        said, complained = program.communicate(timeout=120)
    assert (program.returncode, complained) == (0, "")
    assert "adis-gonio" in said


CAUGHT = """try:
        exec("signal.raise_signal(signal.SIGINT)")
    except KeyboardInterrupt:
        return 130"""
"""As main does, of one that came while a dataclass was being made."""


@pytest.mark.parametrize("work", ["signal.raise_signal(signal.SIGINT)", CAUGHT])
def test_ctrl_c_ends_with_130_and_not_by_the_signal_wherever_it_comes(work, tmp_path):
    lines = [
        "import signal",
        "from adis_gonio.faces import cli",
        "def main():",
        f"    {work}",
        "cli.main = main",
    ]
    (tmp_path / "program.py").write_text("\n".join([*lines, "print('said')", "cli.run()", ""]))
    done = subprocess.run(
        [sys.executable, "-m", "program"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 130, done.stderr
    assert done.stdout == "said\n"
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("ignored", [[], ["trap '' INT;"]])
def test_a_request_to_end_ends_a_program_that_waits_also_if_ctrl_c_is_ignored(tmp_path, ignored):
    """As in the background of a script, whose shell ignores Ctrl-C for it."""
    lines = ["import os, signal, time", "from adis_gonio.faces import cli"]
    lines += ["def main():", "    os.kill(os.getpid(), signal.SIGTERM)", "    time.sleep(300)"]
    (tmp_path / "program.py").write_text("\n".join([*lines, "cli.main = main", "cli.run()", ""]))
    script = " ".join([*ignored, f"exec {sys.executable} -m program"])
    done = subprocess.run(
        ["sh", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False
    )
    assert (done.returncode, done.stderr) == (130, "")
