"""The simulated bus: virtual time, streams, the stage, opening by URL."""

import time

import numpy as np
import pytest

from adis_gonio.base.errors import BusClosedError, BusTimeoutError, UsageError
from adis_gonio.device.bus import Capability, SpiTiming, find_devices, open_bus
from adis_gonio.device.bus.host import SAFE_TIMING
from adis_gonio.sim import SimBus, World, WorldSettings
from sim.chip_rig import signed

FAST = SpiTiming(1e6, 9.0, 40.0)
READS = [a << 8 for a in (0x0A, 0x0C, 0x0E, 0x10)]


@pytest.fixture
def bus():
    with SimBus(World(seed=2)) as opened:
        yield opened


def on(bus):
    bus.configure(FAST)
    bus.exchange([0xB404])
    return bus


def test_an_exchange_takes_as_long_as_its_frames(bus):
    assert bus.timing == SAFE_TIMING == SpiTiming(250e3, 75.0, 160.0)
    start = bus.now_s()
    bus.exchange([0] * 100)
    assert bus.now_s() - start == pytest.approx(100 * 160e-6)
    bus.configure(FAST)
    bus.exchange([0] * 100)
    assert bus.now_s() - start == pytest.approx(100 * 160e-6 + 100 * 40e-6)


@pytest.mark.parametrize(
    ("stall_us", "period_us", "step_s"), [(5000.0, 0.0, 5.016e-3), (9.0, 7000.0, 7e-3)]
)
def test_the_first_frame_of_an_exchange_keeps_stall_and_period_from_the_one_before(
    bus, stall_us, period_us, step_s
):
    bus.configure(SpiTiming(1e6, stall_us, period_us))
    starts, frames_at = [], bus.chip.frames_at
    bus.chip.frames_at = lambda words, starts_s, **options: (
        starts.extend(starts_s) or frames_at(words, starts_s, **options)
    )
    for _ in range(3):
        bus.exchange([0x3800] * 2)
    assert np.diff(starts) == pytest.approx([step_s] * 5)


def test_events_are_counted_since_the_last_call(bus):
    on(bus)
    bus.read_event_counter()
    for _ in range(2):
        bus.sleep_s(0.5)
        assert bus.read_event_counter() == pytest.approx(0.5 * 819.2, abs=1)


def test_waiting_costs_no_time(bus):
    before = time.monotonic()
    start = bus.now_s()
    bus.sleep_s(600.0)
    assert bus.now_s() - start == 600.0
    bus.exchange([0x0A00, 0])
    assert time.monotonic() - before < 600


def test_the_chip_runs_at_opening(bus):
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_the_bus_refuses_no_timing_and_the_chip_answers_for_it(bus):
    bus.configure(SpiTiming(1e6, 5.0, 0.0))
    assert set(bus.exchange([0x3800] * 5)[1:]) == {0xFFFF}
    bus.configure(SAFE_TIMING)
    assert bus.exchange([0x3800, 0])[1] == 0xFFFF
    bus.hard_reset()
    bus.sleep_s(0.2)
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_negative_sleep_is_refused(bus):
    bus.sleep_s(0.0)
    for wrong in (-1.0, float("nan")):
        with pytest.raises(UsageError):
            bus.sleep_s(wrong)


def test_a_stream_equals_reading_the_registers_at_the_edges():
    streamed, polled = on(SimBus(World(seed=4))), on(SimBus(World(seed=4)))
    with streamed.stream(READS, block_scans=50) as stream:
        block = next(stream)
    for edge, words in zip(block.time_s, block.words, strict=True):
        polled.sleep_s(edge + 2e-6 - polled.now_s())
        assert polled.exchange([*READS, 0])[1:] == words.tolist()


def test_streams_do_not_depend_on_the_size_of_blocks():
    whole, parts = on(SimBus(World(seed=4))), on(SimBus(World(seed=4)))
    with whole.stream(READS, block_scans=300) as stream:
        expected = next(stream)
    with parts.stream(READS, block_scans=25) as stream:
        blocks = [next(stream) for _ in range(12)]
    assert (np.concatenate([block.words for block in blocks]) == expected.words).all()
    assert np.concatenate([block.time_s for block in blocks]) == pytest.approx(expected.time_s, abs=1e-9)


def test_time_that_passes_between_blocks_is_buffered(bus):
    on(bus)
    with bus.stream(READS, block_scans=100) as stream:
        first = next(stream)
        bus.sleep_s(0.05)
        second = next(stream)
    assert second.time_s[0] - first.time_s[-1] == pytest.approx(1 / 819.2)
    assert second.lost == 0


def test_edges_that_nobody_read_are_counted_as_lost(bus):
    on(bus)
    with bus.stream(READS, block_scans=10) as stream:
        first = next(stream)
        bus.sleep_s(0.5)
        bus.read_event_counter()  # the chip lives on to answer
        second = next(stream)
    skipped = round((second.time_s[0] - first.time_s[-1]) * 819.2) - 1
    assert skipped > 400
    assert second.lost == skipped


def test_a_read_list_longer_than_the_period_loses_edges_and_says_how_many(bus):
    bus.exchange([0xB404])
    with bus.stream([0x0A00] * 10, block_scans=20) as stream:  # 11 frames of 160 us: 1.76 ms of 1.22 ms
        block = next(stream)
    assert np.diff(block.time_s) == pytest.approx(2 / 819.2)
    assert block.lost == 20


def test_a_stream_follows_smpl_prd():
    bus = SimBus(World(seed=1))
    bus.exchange([0xB601 + 2, 0xB404])
    with bus.stream(READS, block_scans=10) as stream:
        block = next(stream)
    assert np.diff(block.time_s) == pytest.approx(4 / 1638.4)


def test_a_stream_needs_the_chips_pin_to_toggle(bus):
    with pytest.raises(BusTimeoutError, match=r"MSC_CTRL\[2\]"):
        bus.stream(READS)
    bus.exchange([0])
    on(bus)
    bus.configure(SpiTiming(1e6, 1.0, 0.0))
    bus.exchange([0] * 4)
    with pytest.raises(BusTimeoutError), bus.stream(READS) as stream:
        next(stream)


def test_edges_before_a_stream_are_not_delivered(bus):
    on(bus)
    bus.sleep_s(1.0)
    start = bus.now_s()
    with bus.stream(READS, block_scans=5) as stream:
        assert next(stream).time_s[0] > start


def test_edges_of_a_stream_are_counted(bus):
    on(bus)
    bus.read_event_counter()
    with bus.stream(READS, block_scans=64) as stream:
        for _ in range(4):
            next(stream)
    assert bus.read_event_counter() in (256, 257)


def test_a_block_needs_a_scan(bus):
    on(bus)
    with pytest.raises(UsageError, match="block"):
        bus.stream(READS, block_scans=0)


def test_a_move_of_the_stage_takes_time_and_shows_on_the_gyro_and_the_accelerometers(bus):
    on(bus)
    start = bus.now_s()
    bus.stage.move_to(90.0)
    assert bus.now_s() - start == pytest.approx(2.0)
    bus.sleep_s(3.0)
    x, y, z = (signed(word, 14) * 0.4672 for word in bus.exchange([*READS[:3], 0])[1:])
    assert abs(x) < 200
    assert y == pytest.approx(-1000, abs=60)
    assert z == pytest.approx(0, abs=60)
    assert bus.stage.angle_deg == pytest.approx(90.0)
    bus.stage.orient((0, 0, -1))
    bus.sleep_s(3.0)
    assert signed(bus.exchange([0x0E00, 0])[1], 14) * 0.4672 == pytest.approx(-1000, abs=60)


def test_the_samples_of_a_move_come_out_of_a_stream(bus):
    on(bus)
    with bus.stream([0x0800, 0x0A00], block_scans=400) as stream:
        still = np.mean([signed(int(word), 14) for word in next(stream).words[:, 0]]) * 0.07326
        bus.stage.move_to(90.0)
        words = np.concatenate([next(stream).words for _ in range(6)])
    rate = np.array([signed(int(word), 14) for word in words[:, 0]]) * 0.07326
    assert rate.max() == pytest.approx(np.pi / 2 * 45 + still, abs=3)
    assert rate[-300:].mean() == pytest.approx(still, abs=0.3)


def test_the_same_seed_gives_the_same_words_and_another_seed_others():
    def words(seed):
        with on(SimBus(World(seed=seed))) as bus:
            bus.stage.move_to(45.0, approach=-1)
            return bus.exchange(READS * 50)

    assert words(3) == words(3)
    assert words(3) != words(4)


def test_a_closed_bus_moves_nothing():
    bus = SimBus(World())
    bus.close()
    for use in (
        lambda: bus.stage.move_to(1.0),
        lambda: bus.stage.orient((1, 0, 0)),
        lambda: bus.sleep_s(1),
    ):
        with pytest.raises(BusClosedError):
            use()


def test_closing_ends_a_stream(bus):
    on(bus)
    stream = bus.stream(READS)
    bus.close()
    with pytest.raises(StopIteration):
        next(stream)


def test_a_bus_in_real_time_follows_the_wall_clock():
    with SimBus(World(), realtime=True) as bus:
        before, own, after = time.monotonic(), bus.now_s(), time.monotonic()
        bus.exchange([0] * 300)
        bus.sleep_s(0.05)
        assert time.monotonic() - before >= 0.09
        time.sleep(0.02)
        least = time.monotonic() - after
        passed = bus.now_s() - own
        assert least <= passed + 1e-9
        assert passed <= time.monotonic() - before + 1e-9


# -- opening --------------------------------------------------------------------------------------


def test_a_url_sets_the_world():
    with open_bus("sim:?seed=1&delta_k=0.01&noise_mg=4.7&variant=16350&stream=0") as bus:
        assert isinstance(bus, SimBus)
        assert bus.world.truth()["delta_k"] == 0.01
        assert bus.world.settings == WorldSettings(delta_k=0.01, noise_mg=4.7)
        assert bus.world.seed == 1
        assert bus.chip.variant.name == "adis16350"
        assert bus.capabilities == {Capability.HARD_RESET}
        assert bus.url == "sim:?seed=1&delta_k=0.01&noise_mg=4.7&variant=16350&stream=0"


@pytest.mark.parametrize(("url", "day"), [("sim:?seed=3", 0), ("sim:?seed=3&day=2", 2)])
def test_a_url_without_a_day_is_the_first_session(url, day):
    with open_bus(url) as bus:
        assert bus.stage.error_deg == World(seed=3, day=day).stage.error_deg


def test_a_url_without_options_is_enough():
    with open_bus("sim:") as bus:
        assert bus.capabilities == set(Capability)
        assert bus.chip.variant.name == "adis16354"


def test_a_url_brings_effects_of_the_catalogue():
    with open_bus("sim:?effects=quadratic:k2_x=2.5;bias:bias_y=9") as bus:
        truth = bus.world.truth()
        assert truth["quadratic.k2_x"] == 2.5
        assert truth["bias.bias_y"] == 9.0


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("sim:?sed=1", "did you mean 'seed'"),
        ("sim:?noise=1", "no option 'noise'"),
        ("sim:?seed=x", "whole number"),
        ("sim:?seed=-1", "whole number"),
        ("sim:?noise_mg=lots", "no number"),
        ("sim:?variant=adis16400", "no variant"),
        ("sim:?stream=yes", "0 to 1"),
        ("sim:?realtime=2", "0 to 1"),
        ("sim:COM3", "no place"),
        ("sim:?hands=free", "only calibrate and write know hands=free"),
        ("sim:?effects=nonsense", "no effect"),
    ],
)
def test_bad_urls_are_refused_in_one_line(url, message):
    with pytest.raises(UsageError, match=message) as caught:
        open_bus(url)
    assert "\n" not in str(caught.value)


def test_the_simulator_is_listed_among_the_devices():
    assert any(device.url.startswith("sim:") for device in find_devices())


def test_an_hour_of_eight_registers_runs_in_seconds():
    bus = on(SimBus(World(seed=1)))
    before, start, scans = time.process_time(), bus.now_s(), 0
    with bus.stream([a << 8 for a in (4, 6, 8, 10, 12, 14, 16, 2)], block_scans=8192) as stream:
        while bus.now_s() - start < 240.0:
            scans += len(next(stream).words)
    seconds = time.process_time() - before
    assert scans == pytest.approx(240 * 819.2, rel=0.1)
    assert seconds * 15 < 60, "four minutes were run; an hour has fifteen of them"
