"""The command line: thin commands over the packages below.

Results go to standard output, everything else to standard error. Exit status: 0 done; 1 the job failed;
2 wrong usage. Every failure is one line.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path

import click

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.version import __version__
from adis_gonio.faces.cli.characters import make_readable, message_line
from adis_gonio.faces.cli.interrupt import Insistent
from adis_gonio.faces.cli.lazy import LazyGroup

# Commands are imported when they are called: `adis-gonio --help` answers at once.
COMMANDS = {
    "plan": (
        "adis_gonio.faces.cli.plan",
        "Say what a plan of positions will reach, and find the best one.",
    ),
    "calibrate": ("adis_gonio.faces.cli.calibrate", "Calibrate a sensor on a stage, position by position."),
    "fit": ("adis_gonio.faces.cli.fit", "Compute ΔK, Δφ and the other parameters of a recorded session."),
    "trace": ("adis_gonio.faces.cli.trace", "Find the physical effects behind the residual of a session."),
    "allan": (
        "adis_gonio.faces.cli.allan",
        "Say the noise of gyros or accelerometers at rest, with the Allan plot.",
    ),
    "report": ("adis_gonio.faces.cli.report", "Write the calibration report as one HTML page."),
    "archive": (
        "adis_gonio.faces.cli.archive",
        "List the sessions in folders, by serial number and stage.",
    ),
    "history": ("adis_gonio.faces.cli.history", "Show what became of a sensor over its sessions."),
    "due": ("adis_gonio.faces.cli.due", "Say when a sensor is to be calibrated next, and why."),
    "fleet": ("adis_gonio.faces.cli.fleet", "Fit and trace many sessions, and summarise them."),
    "simulate": ("adis_gonio.faces.cli.simulate", "Record a session from the simulated sensor."),
    "export": ("adis_gonio.faces.cli.export", "Hand a session over: C header, JSON, CSV, certificate, …"),
    "template": ("adis_gonio.faces.cli.template", "Make an empty samples CSV to fill in by hand."),
    "stream": ("adis_gonio.faces.cli.stream", "Show or record what the sensor measures."),
    "angle": (
        "adis_gonio.faces.cli.angle",
        "Show the live angle, raw and corrected, with its uncertainty.",
    ),
    "registers": ("adis_gonio.faces.cli.registers", "List, read and write registers."),
    "write": ("adis_gonio.faces.cli.write", "Write a session's biases into the sensor's offset registers."),
    "selftest": ("adis_gonio.faces.cli.selftest", "Run the sensor's internal self-test."),
    "bringup": (
        "adis_gonio.faces.cli.bringup",
        "Check a new board step by step, and what it says of the part.",
    ),
    "serve": ("adis_gonio.faces.cli.serve", "Serve the sensor as an IIO device over the network."),
    "paper": ("adis_gonio.faces.cli.paper", "Reproduce the seed paper: its table, its figure, its claim."),
    "devices": ("adis_gonio.faces.cli.devices", "List the buses and the devices that are connected."),
}


_COMPUTING = frozenset({"fit", "trace", "report", "export", "paper", "plan", "fleet", "allan"})
"""Commands that compute: they have nothing to put back when Ctrl-C ends them."""


@click.group(
    cls=LazyGroup, commands_by_name=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, prog_name="adis-gonio")
def app() -> None:
    """Driver and calibration tool for the ADIS16354 inertial sensor in a goniometer.

    A sensor is named by a URL such as sim:?seed=1, a SESSION is a file of `calibrate` or `simulate`, or
    a samples CSV. Quote URLs: the shell reads ? and & itself.
    """


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    computing = words[:1] and words[0] in _COMPUTING
    try:
        with Insistent() if computing else nullcontext():
            status = app.main(args=arguments, prog_name="adis-gonio", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return 2
    except click.ClickException as error:
        return _fail(" ".join(error.format_message().split()), error.exit_code)
    except AdisGonioError as error:
        return _fail(str(error), error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        return _fail("stopped by the operator; what was recorded is kept", 130)
    except BrokenPipeError:
        # Whoever read our output has gone; keep the interpreter from complaining at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except ValueError as error:
        # Of numpy or scipy, whose import costs more than the commands that do not compute.
        if type(error).__name__ != "LinAlgError":
            raise
        from adis_gonio.base.arrays import unsolvable

        files = " ".join(word for word in words if not word.startswith("-") and Path(word).is_file())
        return _fail(str(unsolvable(files or words[0], error)), 1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    return status if isinstance(status, int) else 0


def _fail(message: str, status: int) -> int:
    print(f"adis-gonio: {message_line(message)}", file=sys.stderr)  # noqa: T201
    return status


def run() -> None:
    """Entry point of the `adis-gonio` program."""
    make_readable()
    status = 130
    # What the exit status says is decided: a late Ctrl-C must not turn it into a death by signal.
    with suppress(KeyboardInterrupt):  # as main ends, while it tells of another one
        status = main()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if status == 130:
        # A Ctrl-C that passed an `exec` (of a dataclass that is being imported) has marked Python to die by
        # the signal at its end, although it was caught.
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)
    sys.exit(status)
