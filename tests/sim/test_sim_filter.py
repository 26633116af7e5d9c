"""The Bartlett filter, seen from outside: the data sheet's table, every output register, gyro ranges."""

import numpy as np
import pytest

from adis_gonio.sim import Inputs
from adis_gonio.sim.sampling import bartlett_sums
from sim.chip_rig import Host, Quiet, signed

RATE = 819.2
TABLE = {  # M: taps, -3 dB in Hz, gain of white noise, delay and settling in samples
    0: (1, None, 1.000, 0, 1),
    1: (2, 149, 0.612, 1, 3),
    2: (4, 67.3, 0.415, 3, 7),
    3: (8, 32.9, 0.290, 7, 15),
    4: (16, 16.4, 0.204, 15, 31),
    5: (32, 8.17, 0.144, 31, 63),
    6: (64, 4.08, 0.102, 63, 127),
}
OUTPUTS = (0x02, 0x04, 0x06, 0x08, 0x0A, 0x0C, 0x0E, 0x10, 0x12, 0x14, 0x16)


class Scripted:
    """Gives row k of a table of all eleven inputs, in LSB, at update k; the last row for ever after."""

    SIZES = np.array([1.8315e-3] + [0.07326] * 3 + [0.4672] * 3 + [0.1453] * 3 + [0.6105e-3])

    def __init__(self, rows_lsb):
        self.rows = np.asarray(rows_lsb, float) * self.SIZES
        self.at = 0

    def sample(self, time_s):
        rows = self.rows[np.minimum(np.arange(self.at, self.at + len(time_s)), len(self.rows) - 1)]
        self.at += len(time_s)
        return Inputs(rows[:, 4:7], rows[:, 1:4], rows[:, 7:10] + 25.0, rows[:, 0], rows[:, 10])


def response(m, rows_lsb, address, bits):
    """Numbers of a register at each update of a scripted input."""
    host = Host(Scripted(rows_lsb), start=False, flash={"SENS_AVG": 0x0400 | m})
    host.now = 0.150 + 0.5 / RATE
    host.send(address << 8)
    numbers = []
    for _ in range(len(rows_lsb)):
        host.now = 0.150 + (len(numbers) + 1.2) / RATE
        numbers.append(host.read(address))
    return np.array([signed(word, bits) if bits == 14 else word & 0xFFF for word in numbers])


def impulse_response(m):
    """Answer of XACCL_OUT to an impulse of one sample, per LSB."""
    taps = 1 << m
    size = 8000 * taps if m else 8000
    rows = np.zeros((2 * taps + 4, 11))
    rows[2, 4] = size
    return response(m, rows, 0x0A, 14) / size


@pytest.mark.parametrize("m", TABLE)
def test_noise_gain_delay_and_corner_are_those_of_the_table(m):
    _, corner_hz, gain, delay, settling = TABLE[m]
    answer = impulse_response(m)
    assert answer.sum() == pytest.approx(1, rel=1e-3)
    assert np.sqrt((answer**2).sum()) == pytest.approx(gain, rel=0.01)
    centre = (np.arange(len(answer)) * answer).sum() / answer.sum() - 2
    assert centre == pytest.approx(delay, rel=0.01, abs=1e-3)
    assert np.count_nonzero(answer) == settling
    if corner_hz is not None:
        phase = np.exp(-2j * np.pi * corner_hz / RATE * np.arange(len(answer)))
        assert abs(phase @ answer) == pytest.approx(np.sqrt(0.5), rel=0.01)
        low, high = (
            abs(np.exp(-2j * np.pi * f * corner_hz / RATE * np.arange(len(answer))) @ answer)
            for f in (0.99, 1.01)
        )
        assert high < np.sqrt(0.5) < low


@pytest.mark.parametrize("m", TABLE)
def test_a_step_has_settled_after_the_samples_of_the_table_and_not_one_earlier(m):
    settling = TABLE[m][4]
    rows = np.zeros((settling + 4, 11))
    rows[2:, 4] = 8000
    answer = response(m, rows, 0x0A, 14)
    settled = np.flatnonzero(answer == 8000)
    assert settled[0] - 2 == settling - 1


@pytest.mark.parametrize("column", range(11))
def test_every_output_register_is_filtered_alike(column):
    address = OUTPUTS[column]
    bits = 14 if 0x04 <= address <= 0x0E else 12
    rows = np.zeros((20, 11))
    rows[3:, column] = 1600
    answer = response(2, rows, address, bits)
    expected = np.convolve(rows[:, column], np.array([1, 2, 3, 4, 3, 2, 1]) / 16)[: len(rows)]
    assert answer.tolist() == expected.tolist()


def test_the_filter_equals_two_convolutions_with_a_boxcar():
    rng = np.random.default_rng(5)
    for m in range(7):
        n = 1 << m
        samples = rng.integers(-(10**6), 10**6, (2 * n - 2 + 50, 2))
        box = np.ones(n, int)
        expected = [np.convolve(np.convolve(c, box), box)[2 * n - 2 : len(samples)] for c in samples.T]
        assert (bartlett_sums(samples, m) == np.array(expected).T).all()


def test_the_filter_runs_at_the_rate_of_smpl_prd():
    host = Host(Quiet(accel_mg=lambda t: np.where(t[:, None] >= 1.0, [1000.0, 0, 0], [0.0, 0, 0])))
    host.write(0x36, 0x0F)  # 16 bases of 1/1638.4 s: 102.4 a second
    host.now = 1.0 + 3.5 / 102.4  # the fourth update after the step at M = 2 has 10 of its 16 weights
    assert signed(host.read(0x0A), 14) == pytest.approx(2140 * 10 / 16, abs=2140 * 4.1 / 16)
    host.now = 1.0 + 7.5 / 102.4
    assert signed(host.read(0x0A), 14) == 2140


@pytest.mark.parametrize(
    ("smpl_prd", "rate_hz"),
    [(0x01, 819.2), (0x09, 163.84), (0x0A, 148.945), (0x80, 52.85), (0xFF, 0.41290), (0x00, 819.2)],
)
def test_sample_rates_of_the_table(smpl_prd, rate_hz):
    host = Host(flash={"SMPL_PRD": smpl_prd})
    host.wait(20.0)
    host.send(0)
    steps = np.diff(host.world.times)
    assert 1 / steps.mean() == pytest.approx(rate_hz, rel=1e-4)


@pytest.mark.parametrize(("code", "dps_per_lsb", "m"), [(4, 0.07326, 0), (2, 0.03663, 2), (1, 0.018315, 4)])
def test_gyro_ranges_change_the_size_of_an_lsb(code, dps_per_lsb, m):
    host = Host(Quiet(gyro_dps=(50.0, -50.0, 10.0)), flash={"SENS_AVG": code << 8 | m})
    for address, rate in ((0x04, 50.0), (0x06, -50.0), (0x08, 10.0)):
        assert signed(host.read(address), 14) == round(rate / dps_per_lsb)


@pytest.mark.parametrize(
    ("word", "dps_per_lsb", "taps"),
    [
        (0x0200, 0.03663, 4),
        (0x0201, 0.03663, 4),
        (0x0100, 0.018315, 16),
        (0x0103, 0.018315, 16),
        (0x0407, 0.07326, 64),
        (0x0000, 0.07326, 1),
        (0x0702, 0.07326, 4),
    ],
)
def test_illegal_settings_act_as_documented(word, dps_per_lsb, taps):
    step = Quiet(
        accel_mg=lambda t: np.where(t[:, None] >= 1.0, [3500.0, 0, 0], [0.0, 0, 0]), gyro_dps=(9.0, 0, 0)
    )
    host = Host(step, flash={"SENS_AVG": word})
    assert host.read(0x38) == word
    host.settle(130)
    assert signed(host.read(0x04), 14) == round(9.0 / dps_per_lsb)
    updates = 2 * taps - 2  # after so many the step has not yet settled; the first comes 0.68 periods in
    host.now = 1.0 + (updates - 0.1) / RATE
    assert signed(host.read(0x0A), 14) < 7491
    host.now = 1.0 + (updates + 0.9) / RATE
    assert signed(host.read(0x0A), 14) == 7491


@pytest.mark.parametrize(("address", "data"), [(0x38, 0x05), (0x39, 0x02), (0x36, 0x02)])
def test_a_new_filter_or_rate_starts_from_empty_taps(address, data):
    host = Host(Quiet(accel_mg=(1000.0, 0, 0)), flash={"SENS_AVG": 0x0406})
    host.settle(130)
    assert signed(host.read(0x0A), 14) == 2140
    host.write_low(address, data)
    host.settle(20)
    assert signed(host.read(0x0A), 14) < 1000
    host.settle(130)
    assert signed(host.read(0x0A), 14) == 2140


def test_writing_what_stands_there_leaves_the_taps_alone():
    host = Host(Quiet(accel_mg=(1000.0, 0, 0)))
    for address, word in ((0x36, 0x01), (0x38, 0x02)):
        host.write_low(address, word)
        host.settle(1.5)
        assert signed(host.read(0x0A), 14) == 2140


@pytest.mark.parametrize(("number", "word"), [(500, 0x1F4), (-1000, 0xC18), (-1, 0xFFF), (2047, 0x7FF)])
def test_accelerometer_offsets_are_added_and_have_twelve_bits(number, word):
    host = Host(Quiet(accel_mg=(0.0, 0.0, 0.0)))
    for k in range(3):
        host.write(0x20 + 2 * k, word)
    host.settle(10)
    assert [signed(host.read(0x0A + 2 * k), 14) for k in range(3)] == [number] * 3


@pytest.mark.parametrize(("number", "word"), [(400, 0x190), (-4, 0x1FFC), (-4096, 0x1000), (4095, 0xFFF)])
@pytest.mark.parametrize(("code", "m", "divide"), [(4, 2, 4), (2, 2, 2), (1, 4, 1)])
def test_gyro_offsets_have_thirteen_bits_and_the_lsb_of_the_smallest_range(number, word, code, m, divide):
    host = Host(Quiet(), flash={"SENS_AVG": code << 8 | m})
    host.write(0x1C, word)
    host.settle(70)
    assert signed(host.read(0x06), 14) == pytest.approx(number / divide, abs=0.5)
    assert signed(host.read(0x04), 14) == 0


@pytest.mark.parametrize("number", [2730, 2731])
def test_unused_bits_of_a_register_of_twelve_bits_are_never_zero(number):
    host = Host(Quiet(supply_v=number * 1.8315e-3))
    host.settle(20)
    word = host.read(0x02)
    assert word & 0x0FFF == number
    assert word & 0x3000 == (0x3000 if number % 2 else 0x1000), "a driver has to mask them"


def test_an_offset_acts_at_once_since_it_is_added_after_the_filter():
    host = Host(Quiet(accel_mg=(0.0, 0.0, 0.0)), flash={"SENS_AVG": 0x0406})
    host.write(0x20, 0x0100)
    host.settle(2)
    assert signed(host.read(0x0A), 14) == 0x100
