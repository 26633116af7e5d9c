"""A data line that dies, a slow sample rate, and a bus that answers with too few words."""

import math

import numpy as np
import pytest

from adis_gonio import open_bus
from adis_gonio.base.errors import (
    BusError,
    ChipError,
    ProtocolError,
    SilentChipError,
    UsageError,
    VerifyError,
    one_line,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.scanning import LONGEST_EXCHANGE_S
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from fakes.buses import RecordingBus
from fakes.faulty_chip import FaultyBus, Window


class FailingLine(RecordingBus):
    """A simulated bus whose data line may be stuck; measures the time of each exchange.

    Attributes
    ----------
    stuck : int or None
        Word of each reply while the line is stuck.
    longest_s : float
        Simulated time of the longest exchange.
    change : callable
        Changes the replies of one exchange.
    """

    def __init__(self, url: str = "sim:?seed=4") -> None:
        super().__init__(open_bus(url))
        self.stuck: int | None = None
        self.longest_s = 0.0
        self.change = lambda frames, replies: replies

    def _exchange(self, frames):
        began_s = self.now_s()
        replies = super()._exchange(frames)
        self.longest_s = max(self.longest_s, self.now_s() - began_s)
        if self.stuck is not None:
            return np.full(len(frames), self.stuck, np.uint16)
        return self.change(frames, replies)


@pytest.mark.parametrize("level", [0x0000, 0xFFFF])
@pytest.mark.parametrize("url", ["sim:?seed=4", "sim:?seed=4&stream=0"])
def test_a_line_that_sticks_between_two_streams_is_an_error_of_the_chip(level, url):
    bus = FailingLine(url)
    sensor = Adis16354(bus)
    sensor.read_scans(20)
    bus.stuck = level
    with pytest.raises(SilentChipError, match="nothing answers"):
        sensor.read_scans(20)
    assert bus.longest_s <= LONGEST_EXCHANGE_S


@pytest.mark.parametrize("stream", [0, 1])
@pytest.mark.parametrize("smpl_prd", [0x01, 0x20])
@pytest.mark.parametrize("line", ["high", "low"])
def test_no_stream_yields_the_ones_or_zeros_of_a_line_that_sticks_while_it_runs(line, smpl_prd, stream):
    bus = FaultyBus(BusUrl.parse(f"faulty:?seed=4&stream={stream}"))
    sensor = Adis16354(bus)
    sensor.configure(smpl_prd=smpl_prd)
    bus.chip.windows.append(Window(bus.now_s() + 1.0, math.inf, line, deaf=False))
    with pytest.raises(ChipError), sensor.stream(block_scans=4) as blocks:  # noqa: PT012
        stuck = 0
        for block in blocks:
            stuck += int((block.words == 0xFFFF).all(axis=1).sum())
            assert stuck < 8
            assert bus.now_s() < 60


@pytest.mark.parametrize("level", [0x0000, 0xFFFF])
def test_a_self_test_on_a_dead_line_is_not_passed(level):
    bus = FailingLine()
    sensor = Adis16354(bus)
    assert not sensor.self_test().self_test_failures
    bus.stuck = level
    with pytest.raises(ChipError):
        sensor.self_test()


@pytest.mark.parametrize(
    "wrong",
    [
        lambda replies: replies >> 1,
        lambda replies: replies >> 1 | 0x8000,
        lambda replies: replies << 1,
        lambda replies: replies << 1 | 1,
        lambda replies: ~replies,
    ],
    ids=["late", "late-1", "early", "early-1", "inverted"],
)
def test_a_self_test_on_a_shifted_or_inverted_line_is_not_passed(wrong):
    bus = FailingLine()
    bus.change = lambda frames, replies: wrong(replies)
    sensor = Adis16354(bus, check=False)
    with pytest.raises(ChipError, match="not allowed"):
        sensor.self_test()
    assert bus.writes == []


@pytest.mark.parametrize("word", [0x0000, 0xFFFF, 0x0201])
def test_a_content_of_sens_avg_that_is_not_allowed_is_no_stuck_line(word):
    bus = FailingLine()
    bus.inner.chip.memory["SENS_AVG"] = word
    sensor = Adis16354(bus)
    assert not sensor.configuration().allowed
    assert sensor.endurance() == 0
    assert sensor.read_checked(["SENS_AVG", "MSC_CTRL"]) == [word, 0]
    with pytest.raises(ChipError, match=f"SMPL_PRD 0x01.*M = {word & 7} are not"):
        sensor.self_test()
    sensor.write("SENS_AVG", 0x0402)
    assert sensor.self_test().word == 0


@pytest.mark.parametrize("level", [0x0000, 0xFFFF])
@pytest.mark.parametrize("places", [(3, 1), (2, 2)])
def test_a_line_that_sticks_within_a_reading_is_read_again(places, level):
    bus = FailingLine()
    sensor = Adis16354(bus)
    left = [*places]

    def stick(frames, replies):
        if left:
            replies[left.pop() :] = level
        return replies

    bus.change = stick
    assert sensor.endurance() == 0
    assert not left


@pytest.mark.parametrize("level", [0x0000, 0xFFFF])
def test_a_session_on_a_dead_line_fails_as_a_job_and_not_as_wrong_usage(level, tmp_path):
    bus = FailingLine()
    sensor = Adis16354(bus)
    bus.stuck = level
    with pytest.raises((ChipError, BusError)) as caught:
        list(SessionRunner.begin(sensor, tmp_path / "dead.session", plan("two-position"), Settings()).run())
    assert caught.value.exit_code == 1
    assert not isinstance(caught.value, UsageError)


def test_a_slow_sample_rate_is_read_in_exchanges_of_at_most_a_second():
    bus = FailingLine("sim:?seed=4&stream=0")
    sensor = Adis16354(bus)
    sensor.configure(smpl_prd=0xFF)
    bus.longest_s = 0.0
    with sensor.stream(block_scans=256) as stream:
        block = next(stream)
    assert len(block.time_s) >= 1
    assert 0 < bus.longest_s <= LONGEST_EXCHANGE_S


@pytest.mark.parametrize("period", [0xFF, 0x00, 0x81])
def test_a_period_that_was_misread_once_is_read_again(period):
    bus = FailingLine()
    sensor = Adis16354(bus)
    truth = sensor.configuration().sample_period_s
    left = [1]

    def misread(frames, replies):
        asked = np.flatnonzero(frames[:-1] == 0x3600)
        if asked.size and left:
            left.pop()
            replies[asked[0] + 1] = period
        return replies

    bus.change = misread
    assert sensor.configuration().sample_period_s == truth
    assert not left


def test_registers_that_differ_each_time_are_not_believed():
    bus = FailingLine()
    sensor = Adis16354(bus)
    rng = np.random.default_rng(1)

    def noise(frames, replies):
        asked = np.flatnonzero(frames[:-1] == 0x3600)
        replies[asked + 1] = rng.integers(1, 0xFE, asked.size)
        return replies

    bus.change = noise
    with pytest.raises(VerifyError, match="differently"):
        sensor.configuration()


def test_one_false_reading_of_the_counter_does_not_prove_a_flash_update():
    bus = FailingLine("sim:?seed=4&supply_v=4.6")  # below 4.75 V the flash is not written
    sensor = Adis16354(bus)
    sensor.write("XACCL_OFF", 40)
    seen = []

    def misread(frames, replies):
        asked = np.flatnonzero(frames[:-1] == 0x0000)
        if any(frame == 0xBE08 for frame in bus.frames) and asked.size:
            if not seen:
                replies[asked[0] + 1] += 1
            seen.append(asked.size)
        return replies

    bus.change = misread
    with pytest.raises(VerifyError, match="ENDURANCE was 0 and is 0"):
        sensor.save_to_flash()
    assert seen


@pytest.mark.parametrize(
    "wrong",
    [
        lambda replies: replies[:-1],
        lambda replies: replies[:0],
        lambda replies: np.append(replies, 0),
        lambda replies: replies.astype(float),
        lambda replies: replies.astype(int) + 0x10000,
        lambda replies: None,
        lambda replies: [[1, 2], [3]],
    ],
)
def test_a_bus_that_answers_with_other_words_than_asked_is_a_protocol_error(wrong):
    bus = FailingLine()
    sensor = Adis16354(bus)
    bus.change = lambda frames, replies: wrong(replies)
    for act in (
        lambda: sensor.read_words(["SMPL_PRD"]),
        lambda: sensor.read("XACCL_OUT"),
        lambda: bus.exchange_array(np.array([0x3800, 0x3800], np.uint16)),
    ):
        with pytest.raises(ProtocolError, match="the bus answered"):
            act()


def test_a_bus_may_answer_with_a_list_of_integers():
    bus = FailingLine()
    sensor = Adis16354(bus)
    expected = sensor.read("SENS_AVG")
    bus.change = lambda frames, replies: replies.tolist()
    assert sensor.read("SENS_AVG") == expected


@pytest.mark.parametrize("text", ["a\nb", "a\x1b[31mb", "a\r\tb", "a\x00b", "a\u2028b"])
def test_texts_of_devices_and_errors_are_one_printable_line(text):
    device = Device(f"serial:{text}", text)
    for shown in (device.url, device.description, str(ProtocolError(text)), one_line(text)):
        assert shown.isprintable()
        assert shown.endswith("b")
