"""Host code of another making against a board that it opens as a serial port."""

import pytest
from tilt_bench.registers import Board

from adis_gonio.testing import Faults

SMPL_PRD, SENS_AVG, YACCL_OUT = 0x36, 0x38, 0x0C


@pytest.fixture
def board(simulated_board):
    host = Board(simulated_board.path)
    yield host
    host.close()


def test_it_reads_what_the_part_has_after_power_on(board):
    assert board.read_register(SMPL_PRD) == 0x0001
    assert board.read_register(SENS_AVG) == 0x0402


@pytest.mark.adis_gonio(url="sim:?seed=2&move_speed_dps=720")
def test_it_sees_the_part_turn(board, simulated_board):
    def y_lsb():
        word = board.read_register(YACCL_OUT) & 0x3FFF
        return word - 0x4000 if word & 0x2000 else word

    before = y_lsb()
    simulated_board.stage.move_to(90)
    assert abs(before) < 600
    assert y_lsb() < -1900, "level with Y down it reads about -2140 LSB"


@pytest.mark.adis_gonio(faults=Faults(seed=1, flip=1.0))
def test_a_noisy_line_never_gives_a_wrong_word(simulated_board):
    with pytest.raises(OSError):  # noqa: PT011 (a checksum, a time-out or a refusal)
        Board(simulated_board.path, timeout_s=2).read_register(SENS_AVG)
