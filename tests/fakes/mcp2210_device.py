"""An MCP2210 as its firmware behaves: 64 bytes in, 64 bytes out; no host, no USB.

`Mcp2210Device.report(request) -> reply` is all that a transport of reports needs, in process or behind
USB/IP. The chip hangs on `pins`; the device's settings decide what the wires do.
"""

import struct
from dataclasses import dataclass, field

from adis_gonio.sim.testing.pins import ChipPins

VENDOR_ID, PRODUCT_ID = 0x04D8, 0x00DE
REPORT = 64
REPORT_DESCRIPTOR = bytes.fromhex(
    "0600ff" "0901" "a101"  # vendor page, usage 1, application
    "0901" "1500" "26ff00" "7508" "9540" "8102"  # 64 bytes in
    "0902" "1500" "26ff00" "7508" "9540" "9102"  # 64 bytes out
    "c0"
)  # fmt: skip

DONE, NOT_OWNED, BUSY, UNKNOWN = 0x00, 0xF7, 0xF8, 0xF9
FINISHED, STARTED, RUNNING = 0x10, 0x20, 0x30
GPIO, CS, DEDICATED = 0, 1, 2
BASE_HZ = 12_000_000
SETTINGS = struct.Struct("<IHHHHHHB")
CHIP_SETTINGS = struct.Struct("<9sHHB")


@dataclass
class SpiSettings:
    """Power-up values of the SPI side."""

    bit_rate: int = 1_000_000
    idle_cs: int = 0x1FF
    active_cs: int = 0x1EF
    cs_to_data: int = 0
    last_to_cs: int = 0
    between: int = 0
    transaction: int = 4
    mode: int = 0

    def pack(self) -> bytes:
        return SETTINGS.pack(*vars(self).values())


@dataclass
class Mcp2210Device:
    """The device.

    Attributes
    ----------
    pins : ChipPins
        The chip's wires.
    cs_pin, reset_pin, event_pin : int
        Which GP the chip's CS, RST and DIO1 hang on.
    stuck : bool
        The engine hangs: transfers are refused as busy until a cancel.
    busy : int
        So many more transfers are refused as busy.
    external_owner : bool
        Another master has the SPI bus.
    busy_polls : int
        So many polls of a running transaction are answered 0xF8, "transfer in progress".
    slow_polls : int
        So many polls say "running, nothing yet" before a transaction's data come.
    short : bool
        The next transaction loses its last byte.
    """

    pins: ChipPins
    serial: str = "0000123456"
    cs_pin: int = 0
    reset_pin: int = 3
    event_pin: int = 6
    stuck: bool = False
    busy: int = 0
    external_owner: bool = False
    busy_polls: int = 0
    slow_polls: int = 0
    short: bool = False
    nvram_writes: int = 0
    cancels: int = 0
    designations: bytearray = field(default_factory=lambda: bytearray(9))
    outputs: int = 0x1FF
    directions: int = 0x1FF
    flags: int = 0
    spi: SpiSettings = field(default_factory=SpiSettings)
    eeprom: bytearray = field(default_factory=lambda: bytearray(256))

    def __post_init__(self) -> None:
        self._sent = b""
        self._received = b""
        self._running = False
        self._polls = 0
        self._counted = 0
        self._saturated = 0

    # -- commands ----------------------------------------------------------------------------------

    def report(self, request: bytes) -> bytes:
        """Answer one report."""
        request = request.ljust(REPORT, b"\0")[:REPORT]
        command = request[0]
        answer = getattr(self, f"_cmd_{command:02x}", None)
        body = bytes([command, UNKNOWN]) if answer is None else bytes([command]) + answer(request)
        return body.ljust(REPORT, b"\0")

    def usb_reset(self) -> None:
        """The port was reset or the host set a configuration: the engine stops, settings stay."""
        self._stop()

    def _stop(self) -> None:
        self._sent = self._received = b""
        self._running = False
        self.stuck = False

    def _cmd_10(self, request: bytes) -> bytes:
        owner = 2 if self.external_owner else 1 if self._running else 0
        return bytes([DONE, 1, owner, 0, 0])

    def _cmd_11(self, request: bytes) -> bytes:
        self.cancels += 1
        self._stop()
        return self._cmd_10(request)

    def _cmd_12(self, request: bytes) -> bytes:
        edges = self.pins.data_ready_edges()
        mode = self.flags >> 1 & 7  # 1 falling edges, 2 rising ones, then pulses, which are as many
        counting = self.designations[self.event_pin] == DEDICATED and 1 <= mode <= 4
        count = min(edges - self._counted, 0xFFFF) if counting else 0
        if request[1] == 0:
            self._counted = edges
        return struct.pack("<BBBH", DONE, 0, 0, count)

    def _cmd_20(self, request: bytes) -> bytes:
        settings = CHIP_SETTINGS.pack(bytes(self.designations), self.outputs, self.directions, self.flags)
        return bytes([DONE, 0, 0]) + settings + b"\0"

    def _cmd_21(self, request: bytes) -> bytes:
        designations, outputs, directions, self.flags = CHIP_SETTINGS.unpack_from(request, 4)
        if self.designations[self.event_pin] != designations[self.event_pin]:
            self._counted = self.pins.data_ready_edges()
        self.designations = bytearray(designations)
        self._drive(outputs, directions)
        return bytes([DONE])

    def _cmd_30(self, request: bytes) -> bytes:
        self._drive(struct.unpack_from("<H", request, 4)[0], self.directions)
        return bytes([DONE, 0, 0]) + struct.pack("<H", self.outputs)

    def _cmd_31(self, request: bytes) -> bytes:
        return bytes([DONE, 0, 0]) + struct.pack("<H", self.outputs)

    def _cmd_32(self, request: bytes) -> bytes:
        self._drive(self.outputs, struct.unpack_from("<H", request, 4)[0])
        return bytes([DONE, 0, 0]) + struct.pack("<H", self.directions)

    def _cmd_33(self, request: bytes) -> bytes:
        return bytes([DONE, 0, 0]) + struct.pack("<H", self.directions)

    def _reset_is_low(self) -> bool:
        bit = 1 << self.reset_pin
        return self.designations[self.reset_pin] == GPIO and not (self.outputs | self.directions) & bit

    def _drive(self, outputs: int, directions: int) -> None:
        was_low = self._reset_is_low()
        self.outputs, self.directions = outputs & 0x1FF, directions & 0x1FF
        if was_low and not self._reset_is_low():
            self.pins.hard_reset()

    def _cmd_40(self, request: bytes) -> bytes:
        if self._running or self.stuck:
            return bytes([BUSY])
        wanted = SpiSettings(*SETTINGS.unpack_from(request, 4))
        divider = max(1, round(BASE_HZ / max(wanted.bit_rate, 1464)))
        wanted.bit_rate = BASE_HZ // divider
        self.spi = wanted
        return bytes([DONE, 0, 0]) + wanted.pack()

    def _cmd_41(self, request: bytes) -> bytes:
        return bytes([DONE, 0, 0]) + self.spi.pack()

    def _cmd_50(self, request: bytes) -> bytes:
        return bytes([DONE, request[1], self.eeprom[request[1]]])

    def _cmd_51(self, request: bytes) -> bytes:
        self.eeprom[request[1]] = request[2]
        return bytes([DONE])

    def _cmd_60(self, request: bytes) -> bytes:
        self.nvram_writes += 1
        return bytes([DONE])

    def _cmd_61(self, request: bytes) -> bytes:
        return bytes([DONE, request[1]])

    # -- transfers -----------------------------------------------------------------------------------

    def _cmd_42(self, request: bytes) -> bytes:
        count = request[1]
        if self.external_owner:
            return bytes([NOT_OWNED])
        if self.stuck:
            return bytes([BUSY])
        if count and self.busy:
            self.busy -= 1
            return bytes([BUSY])
        if count:
            if count > REPORT - 4 or self._received:
                return bytes([BUSY])
            return self._start(request[4 : 4 + count])
        if not self._running:
            return bytes([DONE, 0, FINISHED])
        if self.busy_polls:
            self.busy_polls -= 1
            return bytes([BUSY])
        if self._polls:
            self._polls -= 1
            return bytes([DONE, 0, STARTED])
        if not self._received:
            return bytes([DONE, 0, STARTED])
        data, self._received = self._received[:60], self._received[60:]
        self._running = bool(self._received)
        return bytes([DONE, len(data), RUNNING if self._running else FINISHED]) + data

    def _start(self, data: bytes) -> bytes:
        self._sent += data
        self._running = True
        if len(self._sent) >= self.spi.transaction:
            spi, data, self._sent = self.spi, self._sent[: self.spi.transaction], b""
            lead_s = spi.cs_to_data * 1e-4
            if lead_s:
                self.pins.clock.advance_to(self.pins.clock.now_s() + lead_s)
            self._received = self.pins.transfer(
                data,
                clock_hz=spi.bit_rate,
                mode=spi.mode,
                cs_hold_s=spi.last_to_cs * 1e-4,
                selected=self._selects(),
            )
            if self.short:
                self._received, self.short = self._received[:-1], False
            self._polls = self.slow_polls
        return bytes([DONE, 0, STARTED])

    def _selects(self) -> bool:
        bit = 1 << self.cs_pin
        return (
            self.designations[self.cs_pin] == CS
            and bool(self.spi.idle_cs & bit)
            and not self.spi.active_cs & bit
        )
