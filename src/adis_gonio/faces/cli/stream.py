"""`adis-gonio stream`."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor import DEFAULT_SCAN, Adis16354, open_sensor
from adis_gonio.device.sensor.registers import registers as rows_of
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.interrupt import Interrupt
from adis_gonio.record.blocks import Block, count_alarms
from adis_gonio.record.settings import Settings
from adis_gonio.record.source import SampleStream, has_frames, open_source, refuse_chip_options

if TYPE_CHECKING:
    from adis_gonio.record.samples_writer import SamplesRecorder


@click.command("stream")
@option.url
@click.option("--registers", "names", help="Registers to scan, separated by commas.", metavar="NAME,…")
@option.seconds
@option.shown("--every", "every_s", type=float, default=0.2, help="Screen: s a line.")
@option.output("Record every scan to .csv[.gz].")
@click.option("--rate", "rate_hz", type=float, help="Samples a second (0.413 to 819.2).")
@click.option("--filter", "filter_m", type=int, help="M of the filter: two boxcars of 2^M taps, 0 to 6.")
@click.option("--range", "range_dps", type=int, help="Range of the gyros: 300, 150 or 75 °/s.")
@option.shown("--gravity", "gravity_mps2", type=float, default=9.80665, help="For the file.")
@click.option(
    "--leave-registers", is_flag=True, help="Write nothing: data-ready is used only if it is enabled."
)
@option.poll
@click.option("--json", "as_json", is_flag=True, help="One JSON document with every scan, at the end.")
@option.variant
@option.no_check
def command(
    *,
    url: str,
    names: str | None,
    seconds: float | None,
    every_s: float,
    output: Path | None,
    rate_hz: float | None,
    filter_m: int | None,
    range_dps: int | None,
    gravity_mps2: float,
    leave_registers: bool,
    poll: bool,
    as_json: bool,
    variant: str,
    no_check: bool,
) -> None:
    """Show what the sensor measures, and record it with -o.

    The screen shows the mean and the standard deviation of every value since the line before. The file
    gets every scan; it has no positions, `adis-gonio fit` finds the dwells by stillness.

    Where the bridge can use the sensor's data-ready line, it is enabled in MSC_CTRL while the stream runs
    and set back at its end, Ctrl-C included; where no edge arrives, or with --poll, scans are polled. The
    other registers are left as they are unless --rate, --filter or --range is given.
    """
    if seconds is not None and not seconds > 0:
        raise UsageError(f"--seconds is {seconds:g}: take a time above 0")
    if not every_s > 0:
        raise UsageError(f"--every is {every_s:g}: take a time above 0")
    if as_json and seconds is None:
        raise UsageError("--json needs --seconds: a document has an end")
    options = _Options(names, rate_hz, filter_m, range_dps, leave_registers, poll, variant, no_check)
    options.refuse(url)
    with contextlib.ExitStack() as stack:
        opened = _opened(stack, url, options)
        recorder = None
        if output is not None:
            from adis_gonio.record.samples_writer import SamplesRecorder

            recorder = stack.enter_context(
                SamplesRecorder(output, opened.part, gravity_mps2=gravity_mps2, title=f"stream {url}")
            )
        show = ShownStream(max(1, round(every_s * opened.rate_hz)), recorder, lines=not as_json)
        stack.callback(show.tell_the_sum)  # after a failure too: what came before it stands
        stream = stack.enter_context(opened.stream(min(show.scans_a_line, 1024)))
        click.echo(f"{url}: {opened.rate_hz:.4g} samples/s, {stream.how}", err=True)
        show.run(stream, seconds)
    if as_json:
        show.tell_document()


@dataclass(frozen=True)
class _Options:
    """What is asked of the sensor."""

    names: str | None
    rate_hz: float | None
    filter_m: int | None
    range_dps: int | None
    leave_registers: bool
    poll: bool
    variant: str
    no_check: bool

    @property
    def configures(self) -> bool:
        return not (self.rate_hz is self.filter_m is self.range_dps is None)

    def refuse(self, url: str) -> None:
        """Refuse what excludes one another, and what a source without registers has not."""
        asked: dict[str, object] = {
            "--registers": self.names,
            "--leave-registers": self.leave_registers,
            "--poll": self.poll,
            "--rate": self.rate_hz,
            "--filter": self.filter_m is not None,
            "--range": self.range_dps,
            "--no-check": self.no_check,
        }
        refuse_chip_options(url, asked)
        if self.leave_registers and self.configures:
            raise UsageError(
                "--leave-registers writes nothing, so it excludes --rate, --filter and --range"
            )


@dataclass(frozen=True)
class _Opened:
    """A source of samples: its part, its rate, and how its stream is opened (scans a block)."""

    part: str
    rate_hz: float
    stream: Callable[[int], SampleStream]


def _opened(stack: contextlib.ExitStack, url: str, options: _Options) -> _Opened:
    chosen = tuple(row.name for row in rows_of(options.names.split(","))) if options.names else DEFAULT_SCAN
    if not has_frames(url):
        source = stack.enter_context(open_source(url))
        rate = source.configure(Settings()).sample_rate_hz
        return _Opened(source.part.name, rate, partial(source.samples, Settings()))
    sensor = stack.enter_context(open_sensor(url, variant=options.variant, check=not options.no_check))
    if options.configures:
        sensor.configure(
            sample_rate_hz=options.rate_hz, filter_m=options.filter_m, gyro_range_dps=options.range_dps
        )
    scans = partial(_scans, sensor, chosen, options.leave_registers, options.poll)
    return _Opened(sensor.variant.name, sensor.configuration().sample_rate_hz, scans)


class ShownStream:
    """What is shown and recorded of a stream, with its sums."""

    def __init__(self, scans_a_line: int, recorder: SamplesRecorder | None, *, lines: bool) -> None:
        self.scans_a_line = scans_a_line
        self._recorder = recorder
        self._lines = lines
        self._waiting: list[Block] = []
        self._columns: Columns | None = None
        self._caveat_told = False
        self._scans = self._lost = self._dropped = self._alarms = 0

    def run(self, stream: SampleStream, seconds: float | None) -> None:
        """Take blocks until the time is over, the stream ends, or Ctrl-C."""
        begin: float | None = None
        end = False
        blocks = iter(stream)
        with Interrupt() as interrupt:
            while not end:
                try:
                    with interrupt.waiting():
                        block = next(blocks)
                except StopIteration:
                    break
                except KeyboardInterrupt:
                    click.echo("", err=True)
                    break
                if begin is None and len(block):
                    begin = float(block.time_s[0])
                if seconds is not None and begin is not None:
                    block, end = _until(block, begin + seconds)
                self._add(block, stream.caveat)
                held = sum(map(len, self._waiting))
                # A rest of a few scans would make a line that cannot be compared with the others.
                full = held >= self.scans_a_line or (end and held > self.scans_a_line // 2)
                if self._lines and full and begin is not None:
                    self._line(begin)
                    self._waiting.clear()

    def _add(self, block: Block, caveat: str) -> None:
        if caveat and not self._caveat_told:  # how fast the bus is only its first block shows
            click.echo(caveat, err=True)
            self._caveat_told = True
        self._scans += len(block)
        self._lost += block.lost
        self._dropped += block.dropped
        self._alarms += count_alarms(block)
        if self._recorder is not None:
            if caveat and not self._recorder.rows:
                self._recorder.notes = [caveat]
            self._recorder.add(block)
        if len(block):  # all of a block may be left out, or lie beyond the end
            self._waiting.append(block)

    def _line(self, since_s: float) -> None:
        if self._columns is None:
            first = self._waiting[0]
            self._columns = Columns.fitting(first.registers, first.units, screen_width())
            if self._columns.note:
                click.echo(self._columns.note, err=True)
            click.echo("\n".join(self._columns.heads))
        click.echo(self._columns.line(self._waiting, since_s))

    def tell_the_sum(self) -> None:
        """What came, what was lost, where it was recorded."""
        where = f", recorded in {self._recorder.path}" if self._recorder is not None else ""
        besides = f", {self._dropped} left out without new data (ND)" if self._dropped else ""
        besides += f", {self._alarms} with an error or alarm in STATUS (EA)" if self._alarms else ""
        click.echo(f"{counted(self._scans, 'scan')}, {self._lost} lost{besides}{where}", err=True)

    def tell_document(self) -> None:
        """Every scan as one JSON document."""
        _document(self._waiting, self._lost, self._dropped)


_TIME = 9
_MEANS_TIME = 7
_FULL = 19
_MEANS = 9


def screen_width() -> int | None:
    """Columns of the terminal that standard output is; None where it is none, and any width will do."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


@dataclass(frozen=True)
class Columns:
    """Which values a line shows, and how.

    Attributes
    ----------
    heads : tuple of str
        Lines that stand above the first one.
    shown : int
        Values from the left that find room.
    cell, time_cell : int
        Widths.
    spread : bool
        True where the standard deviation stands beside the mean.
    note : str
        What the screen was too narrow for; empty where it shows all.
    """

    heads: tuple[str, ...]
    shown: int
    cell: int
    time_cell: int
    spread: bool
    note: str = ""

    @classmethod
    def fitting(cls, names: Sequence[str], units: Sequence[str], width: int | None) -> Columns:
        """Columns for registers with their units; first the deviations give way, then the last values."""
        short = [name.removesuffix("_OUT") for name in names]
        units = [unit or "1" for unit in units]
        if width is None or _TIME + _FULL * len(short) <= width:
            pairs = zip(short, units, strict=True)
            head = f"{'time/s':>{_TIME}}" + "".join(f"{f'{name}/{unit}':>{_FULL}}" for name, unit in pairs)
            return cls((head,), len(short), _FULL, _TIME, spread=True)
        cell = max([_MEANS, *(len(name) + 1 for name in short)])
        room = max(1, (width - _MEANS_TIME) // cell)
        left_out = short[room:]
        heads = tuple(
            f"{first:>{_MEANS_TIME}}" + "".join(f"{word:>{cell}}" for word in row[:room])
            for first, row in (("time", short), ("s", units))
        )
        note = f"the screen has {width} columns: means only"
        if left_out:
            note += f", without {', '.join(left_out)} (choose with --registers)"
        return cls(heads, min(room, len(short)), cell, _MEANS_TIME, spread=False, note=note)

    def line(self, blocks: Sequence[Block], since_s: float) -> str:
        """One line of blocks that are not empty; its time is that of their last scan."""
        values = np.concatenate([block.values() for block in blocks])
        time_s = float(blocks[-1].time_s[-1]) - since_s
        cells = [
            f"{mean:.2f} ± {sd:.2f}" if self.spread else f"{mean:.2f}"
            for mean, sd in zip(values.mean(axis=0), values.std(axis=0), strict=True)
        ]
        return f"{time_s:{self.time_cell}.2f}" + "".join(
            f"{cell:>{self.cell}}" for cell in cells[: self.shown]
        )


def _scans(
    sensor: Adis16354, names: tuple[str, ...], leave_registers: bool, poll: bool, block_scans: int
) -> SampleStream:
    data_ready = False if poll else None
    return sensor.stream(
        names, block_scans=block_scans, leave_registers=leave_registers, data_ready=data_ready
    )


def _until(block: Block, end_s: float) -> tuple[Block, bool]:
    """The part of a block before a time, and whether it was reached."""
    keep = int(np.searchsorted(block.time_s, end_s))
    return block.first(keep), keep < len(block)


def _alarms(blocks: list[Block]) -> list[bool] | None:
    """Where an error or alarm stood; None for a sensor that tells of none."""
    told = [block.alarm for block in blocks if block.alarm is not None]
    return [bool(alarm) for part in told for alarm in part] if told or not blocks else None


def _document(blocks: list[Block], lost: int, dropped: int) -> None:
    document = {
        "registers": list(blocks[0].registers) if blocks else [],
        "units": list(blocks[0].units) if blocks else [],
        "time_s": [float(t) for block in blocks for t in block.time_s],
        "values": [[float(value) for value in row] for block in blocks for row in block.values()],
        "alarm": _alarms(blocks),
        "lost": lost,
        "dropped": dropped,
    }
    click.echo(json.dumps(document))
