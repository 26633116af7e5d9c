"""`adis-gonio angle`."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from pathlib import Path

import click

from adis_gonio.cli.interrupt import Interrupt
from adis_gonio.cli.show import no_check_option, poll_option, variant_option
from adis_gonio.errors import UsageError
from adis_gonio.session.angle import AngleMeter, LiveAngle, LiveSource, calibration_for, open_live

INTERRUPTED = 130


@click.command("angle")
@click.argument("url")
@click.option("--seconds", type=float, help="Stop after so long; without it, at Ctrl-C.")
@click.option(
    "--cal",
    "calibration_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Correct by this: a calibration (export, JSON), or a session, which is fitted.",
)
@poll_option
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line, ten a second.")
@variant_option
@no_check_option
def command(
    *,
    url: str,
    calibration_path: Path | None,
    seconds: float | None,
    poll: bool,
    as_json: bool,
    variant: str,
    no_check: bool,
) -> int:
    """Show the live angle about gravity, ten times a second.

    The angle is positive for the stage's positive turn, within ±180°. Without --cal it is 0 where X reads
    +1 g, and its uncertainty u is that of the noise within the newest samples alone. With --cal the
    corrected angle comes first, as the calibrated stage counts, with u of noise and calibration together;
    the raw one follows.

    The sensor's settings stay as they are; data-ready is borrowed as `stream` borrows it.
    """
    if seconds is not None and not seconds > 0:
        raise UsageError(f"--seconds is {seconds:g}: take a time above 0")
    calibration = None
    if calibration_path is not None:  # before the sensor is opened: a fit takes a moment
        from adis_gonio.calibration import load_calibration

        calibration = load_calibration(calibration_path)
    with open_live(url, variant=variant, check=not no_check, data_ready=False if poll else None) as source:
        rate = f"{source.measuring.sample_rate_hz:.4g} samples/s"
        click.echo(f"{url}: {rate}, {source.stream.how}", err=True)
        if calibration is not None:
            calibration = calibration_for(calibration, source)
        meter = AngleMeter(source.measuring, source.noise_mg, source.step_mg, calibration)
        line = _Line(as_json=as_json)
        try:
            ended = _run(source, meter, line, seconds)
        finally:
            line.end()
    return 0 if ended or seconds is None else INTERRUPTED


def _run(source: LiveSource, meter: AngleMeter, line: _Line, seconds: float | None) -> bool:
    """Show readings until the time is over or the samples end; False where Ctrl-C ended it."""
    blocks = iter(source.stream)
    last_s = math.inf if seconds is None else seconds - source.measuring.sample_period_s
    with Interrupt() as interrupt:
        while True:
            try:
                with interrupt.waiting():
                    block = next(blocks)
            except StopIteration:
                return True
            except KeyboardInterrupt:
                return False
            reading = meter.feed(block)
            if reading is None:
                continue
            line.show(reading)
            if reading.time_s >= last_s:
                return True


class _Line:
    """One line that changes in place on a terminal, a new line each elsewhere."""

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._in_place = not as_json and sys.stdout.isatty()
        self._began_s: float | None = None

    def show(self, reading: LiveAngle) -> None:
        if self._as_json:
            click.echo(json.dumps(reading.as_dict()))
        elif not self._in_place:
            click.echo(angle_text(reading))
        else:
            width = shutil.get_terminal_size().columns
            click.echo(f"\r{angle_text(reading, width - 1)}\x1b[K", nl=False)
            self._keep_pace(reading.time_s)

    def end(self) -> None:
        if self._in_place and self._began_s is not None:
            click.echo()

    def _keep_pace(self, time_s: float) -> None:
        """Let a simulated sensor, whose time costs nothing, go no faster than somebody can read."""
        now_s = time.monotonic()
        if self._began_s is None:
            self._began_s = now_s - time_s
        time.sleep(max(0.0, self._began_s + time_s - now_s))


def angle_text(reading: LiveAngle, width: int | None = None) -> str:
    """A reading as one line no wider than `width`: what is said last is left out first."""
    main = reading.angle_deg if reading.corrected_deg is None else reading.corrected_deg
    u = "" if reading.u_deg is None else f" ± {reading.u_deg:.3f}"
    parts = [f"{main:+9.3f}{u}°"]
    if reading.corrected_deg is not None:
        parts.append(f"raw {reading.angle_deg:+9.3f}°")
    spread = "" if reading.spread_mg is None else f" ({reading.spread_mg:.1f} mg)"
    state = {True: "still ", False: "moving", None: "…     "}[reading.still]
    parts.append(f"{state}{spread}")
    if reading.temperature_c is not None:
        parts.append(f"{reading.temperature_c:.1f} °C")
    if reading.lost:
        parts.append(f"{reading.lost} lost")
    text = parts[0]
    for part in parts[1:]:
        if width is not None and len(text) + 3 + len(part) > width:
            break
        text += f"   {part}"
    return text if width is None else text[: max(width, 0)]
