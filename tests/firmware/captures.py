"""A capture of a rig's pins, compared with the frames that the host has recorded."""

from __future__ import annotations

from pathlib import Path

from adis_gonio.device.bus import SpiBus
from adis_gonio.device.bus.capture import LogicCapture
from adis_gonio.device.bus.recording import BusRecording, RecordingBus
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.frame_log import FrameLog, FrameRow
from adis_gonio.device.sensor.registers import VARIANTS


def rows_of(source: BusRecording | LogicCapture) -> list[FrameRow]:
    """Reads and writes, as the command `frames` lists them."""
    rows = FrameLog(VARIANTS["adis16354"]).rows(source)
    return [row for row in rows if row.action in ("read", "write")]


def exercise(bus: SpiBus, recording: Path) -> None:
    """Read and write registers in both modes of the serial port, and record the frames of the host."""
    with Adis16354(RecordingBus(bus, recording), check=False) as sensor:
        sensor.write("XACCL_OFF", -1000)
        sensor.read_all()
        sensor.configure(smpl_prd=0x0A)
        sensor.write("ZGYRO_OFF", 4095)
        sensor.read_all()
        sensor.configure(smpl_prd=1)


def compare(capture: Path, recording: Path) -> int:
    """Assert that a capture has the recorded frames in order and nothing else; return their number."""
    pins, host = rows_of(LogicCapture(capture)), rows_of(BusRecording(recording))
    assert [row.frame for row in pins] == [row.frame for row in host]
    for seen, got in zip(pins, host, strict=True):
        assert (seen.action, seen.register) == (got.action, got.register)
        if got.word is not None:
            assert (seen.word, seen.value) == (got.word, got.value)
        assert not seen.problem
    return len(host)
