"""USB request blocks as packets: the device's side of Linux's virtual host controller (vhci-hcd).

Packets are those of USB/IP after its handshake (Linux, Documentation/usb/usbip_protocol.rst): a header
of 48 bytes, big endian, then the data of an OUT submit or of an IN return. vhci takes a connected
stream socket by its descriptor, so that no handshake and no listener is needed: one end of a socketpair
goes to the kernel, the other is read here. Closing it is pulling the plug.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

CMD_SUBMIT, CMD_UNLINK, RET_SUBMIT, RET_UNLINK = 1, 2, 3, 4
HEADER = struct.Struct(">5I28s")
SUBMIT = struct.Struct(">IiiII8s")  # flags, length, start frame, packets, interval, setup
RETURN = struct.Struct(">iiiii8x")  # status, actual length, start frame, packets, error count
NO_PACKETS = 0xFFFFFFFF
STALLED = -errno.EPIPE
UNLINKED = -errno.ECONNRESET
FULL_SPEED = 2
VHCI = Path("/sys/devices/platform/vhci_hcd.0/attach")

ENDPOINT_ZERO = 0
STANDARD, CLASS, VENDOR = 0, 1, 2


class Stall(Exception):  # noqa: N818 - USB's own word; it is an answer, not a failure of the program
    """The device refuses a request: the endpoint answers STALL."""


@dataclass(frozen=True)
class Setup:
    """The eight bytes that start a control transfer (USB 2.0, table 9-2)."""

    request_type: int
    request: int
    value: int
    index: int
    length: int

    @classmethod
    def unpack(cls, packed: bytes) -> Setup:
        """Take the wire's form apart (little endian)."""
        return cls(*struct.unpack("<BBHHH", packed))

    @property
    def kind(self) -> int:
        """`STANDARD`, `CLASS` or `VENDOR`."""
        return self.request_type >> 5 & 3


@dataclass(frozen=True)
class Urb:
    """One submitted request."""

    number: int
    device: int
    into_host: bool
    endpoint: int
    length: int
    setup: Setup
    data: bytes


@dataclass
class _Endpoint:
    """An IN endpoint: transfers that wait for the host, requests that wait for data."""

    answers: deque[bytes] = field(default_factory=deque)
    requests: deque[Urb] = field(default_factory=deque)


class UsbDevice:
    """A device: standard requests and the meeting of IN requests with answers live here.

    A board overrides `control` (class and vendor requests) and `out` (data that the host sent) and calls
    `push` (data for the host), from any thread. Faults are set from outside: `stall(address)` halts an
    endpoint until the host clears it, `refuse(address)` leaves it without answers, as a hung device does.
    """

    def __init__(
        self, device: bytes, configuration: bytes, strings: list[str], more: dict[int, bytes]
    ) -> None:
        self._descriptors = {1: device, 2: configuration, **more}
        self._strings = strings
        self._configuration = 0
        self._inputs: dict[int, _Endpoint] = {}
        self._halted: set[int] = set()
        self._refusing: set[int] = set()
        self._held: list[Urb] = []
        self._lock = threading.RLock()
        self._link: _Link | None = None
        self._left: int | None = None
        self._action: Callable[[], object] | None = None

    # -- what a board overrides ---------------------------------------------------------------------

    def control(self, setup: Setup, data: bytes) -> bytes:
        """Answer a class or vendor request; `Stall` refuses it."""
        raise Stall

    def out(self, endpoint: int, data: bytes) -> None:
        """Take data that the host sent to an OUT endpoint."""

    def configured(self) -> None:
        """The host set a configuration, which is also how it resets the device."""

    def unplugged(self) -> None:
        """The plug was pulled: stop what runs."""

    # -- what a board and its faults call -----------------------------------------------------------

    def push(self, endpoint: int, data: bytes) -> None:
        """Offer one transfer to the host on an IN endpoint (its number without bit 7)."""
        with self._lock:
            self._inputs.setdefault(endpoint, _Endpoint()).answers.append(data)
            self._meet(endpoint)

    def stall(self, address: int) -> None:
        """Halt an endpoint (address with bit 7 for IN); requests that wait are refused too."""
        with self._lock:
            self._halted.add(address)
            if address & 0x80:
                for urb in self._take_requests(address & 0x7F):
                    self._answer(urb, STALLED)

    def refuse(self, address: int) -> None:
        """Leave this endpoint without answers; what the host sends is not taken either."""
        with self._lock:
            self._refusing.add(address)

    def heal(self) -> None:
        """End stalls and refusals: what waited goes on, late."""
        with self._lock:
            self._halted.clear()
            self._refusing.clear()
            held, self._held = self._held, []
            for number in list(self._inputs):
                self._meet(number)
        for urb in held:
            self.submit(urb)

    def on_transfer(self, count: int, action: Callable[[], object]) -> None:
        """Fall dead after `count` more transfers of data, whichever way, and call `action` in a thread."""
        with self._lock:
            self._left, self._action = count, action

    # -- what the link calls ------------------------------------------------------------------------

    def submit(self, urb: Urb) -> None:
        """Take one request of the host."""
        address = urb.endpoint | 0x80 * urb.into_host
        if urb.endpoint == ENDPOINT_ZERO:
            self._submit_control(urb)
            return
        with self._lock:
            if address in self._refusing and not urb.into_host:
                self._held.append(urb)
                return
            if address in self._halted:
                self._answer(urb, STALLED)
                return
            if urb.into_host:
                self._inputs.setdefault(urb.endpoint, _Endpoint()).requests.append(urb)
                self._meet(urb.endpoint)
                return
            if self._dies():
                return
        try:
            self.out(urb.endpoint, urb.data)
        except Stall:
            self.stall(address)
            self._answer(urb, STALLED)
        else:
            self._answer(urb, 0, actual=len(urb.data))

    def unlink(self, number: int) -> bool:
        """Forget a waiting request; False where it was answered before."""
        with self._lock:
            for waiting in (self._held, *(endpoint.requests for endpoint in self._inputs.values())):
                for urb in waiting:
                    if urb.number == number:
                        waiting.remove(urb)
                        return True
        return False

    # -- inside -------------------------------------------------------------------------------------

    def _take_requests(self, endpoint: int) -> list[Urb]:
        waiting = self._inputs.setdefault(endpoint, _Endpoint()).requests
        taken = list(waiting)
        waiting.clear()
        return taken

    def _meet(self, number: int) -> None:
        endpoint = self._inputs[number]
        if number | 0x80 in self._refusing:
            return
        while endpoint.answers and endpoint.requests and not self._dies():
            urb = endpoint.requests.popleft()
            answer = endpoint.answers.popleft()
            if len(answer) > urb.length:
                endpoint.answers.appendleft(answer[urb.length :])
            self._answer(urb, 0, data=answer[: urb.length])

    def _dies(self) -> bool:
        """Count a transfer; true from the one on that finds none left."""
        if self._left is None:
            return False
        self._left -= 1
        if self._left < 0 and self._action is not None:
            threading.Thread(target=self._action, daemon=True).start()
            self._action = None
        return self._left < 0

    def _submit_control(self, urb: Urb) -> None:
        address = 0x80 * urb.into_host
        with self._lock:
            if address in self._refusing and urb.setup.kind != STANDARD:
                self._held.append(urb)
                return
        try:
            if urb.setup.kind == STANDARD:
                answer = self._standard(urb.setup)
            elif address in self._halted:
                self._halted.discard(address)  # endpoint zero recovers by itself with the next request
                raise Stall
            else:
                answer = self.control(urb.setup, urb.data)
        except Stall:
            self._answer(urb, STALLED)
            return
        if urb.into_host:
            self._answer(urb, 0, data=answer[: urb.length])
        else:
            self._answer(urb, 0, actual=len(urb.data))

    def _standard(self, setup: Setup) -> bytes:
        match setup.request:
            case 0x00:  # GET_STATUS
                halted = setup.request_type & 0x1F == 2 and setup.index & 0xFF in self._halted
                return bytes([halted, 0])
            case 0x01:  # CLEAR_FEATURE, of an endpoint: its halt
                with self._lock:
                    self._halted.discard(setup.index & 0xFF)
                return b""
            case 0x06:  # GET_DESCRIPTOR
                return self._descriptor(setup.value >> 8, setup.value & 0xFF)
            case 0x08:  # GET_CONFIGURATION
                return bytes([self._configuration])
            case 0x09:  # SET_CONFIGURATION
                self._configuration = setup.value
                with self._lock:
                    self._halted.clear()
                    for endpoint in self._inputs.values():
                        endpoint.answers.clear()
                self.configured()
                return b""
            case 0x0A:  # GET_INTERFACE
                return b"\0"
            case 0x05 | 0x0B:  # SET_ADDRESS, SET_INTERFACE
                return b""
        raise Stall

    def _descriptor(self, kind: int, index: int) -> bytes:
        if kind == 3:
            if index == 0:
                return b"\x04\x03\x09\x04"  # languages: English
            if index > len(self._strings):
                raise Stall
            text = self._strings[index - 1].encode("utf-16-le")
            return bytes([len(text) + 2, 3]) + text
        if kind not in self._descriptors:
            raise Stall
        return self._descriptors[kind]

    def _answer(self, urb: Urb, status: int, *, data: bytes = b"", actual: int | None = None) -> None:
        if self._link is not None:
            self._link.answer(urb, status, data, len(data) if actual is None else actual)


class _Link:
    """The packets of one plugged device."""

    def __init__(self, connection: socket.socket, device: UsbDevice) -> None:
        self._connection = connection
        self._device = device
        self._send_lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        with contextlib.suppress(OSError):  # the kernel may have been first
            self._connection.shutdown(socket.SHUT_RDWR)
        if self._thread is not threading.current_thread():
            self._thread.join(5)

    def answer(self, urb: Urb, status: int, data: bytes, actual: int) -> None:
        packed = RETURN.pack(status, actual, 0, 0, 0)
        self._send(HEADER.pack(RET_SUBMIT, urb.number, 0, 0, 0, packed) + data)

    def _send(self, packet: bytes) -> None:
        try:
            with self._send_lock:
                self._connection.sendall(packet)
        except OSError:
            pass  # unplugged meanwhile: nobody waits for the answer

    def _serve(self) -> None:
        try:
            while True:
                command, number, device, direction, endpoint, rest = HEADER.unpack(
                    self._receive(HEADER.size)
                )
                if command == CMD_SUBMIT:
                    _, length, _, packets, _, setup = SUBMIT.unpack(rest)
                    if packets not in (0, NO_PACKETS):
                        raise EOFError  # isochronous transfers: no board here has any
                    data = b"" if direction else self._receive(length)
                    self._device.submit(
                        Urb(number, device, bool(direction), endpoint, length, Setup.unpack(setup), data)
                    )
                elif command == CMD_UNLINK:
                    (victim,) = struct.unpack_from(">I", rest)
                    status = UNLINKED if self._device.unlink(victim) else 0
                    packed = RETURN.pack(status, 0, 0, 0, 0)
                    self._send(HEADER.pack(RET_UNLINK, number, 0, 0, 0, packed))
                else:
                    raise EOFError
        except (EOFError, OSError):
            pass
        finally:
            self._connection.close()
            self._device.unplugged()

    def _receive(self, count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            part = self._connection.recv(count - len(data))
            if not part:
                raise EOFError
            data += part
        return bytes(data)


def connect(device: UsbDevice) -> socket.socket:
    """Serve a device on one end of a socketpair; return the other end, which is the cable's plug."""
    ours, theirs = socket.socketpair()
    link = _Link(ours, device)
    device._link = link
    link.start()
    return theirs


def plug_in(device: UsbDevice, port: int, *, number: int) -> None:
    """Plug a device into a port (0…7) of the guest's virtual host controller.

    `number` becomes the upper half of the device id, which tells devices apart in the kernel's messages.
    """
    with connect(device) as plug:
        VHCI.write_text(f"{port} {plug.fileno()} {1 << 16 | number} {FULL_SPEED}")


def pull_out(device: UsbDevice) -> None:
    """Unplug: the kernel sees the cable go."""
    if device._link is not None:
        device._link.close()
