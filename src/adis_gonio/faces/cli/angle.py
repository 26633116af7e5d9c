"""`adis-gonio angle`."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from pathlib import Path

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.interrupt import Interrupt
from adis_gonio.live.angle_smoother import LAG_S
from adis_gonio.live.live_angle import LiveAngle, LiveBlocks, LiveSource, live_angles, open_live

INTERRUPTED = 130
NOTES = {
    "gap": "gap",
    "saturated": "too fast for the gyro",
    "out_of_plane": "turned out of the plane",
    "calibration": "the calibration does not fit",
    "gyro_calibration": "the gyros' calibration does not fit",
}
"""Notes of the smoothed angle in words."""


@click.command("angle")
@option.url
@option.seconds
@option.file(
    "--cal",
    "calibration_path",
    metavar="FILE",
    help="Correct by this: a calibration (export, JSON), or a session, which is fitted.",
)
@option.shown(
    "--lag",
    "lag_s",
    type=float,
    default=LAG_S,
    metavar="SECONDS",
    help="How far the smoothed angle stays behind; 0: as soon as can be.",
)
@click.option(
    "--no-gyro", is_flag=True, help="By gravity alone: fewer registers to read, no smoothed angle."
)
@option.shown(
    "--reconnect",
    "patience_s",
    type=float,
    default=30.0,
    metavar="SECONDS",
    help="Try so long to open a sensor again whose link broke; 0: end.",
)
@option.poll
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line, ten a second.")
@option.variant
@option.no_check
def command(
    *,
    url: str,
    calibration_path: Path | None,
    seconds: float | None,
    lag_s: float,
    no_gyro: bool,
    patience_s: float,
    poll: bool,
    as_json: bool,
    variant: str,
    no_check: bool,
) -> int:
    """Show the live angle about gravity, ten times a second.

    The angle is positive for the stage's positive turn, within ±180°. It comes first by gyros and gravity
    together, a lag behind and without the shaking that gravity alone has (not without gyros, or with
    --no-gyro); then by gravity alone. Without --cal it is 0 where X reads +1 g, and its uncertainty u is
    that of noise and motion alone. With --cal angles are corrected, as the calibrated stage counts, with u
    of noise and calibration together; the raw one follows.

    The sensor's settings stay as they are; data-ready is borrowed as `stream` borrows it.
    """
    if seconds is not None and not seconds > 0:
        raise UsageError(f"--seconds is {seconds:g}: take a time above 0")
    if not patience_s >= 0:
        raise UsageError(f"--reconnect is {patience_s:g}: take 0 or more")
    calibration = None
    if calibration_path is not None:  # before the sensor is opened: a fit takes a moment
        from adis_gonio.tracing.trace_calibrations import load_calibration

        calibration = load_calibration(calibration_path)

    def opened() -> AbstractContextManager[LiveSource]:
        data_ready = False if poll else None
        return open_live(url, variant=variant, check=not no_check, data_ready=data_ready, gyros=not no_gyro)

    def broken(error: Exception) -> None:
        click.echo(f"{error}; trying again for {patience_s:g} s", err=True)

    with closing(LiveBlocks(opened, patience_s, broken, time.sleep)) as blocks:
        source = blocks.source
        rate = f"{source.measuring.sample_rate_hz:.4g} samples/s"
        click.echo(f"{url}: {rate}, {source.stream.how}", err=True)
        last_s = math.inf if seconds is None else seconds - source.measuring.sample_period_s
        line = _Line(as_json=as_json)
        try:
            ended = _run(live_angles(blocks, calibration, lag_s=lag_s), line, last_s)
        finally:
            line.end()
    return 0 if ended or seconds is None else INTERRUPTED


def _run(angles: Iterator[LiveAngle], line: _Line, last_s: float) -> bool:
    """Show readings until the time is over or the samples end; False where Ctrl-C ended it."""
    with Interrupt() as interrupt:
        while True:
            try:
                with interrupt.waiting():
                    reading = next(angles)
            except StopIteration:
                return True
            except KeyboardInterrupt:
                return False
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
    smoothed = reading.smoothed
    by_gravity = reading.angle_deg if reading.corrected_deg is None else reading.corrected_deg
    main, u_deg = by_gravity, reading.u_deg
    if smoothed is not None:
        main, u_deg = smoothed.smoothed_deg, smoothed.smoothed_u_deg
    u = "" if u_deg is None else f" ± {u_deg:.3f}"
    parts = [f"{main:+9.3f}{u}°"]
    if smoothed is not None:
        parts += [", ".join(NOTES[note] for note in smoothed.notes)] if smoothed.notes else []
        parts.append(f"gravity {by_gravity:+9.3f}°")
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
