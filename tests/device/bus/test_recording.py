"""A recording keeps every call of a bus, and a replay answers as the recorded bus did."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError, DataError, OutputError, ProtocolError, UsageError
from adis_gonio.device.bus import SpiBus, open_bus
from adis_gonio.device.bus.recording import BusRecording, RecordingBus, ReplayBus
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.cli import main
from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.sim.testing.bus_contract import BusContract, Rig, WatchedChip
from adis_gonio.testing import ExpectedFrames, Faults, FaultyBus

SEED = 11


class TestRecordingBus(BusContract):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path: Path) -> None:
        self.folder = tmp_path

    def make(self) -> Rig:
        world = World(seed=SEED)
        chip = WatchedChip(world, start_s=-0.5)
        number = len(list(self.folder.iterdir()))
        bus = RecordingBus(SimBus(world=world, chip=chip), self.folder / f"{number}.rec")
        return Rig(bus, chip, SimulatedChip(World(seed=SEED), start_s=-0.5))


def work(bus: SpiBus) -> list[object]:
    """Everything that a driver sees in some seconds of work."""
    seen: list[object] = []
    with Adis16354(bus) as sensor:
        sensor.configure(smpl_prd=1, filter_m=2, gyro_range_dps=300)
        seen += [sensor.read_all(), sensor.scan(), list(sensor.status().messages)]
        with sensor.stream() as stream:
            for _ in range(3):
                block = next(stream)
                seen.append((block.words.tolist(), block.time_s.tolist(), block.lost))
        sensor.reset()
        seen += [sensor.scan(), bus.now_s()]
    return seen


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, list[object]]:
    path = tmp_path / "run.rec"
    return path, work(open_bus(f"record:{path}:sim:?seed=3"))


@pytest.mark.parametrize("mode", ["order", "strict"])
def test_a_replay_gives_the_driver_the_same_words_and_times(
    recorded: tuple[Path, list[object]], mode: str
) -> None:
    path, seen = recorded
    assert work(open_bus(f"replay:{path}?mode={mode}")) == seen
    assert not BusRecording(path).damage


def test_a_recorded_error_is_raised_again(tmp_path: Path) -> None:
    path = tmp_path / "faults.rec"
    bus = RecordingBus(FaultyBus(SimBus(World(seed=1)), Faults(seed=2, hang=0.3)), path)
    frames, outcomes = [0x3600, 0x0000], []
    for _ in range(20):
        try:
            outcomes.append(bus.exchange(frames))
        except BusTimeoutError as error:
            outcomes.append(str(error))
    bus.close()
    replayed = ReplayBus(path, strict=True)
    assert any(isinstance(outcome, str) for outcome in outcomes)
    for outcome in outcomes:
        if isinstance(outcome, str):
            with pytest.raises(BusTimeoutError) as caught:
                replayed.exchange(frames)
            assert str(caught.value) == outcome
        else:
            assert replayed.exchange(frames) == outcome


def test_a_strict_replay_names_the_record_that_differs_and_a_loose_one_skips(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    bus = RecordingBus(SimBus(World(seed=1)), path)
    first, second = bus.exchange([0x3600, 0]), bus.exchange([0x3800, 0])
    bus.close()
    strict = ReplayBus(path, strict=True)
    with pytest.raises(ProtocolError, match=r"record 1 .*3600 0000.*3800 0000"):
        strict.exchange([0x3800, 0])
    assert strict.exchange([0x3600, 0]) == first
    loose = ReplayBus(path)
    assert loose.exchange([0x3800, 0]) == second
    with pytest.raises(ProtocolError, match="3600"):
        loose.exchange([0x3600, 0])


def test_a_file_cut_at_any_byte_keeps_every_earlier_record(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.rec", tmp_path / "cut.rec"
    bus = RecordingBus(SimBus(World(seed=1)), path)
    for _ in range(3):
        bus.exchange([0x3600, 0])
    whole = path.read_bytes()
    bus.exchange([0x3800, 0])
    longer = path.read_bytes()
    bus.close()
    for size in range(len(whole) + 1, len(longer)):
        cut.write_bytes(longer[:size])
        recording = BusRecording(cut)
        assert [call.name for call in recording] == ["exchange"] * 3
        assert "record 4" in recording.damage
    for flipped in range(len(whole), len(longer)):
        cut.write_bytes(longer[:flipped] + bytes([longer[flipped] ^ 4]) + longer[flipped + 1 :])
        recording = BusRecording(cut)
        assert len(list(recording)) == 3
        assert recording.damage


def test_a_full_disk_ends_the_recording_but_not_the_work(tmp_path: Path) -> None:
    script = f"""
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
from adis_gonio.device.bus import open_bus
bus = open_bus("record:{tmp_path}/a.rec:sim:?seed=1")
replies = [bus.exchange([0x3600, 0])[1] for _ in range(200)]
assert set(replies) == {{1}}, replies
try:
    bus.close()
except Exception as error:
    print(type(error).__name__, error)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.startswith("OutputError")
    assert f"{tmp_path}/a.rec" in done.stdout
    recording = BusRecording(tmp_path / "a.rec")
    kept = [call for call in recording if call.name == "exchange"]
    assert 20 < len(kept) < 200
    assert not recording.damage


def test_a_wrong_url_or_file_gives_one_clear_line(tmp_path: Path) -> None:
    there = tmp_path / "there.rec"
    there.write_bytes(b"something else")
    with pytest.raises(UsageError, match=r"there\.rec"):
        open_bus(f"record:{there}:sim:")
    assert there.read_bytes() == b"something else"
    for text in ("record:", "record:a.rec", "record:a.rec:", "record::sim:", "replay:"):
        with pytest.raises(UsageError, match="write re"):
            open_bus(text)
    with pytest.raises(DataError, match="no recording"):
        open_bus(f"replay:{there}")
    with pytest.raises(DataError, match=r"none\.rec"):
        open_bus(f"replay:{tmp_path / 'none.rec'}")
    with pytest.raises(OutputError, match="no folder"):
        open_bus(f"record:{tmp_path}/none/a.rec:sim:")
    with pytest.raises(UsageError, match="quantum"):
        open_bus(f"record:{tmp_path}/new.rec:quantum:")
    assert not (tmp_path / "new.rec").exists()


def test_a_session_is_recorded_again_from_a_recording_byte_for_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # A note, positions, a skipped one; the replay has no input at all.
    for url, output, answers in (
        ("record:run.rec:sim:?seed=5", "a.session", "n a note\n\n\ns\n\n\n\n\n"),
        ("replay:run.rec?mode=strict", "b.session", ""),
    ):
        command = [sys.executable, "-m", "adis_gonio", "calibrate", url, "--dwell", "1", "-o", output]
        done = subprocess.run(
            command, input=answers, capture_output=True, text=True, timeout=120, check=False
        )
        assert "Traceback" not in done.stderr
        assert done.returncode == 0, done.stderr
    original = Path("a.session").read_bytes()
    assert b"a note" in original
    assert Path("b.session").read_bytes() == original


@pytest.mark.parametrize("options", [[], ["--allow-writes", "--yes", "--flash"]])
def test_a_bring_up_is_repeated_from_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bringup", "record:run.rec:sim:?seed=1", "-o", "a.html", *options]) == 0
    assert main(["bringup", "replay:run.rec?mode=strict", "-o", "b.html", *options]) == 0
    assert Path("b.json").read_bytes() == Path("a.json").read_bytes()
    assert main(["frames", "run.rec"]) == 0


def test_expected_frames_name_the_line_of_the_test() -> None:
    bus = ExpectedFrames()
    bus.expect(0x3600, 0x0000)
    bus.expect(0x0000, 0x0001)  # the line that the message names
    here = sys._getframe().f_lineno - 1
    with pytest.raises(AssertionError, match=rf"test_recording\.py:{here}: .*0x0A00.*0x0000"):
        bus.exchange([0x3600, 0x0A00])
    with pytest.raises(AssertionError, match=rf"test_recording\.py:{here}: .*never sent: 1,"):
        bus.close()
    done = ExpectedFrames([(0x3600, 5), (0x0000, 1)])
    assert done.exchange([0x3600, 0x0000]) == [5, 1]
    with pytest.raises(AssertionError, match="after all 2"):
        done.exchange([0x3600])
    done.close()


def test_recorded_words_are_exact(recorded: tuple[Path, list[object]]) -> None:
    blocks = [call.result for call in BusRecording(recorded[0]) if call.name == "block"]
    seen = [item for item in recorded[1] if isinstance(item, tuple)]
    words = np.concatenate([block.words for block in blocks[-3:]]).tolist()
    assert words == [row for item in seen for row in item[0]]
