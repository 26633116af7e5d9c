"""The commands `stream` and `angle`: the readings of a sensor as they come."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from adis_gonio.base.numbers import counted, format_fixed, signed
from adis_gonio.base.uncertainty import NORMAL_95
from adis_gonio.device.sensor import DEFAULT_SCAN, open_sensor
from adis_gonio.device.sensor.registers import registers
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import opened, report_waits, say
from adis_gonio.faces.cli.terminal import Interrupt
from adis_gonio.live.live_angle import LiveAngle, live_angles, open_live
from adis_gonio.live.motion_model import LAG_S
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.blocks import Block, count_alarms
from adis_gonio.record.source import SampleStream, Settings, has_frames, open_source, refuse_chip_options

if TYPE_CHECKING:
    from adis_gonio.record.samples_writer import SamplesRecorder

INTERRUPTED = 130
LINE_S = 0.2
"""Time in s that one line of a stream summarises."""
NOTES = {
    "gap": "gap",
    "saturated": "too fast for the gyro",
    "out_of_plane": "turned out of the plane",
    "calibration": "the calibration does not fit",
    "gyro_calibration": "the gyros' calibration does not fit",
    "alarm": "error or alarm in STATUS",
}
"""Text for each note that an angle may carry, by the name of the note."""
MISFIT = (
    "this calibration contradicts gravity at rest: it is of another part, or the part has changed; U"
    " includes the difference"
)


@option.command(
    "stream",
    "--seconds --output --registers",
    {"Measuring": "--rate --filter --range --poll --leave-registers", "File": "--gravity"},
)
@option.url
@click.option("--registers", "names", help="Registers to scan, separated by commas.", metavar="NAME,…")
@option.seconds
@option.output("Record every scan to .csv[.gz].")
@click.option("--rate", "rate_hz", type=float, metavar="HZ", help="Samples per second, 0.413 to 819.2.")
@click.option(
    "--filter", "filter_m", type=int, metavar="M", help="Filter: two passes of 2^M taps, M from 0 to 6."
)
@click.option(
    "--range", "range_dps", type=int, metavar="DPS", help="Range of the gyros: 300, 150 or 75 °/s."
)
@option.gravity("Local gravity in m/s² for the file.", default=STANDARD_GRAVITY_MPS2, show_default=True)
@option.flag("--leave-registers", help="Write nothing; use data-ready only if it is already enabled.")
@option.poll
@option.variant
@option.no_check
def stream_command(
    *,
    url: str,
    names: str | None,
    seconds: float | None,
    output: Path | None,
    gravity_mps2: float,
    **chip: Any,
) -> None:
    """Show the sensor's readings, and record them with -o.

    Each line on the screen shows the mean and the standard deviation of every value since the previous
    line. The file gets every scan. It has no positions; `adis-gonio fit` finds the dwells by stillness.

    If the bridge can use the sensor's data-ready line, the command enables it in MSC_CTRL during the stream
    and sets it back at the end, also after Ctrl-C. Without edges, or with --poll, it polls the scans. The
    other registers are unchanged unless --rate, --filter or --range is given.
    """
    # A file that exists when the command begins is one that --force may replace.
    force = output is not None and output.exists()
    with contextlib.ExitStack() as stack:
        part, configured, open_stream = _open_stream(stack, url, names, chip)
        rate_hz, filter_m = configured["sample_rate_hz"], configured.get("filter_m")
        recorder = None
        if output is not None:
            from adis_gonio.record.samples_writer import SamplesRecorder

            title = f"stream {url}"
            recorder = SamplesRecorder(
                output, part, gravity_mps2=gravity_mps2, title=title, filter_m=filter_m, force=force
            )
            stack.enter_context(recorder)
        show = ShownStream(max(1, round(LINE_S * rate_hz)), recorder)
        stack.callback(show.print_totals)  # also after a failure: the earlier scans remain
        stream = stack.enter_context(open_stream(min(show.scans_a_line, 1024)))
        say(f"{url.removesuffix(':')}: {rate_hz:.4g} samples/s, {stream.how}")
        show.run(stream, seconds)


def _open_stream(
    stack: contextlib.ExitStack, url: str, names: str | None, chip: dict[str, Any]
) -> tuple[str, dict[str, Any], Callable[[int], SampleStream]]:
    """Open a sensor; return its variant, its configuration, and a function that starts the stream.

    The function takes the number of scans in a block. `stack` closes the sensor; `names` are the registers
    to scan, separated by commas, None for the default ones; `chip` has the other options of `stream`, None
    if not given.
    """
    configured_by = ("rate_hz", "filter_m", "range_dps")
    own = ("names", "leave_registers", "poll", "no_check", *configured_by)
    refuse_chip_options(url, option.given_flags(*own))
    if chip["leave_registers"]:
        option.refuse(configured_by, "--leave-registers writes nothing")
    scan = tuple(row.name for row in registers(names.split(","))) if names else DEFAULT_SCAN
    if not has_frames(url):
        source = stack.enter_context(open_source(url))
        configured = source.configure(Settings()).as_dict()
        return source.part.name, configured, partial(source.samples, Settings())
    check = not chip["no_check"]
    sensor = stack.enter_context(opened(open_sensor, url, variant=chip["variant"], check=check))
    rate_hz, filter_m, range_dps = (chip[name] for name in configured_by)
    if not (rate_hz is filter_m is range_dps is None):
        with report_waits(url):
            sensor.configure(sample_rate_hz=rate_hz, filter_m=filter_m, gyro_range_dps=range_dps)

    def stream(block_scans: int) -> SampleStream:
        return sensor.stream(
            scan,
            block_scans=block_scans,
            leave_registers=chip["leave_registers"],
            data_ready=False if chip["poll"] else None,
        )

    return sensor.variant.name, sensor.configuration().as_dict(), stream


class ShownStream:
    """Shows the scans of a stream, records them if wanted, and counts them.

    Parameters
    ----------
    scans_a_line : int
        Number of scans that one printed line summarises.
    recorder : SamplesRecorder or None
        Recorder of every scan; None does not record.
    """

    def __init__(self, scans_a_line: int, recorder: SamplesRecorder | None) -> None:
        self.scans_a_line = scans_a_line
        self._recorder = recorder
        self._waiting: list[Block] = []
        self._columns: Columns | None = None
        self._caveat_printed = False
        self._scans = self._lost = self._dropped = self._alarms = 0

    def run(self, stream: SampleStream, seconds: float | None) -> None:
        """Read blocks and show their values until the time is over, the stream ends, or Ctrl-C.

        `seconds` is the time to show; None has no limit.
        """
        begin: float | None = None
        end = False
        with Interrupt() as interrupt:
            for block in interrupt.steps(iter(stream)):
                if begin is None and len(block):
                    begin = float(block.time_s[0])
                if seconds is not None and begin is not None:
                    # Cut the block at the end of the asked time.
                    keep = int(np.searchsorted(block.time_s, begin + seconds))
                    block, end = block.first(keep), keep < len(block)
                self._add(block, stream.caveat)
                held = sum(map(len, self._waiting))
                # A remainder of a few scans would make a line that cannot be compared with the others.
                full = held >= self.scans_a_line or (end and held > self.scans_a_line // 2)
                if full and begin is not None:
                    self._line(begin)
                    self._waiting.clear()
                if end:
                    break
        if interrupt.asked:
            click.echo("", err=True)

    def _add(self, block: Block, caveat: str) -> None:
        if caveat and not self._caveat_printed:  # the speed of the bus is known after the first block
            say(caveat)
            self._caveat_printed = True
        self._scans += len(block)
        self._lost += block.lost
        self._dropped += block.dropped
        self._alarms += count_alarms(block)
        if self._recorder is not None and len(block):
            if caveat and not self._recorder.rows:
                self._recorder.notes = [caveat]
            self._recorder.add(block)
        if len(block):  # a block can be empty if its scans were dropped or lie beyond the end
            self._waiting.append(block)

    def _line(self, since_s: float) -> None:
        if self._columns is None:
            first = self._waiting[0]
            width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
            self._columns = Columns(first.registers, first.units, width)
            click.echo("\n".join(self._columns.heads))
        click.echo(self._columns.line(self._waiting, since_s))

    def print_totals(self) -> None:
        """Print the number of scans, the number of lost scans, and the recorded file if any."""
        recorder = self._recorder
        where = (
            f", {counted(recorder.rows, 'row')} in {recorder.path}" if recorder and recorder.rows else ""
        )
        more = f", {self._dropped} left out without new data (ND)" if self._dropped else ""
        more += f", {self._alarms} with an error or alarm in STATUS (EA)" if self._alarms else ""
        say(f"{counted(self._scans, 'scan')}, {self._lost} lost{more}{where}")


class Columns:
    """Layout of the table that shows a stream, one line for each interval.

    A screen too narrow for the standard deviations shows the means alone; 80 columns have room for the
    default registers.

    Parameters
    ----------
    names, units : sequence of str
        Names of the registers, and the unit of each, empty without one.
    width : int or None
        Width of the screen in characters; None is unlimited.

    Attributes
    ----------
    heads : list of str
        Lines above the first line of values.
    spread : bool
        True if the standard deviation is shown next to the mean.
    """

    def __init__(self, names: Sequence[str], units: Sequence[str], width: int | None) -> None:
        short = [name.removesuffix("_OUT") for name in names]
        units = [unit or "1" for unit in units]
        self._time, self._cell = 9, 19
        self.spread = width is None or self._time + self._cell * len(short) <= width
        rows = [("time/s", *map("/".join, zip(short, units, strict=True)))]
        if not self.spread:
            self._time, self._cell = 7, max(9, *(len(name) + 1 for name in short))
            rows = [("time", *short), ("s", *units)]
        self.heads = [self._row(*row) for row in rows]

    def _row(self, time: str, *cells: str) -> str:
        return f"{time:>{self._time}}" + "".join(f"{cell:>{self._cell}}" for cell in cells)

    def line(self, blocks: Sequence[Block], since_s: float) -> str:
        """Format the scans of some blocks as one line of means, with the time of the last scan.

        `since_s` is the time of the stream's first scan, subtracted from the printed time.
        """
        values = np.concatenate([block.values() for block in blocks])
        cells = [
            f"{format_fixed(mean, 2)} ({sd:.2f})" if self.spread else format_fixed(mean, 2)
            for mean, sd in zip(values.mean(axis=0), values.std(axis=0), strict=True)
        ]
        return self._row(f"{float(blocks[-1].time_s[-1]) - since_s:.2f}", *cells)


@option.command("angle", "--cal --seconds --json")
@option.url
@option.seconds
@option.file(
    "--cal", "calibration_path",
    help="Correct the angle by a calibration (export, JSON) or by the fit of a session.",
)  # fmt: skip
@option.with_default(
    "--lag", "lag_s", type=float, default=LAG_S, metavar="SECONDS",
    help="Delay of the smoothed angle; 0: the smallest possible.",
)  # fmt: skip
@option.flag("--no-gyro", help="Use gravity alone: fewer registers to read, no smoothed angle.")
@option.poll
@option.flag("--json", "as_json", help="Write one JSON object per line, ten per second.")
@option.variant
@option.no_check
def angle_command(
    *,
    url: str,
    calibration_path: Path | None,
    seconds: float | None,
    lag_s: float,
    no_gyro: bool,
    poll: bool,
    as_json: bool,
    variant: str,
    no_check: bool,
) -> int:
    """Show the live angle about gravity, ten times a second.

    The angle is positive for the stage's positive turn, within ±180°. The first value combines gyros and
    gravity: it comes with a lag and without the noise from shaking (not without gyros, or with --no-gyro).
    The second value uses gravity alone. Without --cal, the angle is 0 if X reads +1 g, and its uncertainty
    u covers only noise and motion. With --cal, the angles are corrected to the scale of the calibrated
    stage, u covers noise and calibration, and the raw angle follows. If the length of gravity at rest
    contradicts the calibration (another part?), a message comes first and the exit status is 1.

    The sensor's settings are unchanged; data-ready is enabled only during the stream.
    """
    calibration = None
    if calibration_path is not None:  # before the sensor is opened, because a fit takes a moment
        from adis_gonio.tracing.trace_calibrations import load_calibration

        calibration = load_calibration(calibration_path)

    chip = {"variant": variant, "check": not no_check, "data_ready": False if poll else None}
    with opened(open_live, url, gyros=not no_gyro, **chip) as source:
        rate = f"{source.measuring.sample_rate_hz:.4g} samples/s"
        say(f"{url.removesuffix(':')}: {rate}, {source.stream.how}; angles ± U (95 %)")
        last_s = math.inf if seconds is None else seconds - source.measuring.sample_period_s
        line = _AngleLine(as_json=as_json)
        try:
            ended = _show_angles(
                live_angles(source, calibration, lag_s=lag_s), line, last_s, calibration_path
            )
        finally:
            line.end()
    if line.contradicted:
        return 1
    return 0 if ended or seconds is None else INTERRUPTED


def _show_angles(
    angles: Iterator[LiveAngle], line: _AngleLine, last_s: float, calibration: Path | None
) -> bool:
    """Show angles until the time `last_s` is reached or the samples end; return False after Ctrl-C.

    The first angles wait until it is known if the sensor rests, so that a message that the file
    `calibration` does not fit comes before them.
    """
    waiting: list[LiveAngle] = []
    with Interrupt() as interrupt:
        for reading in interrupt.steps(angles):
            waiting.append(reading)
            ended = reading.time_s >= last_s
            if calibration is not None and reading.still is None and not ended:
                continue
            if "calibration" in reading.notes and not line.contradicted:
                line.contradicted = True
                say(f"{calibration}: {MISFIT}")
            for one in waiting:
                line.show(one)
            waiting.clear()
            if ended:
                return True
        for one in waiting:
            line.show(one)
        return not interrupt.asked


class _AngleLine:
    """Printer of live angles: on a terminal one line that changes in place, else a line for each angle."""

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._in_place = not as_json and sys.stdout.isatty()
        self._began_s: float | None = None
        self.contradicted = False
        """True if a reading contradicted the calibration."""

    def show(self, reading: LiveAngle) -> None:
        if self._as_json:
            click.echo(json.dumps(reading.as_dict()))
        elif not self._in_place:
            click.echo(format_angle(reading))
        else:
            width = shutil.get_terminal_size().columns
            click.echo(f"\r{format_angle(reading, width - 1)}\x1b[K", nl=False)
            # A simulated sensor, which needs no time, must not run faster than a person can read.
            now_s = time.monotonic()
            if self._began_s is None:
                self._began_s = now_s - reading.time_s
            time.sleep(max(0.0, self._began_s + reading.time_s - now_s))

    def end(self) -> None:
        if self._in_place and self._began_s is not None:
            click.echo()


def format_angle(reading: LiveAngle, width: int | None = None) -> str:
    """Format an angle as one line; details at its end are left out if it would exceed `width`.

    Without a width (None) the line has all details.
    """
    smoothed = reading.smoothed
    by_gravity = reading.angle_deg if reading.corrected_deg is None else reading.corrected_deg
    main, u_deg = by_gravity, reading.u_deg
    if smoothed is not None:
        main, u_deg = smoothed.smoothed_deg, smoothed.smoothed_u_deg
    u = "" if u_deg is None else f" ± {NORMAL_95 * u_deg:.3f}"
    parts = [f"{signed(main, 3):>9}{u}°"]
    notes = reading.notes if smoothed is None else smoothed.notes
    if notes:
        parts.append(", ".join(NOTES[note] for note in notes))
    if smoothed is not None:
        parts.append(f"gravity {signed(by_gravity, 3):>9}°")
    if reading.corrected_deg is not None:
        parts.append(f"raw {signed(reading.angle_deg, 3):>9}°")
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
