"""Fixtures of the second rig: boards on simavr, the line-level chip, the boot loader's model."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from rig_simavr import build
from rig_simavr.board import Board, violations
from rig_simavr.line_chip import LineChip


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="gonio-rig-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@pytest.fixture(scope="session")
def rig_libraries() -> Path:
    """Folder of libchip.so and libboot.so."""
    if reason := build.missing_compiler():
        pytest.skip(reason)
    return build.make(_folder(), "chip")


@pytest.fixture
def make_board() -> Iterator[Callable[..., Board]]:
    """Starts boards; a sound one has seen no violation at the end, and no page of its flash erased."""
    if reason := build.missing():
        pytest.skip(reason)
    program = build.make(_folder(), "rig") / "rig"
    elf = build.elf(_folder())
    boards: list[Board] = []
    judged: list[Board] = []

    def make(*, sound: bool = True, **options: float | Path) -> Board:
        boards.append(Board(program, elf, **{"seconds": 60, **options}))
        if sound:
            judged.append(boards[-1])
        return boards[-1]

    yield make
    try:
        for board in judged:
            report = board.report()
            assert violations(report) == {}, report["log"]
            assert report["boot"]["page_erases"] == 0
    finally:
        for board in boards:
            board.close()


@pytest.fixture
def line_chip(rig_libraries: Path) -> Iterator[LineChip]:
    """A line-level chip after power-on, in its own time."""
    chip = LineChip(rig_libraries / "libchip.so")
    yield chip
    chip.close()
