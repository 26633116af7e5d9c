"""Lines of `stream`: they fit the screen, and a block without a scan is no error."""

import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.live_commands import Columns, ShownStream
from adis_gonio.record.blocks import ValueBlock

NAMES = (
    "XACCL_OUT",
    "YACCL_OUT",
    "ZACCL_OUT",
    "XGYRO_OUT",
    "YGYRO_OUT",
    "ZGYRO_OUT",
    "XTEMP_OUT",
    "SUPPLY_OUT",
)
UNITS = ("mg",) * 3 + ("°/s",) * 3 + ("°C", "V")


def blocks(*lengths: int) -> Iterator[ValueBlock]:
    start = 0
    for length in lengths:
        time_s = 0.01 * np.arange(start, start + length)
        yield ValueBlock(("ax", "ay", "az"), np.full((length, 3), -1234.567), time_s)
        start += length


class Stream:
    caveat = ""

    def __init__(self, *lengths: int) -> None:
        self._blocks = blocks(*lengths)

    def __iter__(self) -> Iterator[ValueBlock]:
        return self._blocks


def shown(capsys: pytest.CaptureFixture[str], seconds: float | None, *lengths: int) -> list[str]:
    show = ShownStream(10, None)
    show.run(Stream(*lengths), seconds)
    show.print_totals()
    return capsys.readouterr().out.splitlines()


def test_the_end_between_two_blocks_is_no_error(capsys):
    # 6 scans wait for their line when the time ends just before the next block.
    assert len(shown(capsys, 0.055, 6, 6)) == 2


@pytest.mark.parametrize("lengths", [(0, 0, 10), (0, 10, 0), (5, 0, 5)])
def test_blocks_without_a_scan_are_no_error(capsys, lengths):
    assert len(shown(capsys, 1.0, *lengths)) == 2


def test_a_stream_without_a_scan_shows_none(capsys):
    assert shown(capsys, 1.0, 0, 0) == []


def widest(width: int | None) -> tuple[Columns, int]:
    columns = Columns(NAMES, UNITS, width)
    block = ValueBlock(("ax",) * 8, np.full((4, 8), -1234.567), np.full(4, 7200.0))
    return columns, max(map(len, [*columns.heads, columns.line([block], 0.0)]))


@pytest.mark.parametrize("width", [79, 80, 100, 120, 160, 161, 200])
def test_nothing_is_wider_than_the_screen(width):
    columns, widest_line = widest(width)
    assert widest_line <= width
    assert columns.spread == (width >= 161)
    assert all("SUPPLY" in head or "V" in head for head in columns.heads)


def test_a_file_gets_means_and_deviations_of_all():
    columns, width = widest(None)
    assert columns.spread
    assert width == 161


@contextmanager
def terminal(width: int) -> Iterator[int]:
    import fcntl
    import termios

    outer, inner = os.openpty()
    fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", 24, width, 0, 0))
    try:
        yield inner
    finally:
        os.close(inner)
        os.close(outer)


@pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")
def test_the_width_is_the_terminals(monkeypatch, tmp_path, capfd):
    monkeypatch.delenv("COLUMNS", raising=False)
    with terminal(82) as screen:
        out = os.fdopen(os.dup(screen), "w", encoding="utf-8")
        monkeypatch.setattr(sys, "__stdout__", out)  # shutil.get_terminal_size asks this one
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        assert main(["stream", "sim:?seed=1", "--seconds", "0.5"]) == 0
        out.close()
    captured = capfd.readouterr()
    assert max(map(len, captured.out.splitlines())) <= 82
