"""A backend of pyusb with CP2130 boards behind it: the real pyusb runs, no kernel, no libusb."""

from __future__ import annotations

import array
import errno
import struct
from collections import deque
from types import SimpleNamespace

import usb.backend
import usb.core

from adis_gonio.sim.testing.faults import Faults
from fakes.cp2130_device import (
    PACKET,
    PRODUCT_ID,
    VENDOR_ID,
    Cp2130Device,
    StallError,
)

STRINGS = ("", "Silicon Laboratories", "CP2130 USB-to-SPI Bridge")


def usb_error(code: int, text: str) -> usb.core.USBError:
    """Error as libusb's backend raises it."""
    if code == errno.ETIMEDOUT:
        return usb.core.USBTimeoutError(text, -7, code)
    return usb.core.USBError(text, -1, code)


class UsbBoard:
    """A board at a port.

    Attributes
    ----------
    plugged, permitted, claimed : bool
        State of the port, the rights, and whether somebody has the interface.
    latency_s : float
        Time that a transfer takes.
    """

    def __init__(
        self,
        device: Cp2130Device,
        *,
        bus: int = 1,
        address: int = 5,
        faults: Faults | None = None,
        latency_s: float = 0.1e-3,
    ) -> None:
        self.device = device
        self.bus, self.address = bus, address
        self.faults = faults or Faults()
        self.latency_s = latency_s
        self.plugged = True
        self.permitted = True
        self.claimed = False
        self.out_transfers = 0
        self.resets = 0
        self.out_is_halted = False
        self._waiting: deque[tuple[float, bytes]] = deque()

    @property
    def clock(self):
        return self.device.pins.clock

    def check(self) -> None:
        """Raise what an absent device raises; time passes."""
        if self.plugged and self.faults.happens("unplug"):
            self.plugged = False
        if not self.plugged:
            raise usb_error(errno.ENODEV, "No such device (it may have been disconnected)")
        self.clock.advance_to(self.clock.now_s() + self.latency_s)

    def time_out(self, timeout_ms: int):
        self.clock.advance_to(self.clock.now_s() + timeout_ms / 1000)
        return usb_error(errno.ETIMEDOUT, "Operation timed out")

    def control(self, kind, request, value, index, data, timeout_ms):
        """Vendor request; bytes to the device or their number from it."""
        self.check()
        if self.faults.happens("drop") or self.faults.hangs(self.clock.now_s()):
            raise self.time_out(timeout_ms)
        try:
            if kind & 0x80:
                return self.device.control_in(request, value, index, data)
            self.device.control_out(request, value, index, bytes(data))
        except StallError:
            raise usb_error(errno.EPIPE, "Pipe error") from None
        return b""

    def bulk_out(self, data: bytes, timeout_ms: int) -> int:
        faults = self.faults
        self.check()
        self.out_transfers += 1
        if self.out_is_halted or faults.happens("busy"):
            self.out_is_halted = True  # until the host ends it (USB 2.0, 8.5.3.4 and 9.4.5)
            raise usb_error(errno.EPIPE, "Pipe error")
        if faults.happens("drop"):
            raise self.time_out(timeout_ms)
        if faults.happens("stuck"):
            self.device.stuck = True
        if faults.happens("short"):
            self.device.short = True
        hung = faults.hangs(self.clock.now_s())
        try:
            self.device.bulk_out(data)
        except StallError:
            self.out_is_halted = True
            raise usb_error(errno.EPIPE, "Pipe error") from None
        while (packet := self.device.bulk_in()) is not None:
            if faults.happens("drop"):
                continue
            last = self._waiting[-1][0] if self._waiting else 0.0
            late = faults.hung_until_s - self.clock.now_s() if hung else 0.0
            arrival = max(self.clock.now_s(), last) + faults.delayed_s() + late
            self._waiting.append((arrival, packet))
        return len(data)

    def bulk_in(self, size: int, timeout_ms: int) -> bytes:
        self.check()
        now = self.clock.now_s()
        if self._waiting and self._waiting[0][0] <= now + timeout_ms / 1000:
            arrival, packet = self._waiting.popleft()
            self.clock.advance_to(arrival)
            return packet[:size]
        raise self.time_out(timeout_ms)

    def reset(self) -> None:
        self.check()
        self.resets += 1
        self.out_is_halted = False
        self._waiting.clear()
        self.device.usb_reset()

    def replug(self) -> None:
        """Out and in again; the address is a new one."""
        self.plugged, self.claimed, self.out_is_halted = True, False, False
        self.address += 1
        self._waiting.clear()
        self.device.usb_reset()


class FakeUsbBackend(usb.backend.IBackend):
    """pyusb's backend interface over boards."""

    def __init__(self, *boards: UsbBoard) -> None:
        self.boards = boards

    def enumerate_devices(self):
        return iter([board for board in self.boards if board.plugged])

    def get_parent(self, dev):
        return None

    def get_device_descriptor(self, dev):
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0200,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=VENDOR_ID,
            idProduct=PRODUCT_ID,
            bcdDevice=0x0100,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=3,
            bNumConfigurations=1,
            address=dev.address,
            bus=dev.bus,
            port_number=1,
            port_numbers=(1,),
            speed=2,
        )

    def get_configuration_descriptor(self, dev, config):
        if config:
            raise IndexError
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=32,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0x80,
            bMaxPower=50,
            extra_descriptors=b"",
        )

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf or alt or config:
            raise IndexError
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=2,
            bInterfaceClass=0xFF,
            bInterfaceSubClass=0,
            bInterfaceProtocol=0,
            iInterface=0,
            extra_descriptors=b"",
        )

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=dev.device.endpoints[ep],
            bmAttributes=2,
            wMaxPacketSize=PACKET,
            bInterval=0,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=b"",
        )

    def open_device(self, dev):
        if not dev.plugged:
            raise usb_error(errno.ENODEV, "No such device (it may have been disconnected)")
        if not dev.permitted:
            raise usb_error(errno.EACCES, "Access denied (insufficient permissions)")
        return SimpleNamespace(board=dev, claimed=False)

    def close_device(self, dev_handle):
        if dev_handle.claimed:
            dev_handle.claimed = dev_handle.board.claimed = False

    def get_configuration(self, dev_handle):
        return 1

    def set_configuration(self, dev_handle, config_value):
        dev_handle.board.device.usb_reset()

    def is_kernel_driver_active(self, dev_handle, intf):
        return False

    def claim_interface(self, dev_handle, intf):
        if dev_handle.board.claimed and not dev_handle.claimed:
            raise usb_error(errno.EBUSY, "Resource busy")
        dev_handle.claimed = dev_handle.board.claimed = True

    def release_interface(self, dev_handle, intf):
        dev_handle.claimed = dev_handle.board.claimed = False

    def bulk_write(self, dev_handle, ep, intf, data, timeout):
        assert dev_handle.claimed
        assert ep == dev_handle.board.device.endpoints[0]
        assert timeout, "a transfer that may block for ever"
        return dev_handle.board.bulk_out(bytes(data), timeout)

    def bulk_read(self, dev_handle, ep, intf, buff, timeout):
        assert dev_handle.claimed
        assert ep == dev_handle.board.device.endpoints[1]
        assert timeout, "a transfer that may block for ever"
        packet = dev_handle.board.bulk_in(len(buff), timeout)
        buff[: len(packet)] = array.array("B", packet)
        return len(packet)

    def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
        assert timeout, "a transfer that may block for ever"
        board = dev_handle.board
        if (bmRequestType, bRequest) == (0x80, 6):
            answer = self._string(board, wValue & 0xFF)[: len(data)]
        elif bmRequestType & 0x80:
            size = len(data)
            answer = board.control(bmRequestType, bRequest, wValue, wIndex, size, timeout)
        else:
            board.control(bmRequestType, bRequest, wValue, wIndex, bytes(data), timeout)
            return len(data)
        data[: len(answer)] = array.array("B", answer)
        return len(answer)

    @staticmethod
    def _string(board: UsbBoard, index: int) -> bytes:
        text = (*STRINGS, board.device.serial)[index]
        body = text.encode("utf-16-le") if index else b"\x09\x04"
        return struct.pack("BB", len(body) + 2, 3) + body

    def clear_halt(self, dev_handle, ep):
        assert ep in dev_handle.board.device.endpoints
        dev_handle.board.check()
        if ep == dev_handle.board.device.endpoints[0]:
            dev_handle.board.out_is_halted = False
        dev_handle.board.device.clear_halt(ep)

    def reset_device(self, dev_handle):
        dev_handle.board.reset()
