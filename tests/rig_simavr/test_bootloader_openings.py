"""A board's boot loader reads what is meant for the firmware, at another rate: may it erase the firmware?

The model samples the line as Optiboot's receiver does (boot.c). `scripts/bootloader_openings.py` counts
10 000 openings of each board.
"""

from __future__ import annotations

import pytest

from rig_simavr.bootloader import (
    BOARDS,
    Board,
    BootLoader,
    hello_at_once,
    open_often,
    transport_sends,
    zeros_apart,
    zeros_first,
)

OPENINGS = 150
TRANSPORT_OPENINGS = 60
SLOW_DIVIDER = Board(baud=16e6 / 16 / 9, samples_a_bit=16)
ERASING = range(6703, 6704)
"""Of 40 000 openings of that board this one and 34 517 erase a page."""


@pytest.fixture
def boot_library(rig_libraries):
    return rig_libraries / "libboot.so"


def command(boot_library, data: bytes, board: Board = BOARDS[0]):
    """What a boot loader makes of bytes at its own rate, and when the application starts."""
    boot = BootLoader(boot_library)
    ended_s = boot.open([(0.6, data)], baud=115_200, board=board)
    return boot.seen, ended_s


def test_the_model_knows_a_programmer(boot_library):
    page = b"U\x00\x00 " + b"d\x00\x80F" + bytes(128) + b" "
    seen, ended_s = command(boot_library, b"0 " + page + b"Q ")
    assert (seen.page_erases, seen.page_writes, seen.framing_errors) == (1, 1, 0)
    # 0.6 s, 140 bytes, then 16 ms: leaving ends it at once.
    assert ended_s == pytest.approx(0.6 + 142 * 10 / 115_200 + 0.016, abs=2e-3)


def test_an_erase_needs_four_bytes_and_a_write_the_end_mark(boot_library):
    assert command(boot_library, b"d\x00\x80")[0].page_erases == 0
    unfinished = command(boot_library, b"d\x00\x02F")[0]
    assert (unfinished.page_erases, unfinished.page_writes) == (1, 0)
    wrong_end = command(boot_library, b"d\x00\x02F12X")[0]
    assert (wrong_end.page_erases, wrong_end.page_writes) == (1, 0)


def test_the_application_starts_after_a_second_of_silence_or_16_ms_after_nonsense(boot_library):
    assert command(boot_library, b"")[1] == pytest.approx(0.066 + 0.375 + 1.0, abs=1e-6)
    assert command(boot_library, b"0 ")[1] == pytest.approx(0.6 + 1.0, abs=1e-3)
    assert command(boot_library, b"xy")[1] == pytest.approx(0.6 + 0.016, abs=1e-3)


def test_bytes_wait_while_the_led_blinks_and_the_third_is_overrun(boot_library):
    boot = BootLoader(boot_library)
    boot.open([(0.2, b"d\x00\x02F12 ")], baud=115_200)
    # Two bytes in the buffer and the last of all behind them: no erase.
    assert (boot.seen.bytes, boot.seen.commands, boot.seen.page_erases) == (7, 1, 0)
    boot.open([(0.2, b"d\x00\x02F12 ")], baud=115_200, board=Board(blink_s=0.0))
    assert boot.seen.page_erases == 1


def test_a_hello_sent_at_once_is_a_page_erase_now_and_then(boot_library):
    seen = open_often(boot_library, hello_at_once, SLOW_DIVIDER, ERASING)
    assert seen.page_erases > 0


EACH_BOARD = pytest.mark.parametrize(
    "board", BOARDS, ids=lambda board: f"{board.baud:.0f}-{board.blink_s}-{board.watchdog_s}"
)


@EACH_BOARD
def test_zeros_apart_make_every_boot_loader_leave_before_the_hello(boot_library, board):
    seen = open_often(boot_library, zeros_apart, board, range(OPENINGS))
    # One command each, which two zeros end: it never waits for another.
    assert seen.commands == OPENINGS
    assert (seen.page_erases, seen.page_writes) == (0, 0)
    assert seen.last_start_s < 0.46


@EACH_BOARD
def test_the_transport_as_it_opens_never_lets_a_boot_loader_erase_or_write(boot_library, board):
    seen = open_often(boot_library, transport_sends, board, range(TRANSPORT_OPENINGS))
    assert seen.openings == TRANSPORT_OPENINGS
    assert (seen.page_erases, seen.page_writes) == (0, 0)


def test_a_run_of_zeros_without_gaps_may_keep_a_boot_loader(boot_library):
    """Why they are sent apart: a pair that ends like a command is answered, and the next is waited for."""
    run = open_often(boot_library, zeros_first, SLOW_DIVIDER, range(OPENINGS))
    assert run.commands > OPENINGS


@EACH_BOARD
def test_zeros_and_a_wait_erase_nothing_and_outlast_the_boot_loader(boot_library, board):
    seen = open_often(boot_library, zeros_first, board, range(OPENINGS))
    assert seen.openings == OPENINGS
    assert seen.bytes > OPENINGS
    assert (seen.page_erases, seen.page_writes) == (0, 0)
    assert seen.last_start_s < 2.0 + 0.3
