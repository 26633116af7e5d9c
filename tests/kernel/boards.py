"""USB boards: the descriptors that a kernel reads, around models that turn bytes into bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

from fakes.cp2130_device import StallError as Refusal
from kernel.urb import CLASS, VENDOR, Setup, Stall, UsbDevice

INTERRUPT, BULK = 3, 2
HID_DESCRIPTOR, HID_REPORT_DESCRIPTOR = 0x21, 0x22

# Vendor-defined page; 64 bytes in, 64 bytes out, no report id (as a MCP2210 reports itself).
MCP2210_REPORT = bytes.fromhex(
    "06 00 FF 09 01 A1 01 19 01 29 40 15 00 26 FF 00 75 08 95 40 81 00 19 01 29 40 91 00 C0"
)


class HidModel(Protocol):
    """A chip behind 64-byte reports."""

    def report(self, request: bytes) -> bytes:
        """Answer one OUT report."""

    def usb_reset(self) -> None:
        """The host set a configuration."""


class BulkModel(Protocol):
    """A chip behind vendor requests and two bulk endpoints."""

    def control_in(self, request: int, value: int, index: int, length: int) -> bytes:
        """Answer a request to the host."""

    def control_out(self, request: int, value: int, index: int, data: bytes) -> None:
        """Take a request from the host."""

    def bulk_out(self, data: bytes) -> None:
        """Take one OUT transfer."""

    def bulk_in(self) -> bytes | None:
        """Next packet for the host, if there is one."""

    def usb_reset(self) -> None:
        """The host set a configuration."""


class SerialModel(Protocol):
    """A board behind a serial line."""

    def connect(self, send: Callable[[bytes], None]) -> None:
        """Say where bytes for the host go."""

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""

    def close(self) -> None:
        """The plug was pulled."""


def _device(usb_class: int, vendor: int, product: int) -> bytes:
    """Device descriptor (USB 2.0, table 9-8); strings 1, 2 and 3 are maker, product and serial number."""
    return struct.pack(
        "<BBHBBBBHHHBBBB", 18, 1, 0x0200, usb_class, 0, 0, 64, vendor, product, 0x0100, 1, 2, 3, 1
    )


def _configuration(interfaces: int, parts: bytes) -> bytes:
    """Configuration descriptor (table 9-10) before its parts; bus powered, 100 mA."""
    return struct.pack("<BBHBBBBB", 9, 2, 9 + len(parts), interfaces, 1, 0, 0x80, 50) + parts


def _interface(number: int, endpoints: int, kind: tuple[int, int, int]) -> bytes:
    return struct.pack("<9B", 9, 4, number, 0, endpoints, *kind, 0)


def _endpoint(address: int, kind: int, size: int, interval: int = 0) -> bytes:
    return struct.pack("<BBBBHB", 7, 5, address, kind, size, interval)


class HidBoard(UsbDevice):
    """MCP2210: one HID interface, interrupt endpoints 0x81 and 0x01."""

    IN, OUT = 1, 1

    def __init__(self, model: HidModel, serial: str) -> None:
        hid = struct.pack(
            "<BBHBBBH", 9, HID_DESCRIPTOR, 0x0111, 0, 1, HID_REPORT_DESCRIPTOR, len(MCP2210_REPORT)
        )
        parts = (
            _interface(0, 2, (3, 0, 0))
            + hid
            + _endpoint(0x81, INTERRUPT, 64, 1)
            + _endpoint(0x01, INTERRUPT, 64, 1)
        )
        super().__init__(
            _device(0, 0x04D8, 0x00DE),
            _configuration(1, parts),
            ["Microchip Technology Inc.", "MCP2210 USB-to-SPI Master", serial],
            {HID_DESCRIPTOR: hid, HID_REPORT_DESCRIPTOR: MCP2210_REPORT},
        )
        self._model = model

    def control(self, setup: Setup, data: bytes) -> bytes:
        """SET_IDLE and SET_PROTOCOL are taken; reports go by the endpoints only."""
        if setup.kind == CLASS and setup.request in (0x0A, 0x0B):
            return b""
        raise Stall

    def out(self, endpoint: int, data: bytes) -> None:
        """One report in, one report back."""
        self.push(self.IN, self._model.report(data))

    def configured(self) -> None:
        """Tell the model."""
        self._model.usb_reset()


class BulkBoard(UsbDevice):
    """CP2130: vendor class, bulk endpoints 0x01 and 0x82, vendor requests on endpoint zero."""

    IN, OUT = 2, 1

    def __init__(self, model: BulkModel, serial: str) -> None:
        parts = _interface(0, 2, (0xFF, 0, 0)) + _endpoint(0x01, BULK, 64) + _endpoint(0x82, BULK, 64)
        super().__init__(
            _device(0, 0x10C4, 0x87A0),
            _configuration(1, parts),
            ["Silicon Laboratories", "CP2130 USB-to-SPI Bridge", serial],
            {},
        )
        self._model = model

    def control(self, setup: Setup, data: bytes) -> bytes:
        """Vendor requests go to the model; what it refuses is stalled."""
        if setup.kind != VENDOR:
            raise Stall
        try:
            if setup.request_type & 0x80:
                return self._model.control_in(setup.request, setup.value, setup.index, setup.length)
            self._model.control_out(setup.request, setup.value, setup.index, data)
        except Refusal:
            raise Stall from None
        return b""

    def out(self, endpoint: int, data: bytes) -> None:
        """One OUT transfer, and the packets that it makes ready."""
        try:
            self._model.bulk_out(data)
        except Refusal:
            raise Stall from None
        while (answer := self._model.bulk_in()) is not None:
            self.push(self.IN, answer)

    def configured(self) -> None:
        """Tell the model."""
        self._model.usb_reset()


class SerialBoard(UsbDevice):
    """CDC-ACM board with the ids of an Arduino Uno R3: notifications 0x82, data 0x83 and 0x04."""

    NOTIFY, IN, OUT = 2, 3, 4

    def __init__(self, model: SerialModel, serial: str) -> None:
        functions = bytes.fromhex("05 24 00 10 01  04 24 02 06  05 24 06 00 01  05 24 01 00 01")
        parts = (
            _interface(0, 1, (2, 2, 1))
            + functions
            + _endpoint(0x82, INTERRUPT, 8, 255)
            + _interface(1, 2, (10, 0, 0))
            + _endpoint(0x04, BULK, 64)
            + _endpoint(0x83, BULK, 64)
        )
        super().__init__(
            _device(2, 0x2341, 0x0043),
            _configuration(2, parts),
            ["Arduino (www.arduino.cc)", "Arduino Uno", serial],
            {},
        )
        self._model = model
        self.line_coding = struct.pack("<IBBB", 9600, 0, 0, 8)
        self.line_state = 0
        model.connect(lambda data: self.push(self.IN, data))

    @property
    def baud_rate(self) -> int:
        """Baud rate that the host asked for."""
        return int.from_bytes(self.line_coding[:4], "little")

    def control(self, setup: Setup, data: bytes) -> bytes:
        """Line coding and modem lines (CDC PSTN 1.2, table 13)."""
        if setup.kind == CLASS:
            match setup.request:
                case 0x20:
                    self.line_coding = data
                    return b""
                case 0x21:
                    return self.line_coding
                case 0x22:
                    self.line_state = setup.value
                    return b""
                case 0x23:
                    return b""
        raise Stall

    def out(self, endpoint: int, data: bytes) -> None:
        """Bytes for the firmware."""
        self._model.receive(data)

    def unplugged(self) -> None:
        """Stop the firmware with its supply."""
        self._model.close()
