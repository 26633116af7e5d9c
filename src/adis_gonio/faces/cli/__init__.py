"""The command line: thin commands over the other packages.

Results go to standard output, everything else to standard error. Exit status: 0 done; 1 the job failed; 2
wrong usage. Every failure is one line.
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType

import click

from adis_gonio.base import __version__
from adis_gonio.base.errors import AdisGonioError, BusTimeoutError, ChipError, ProtocolError
from adis_gonio.faces.cli.command_groups import Home, LazyGroup
from adis_gonio.faces.cli.terminal import format_message, replace_missing_letters

# A command's module is imported when the command is called, so that `adis-gonio --help` answers at once.
GROUPS = {
    "Bench commands": {
        "devices": Home("device_commands", "List the buses and the connected devices."),
        "bringup": Home("board_commands", "Check a new board step by step."),
        "calibrate": Home("calibrate_command", "Calibrate a sensor on a stage, position by position."),
        "angle": Home("live_commands", "Show the live angle, raw and corrected, with u."),
        "stream": Home("live_commands", "Show or record the sensor's readings."),
        "registers": Home("device_commands", "List, read and write registers."),
        "frames": Home("device_commands", "List the frames of a recording, decoded."),
        "selftest": Home("device_commands", "Run the sensor's internal self-test."),
        "write": Home("board_commands", "Write a session's biases into the offset registers."),
    },
    "Analysis commands": {
        "fit": Home("fit_commands", "Compute ΔK, Δφ and the other parameters of a session."),
        "trace": Home("trace_commands", "Find the physical effects behind the residual."),
        "report": Home("trace_commands", "Write the calibration report as one HTML page."),
        "allan": Home("fit_commands", "Estimate the noise at rest, with the Allan plot."),
        "plan": Home("plan_commands", "Predict the uncertainty of a plan, or find the best plan."),
    },
    "Commands for many sessions": {
        "archive": Home("archive_commands", "List the sessions in folders."),
        "history": Home("archive_commands", "Show the parameters of one sensor over its sessions."),
        "due": Home("archive_commands", "Compute when a sensor's next calibration is due."),
        "fleet": Home("archive_commands", "Fit and trace many sessions, and summarise them."),
    },
    "Hand-over and simulation commands": {
        "export": Home("handover_commands", "Write a C header, JSON, CSV, certificate, …"),
        "template": Home("plan_commands", "Write an empty samples CSV to fill in by hand."),
        "serve": Home("device_commands", "Serve the sensor as an IIO device over the network."),
        "simulate": Home("plan_commands", "Record a session from the simulated sensor."),
        "paper": Home("handover_commands", "Reproduce the seed paper: its table, figure and claim."),
    },
}
COMMANDS = {name: home for group in GROUPS.values() for name, home in group.items()}


@click.group(cls=LazyGroup, groups=GROUPS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="adis-gonio")
def app() -> None:
    """Driver and calibration tool for the ADIS16354 inertial sensor in a goniometer.

    A sensor is named by a URL such as sim:?seed=1. A SESSION is a file of `calibrate` or `simulate`, or a
    samples CSV. Quote a URL, because the shell interprets ? and &.
    """


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status.

    `arguments` are the words after the program's name; None takes the arguments of the process.
    """
    words = sys.argv[1:] if arguments is None else arguments
    try:
        status = app.main(args=arguments, prog_name="adis-gonio", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return 2
    except click.ClickException as error:
        return _fail(" ".join(error.format_message().split()), error.exit_code)
    except AdisGonioError as error:
        from_device = isinstance(error, BusTimeoutError | ProtocolError | ChipError)
        hint = " (to report it: repeat it with record:run.rec: before the URL and attach run.rec)"
        return _fail(f"{error}{hint if from_device else ''}", error.exit_code)
    except (KeyboardInterrupt, click.Abort) as error:
        return _stopped(error)
    except BrokenPipeError:
        # The reader of the output has gone; keep the interpreter from complaining when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except ValueError as error:
        # LinAlgError of numpy or scipy, recognised by name to avoid importing them here.
        if type(error).__name__ != "LinAlgError":
            raise
        from adis_gonio.base.arrays import unsolvable

        files = " ".join(word for word in words if not word.startswith("-") and Path(word).is_file())
        return _fail(str(unsolvable(files or words[0], error)), 1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    return status if isinstance(status, int) else 0


def _stopped(error: BaseException) -> int:
    if isinstance(error.__cause__, EOFError):
        # click takes the EOFError of a truncated .pyc for the end of input.
        import traceback

        *_, (frame, _) = traceback.walk_tb(error.__cause__.__traceback__)
        if path := frame.f_locals.get("bytecode_path"):
            return _fail(f"{path}: damaged; delete this file", 1)
    return _fail("stopped by the operator; recorded data are kept", 130)


def _fail(message: str, status: int) -> int:
    line = f"adis-gonio: {format_message(message)}"
    if sys.stderr.isatty():
        from adis_gonio.faces.cli.show import say

        say(line)
    else:
        print(line, file=sys.stderr)  # noqa: T201
    return status


def _end(number: int, frame: FrameType | None) -> None:
    """Treat a request to end, or a closed terminal, like Ctrl-C: the sensor's registers are restored."""
    interrupt = signal.getsignal(signal.SIGINT)
    if not callable(interrupt):  # Ctrl-C is ignored, such as in the background
        raise KeyboardInterrupt
    interrupt(number, frame)


def run() -> None:
    """Run the `adis-gonio` program and end the process with its exit status."""
    replace_missing_letters()
    # All matrices here are small: threads of the linear algebra only wait for one another.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Most objects live until the end of the process, which frees them faster than the garbage collector.
    gc.set_threshold(10_000)
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)
    status = 130
    # The exit status is decided here: a late Ctrl-C must not turn it into a death by signal.
    with suppress(KeyboardInterrupt):  # a second one, while main reports the first
        status = main()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if status == 130:
        # If Ctrl-C passed through an `exec` (a dataclass during its import), Python would die by the signal
        # at exit although the exception was caught. Exit by hand.
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)
    gc.freeze()
    sys.exit(status)
