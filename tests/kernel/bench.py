"""The client's side of the bench: plugs boards in and out, finds the kernel's devices for them.

Processes of the guest are forked from one that has imported the package: to start a program and import it
takes the guest some 40 s.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

SETTLE_S = 120
"""Limit for whatever hangs: a busy host may need a tenth of it."""
RELOAD_S = 60
USB_DEVICES = Path("/sys/bus/usb/devices")


class Forked:
    """A process that answers requests; `serve(connection)` runs in it until it receives None."""

    def __init__(self, serve: Callable[[Connection], None]) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other,))
        self._process.start()
        other.close()

    def ask(self, request: Any) -> Any:
        """Send a request and return its answer.

        Raises
        ------
        RuntimeError
            If the process answers with `{"error": message}`.
        """
        self._connection.send(request)
        answer = self._connection.recv()
        if isinstance(answer, dict) and "error" in answer:
            raise RuntimeError(f"{request}: {answer['error']}")
        return answer

    def close(self) -> None:
        """End the process."""
        self._connection.send(None)
        self._process.join(SETTLE_S)
        self._process.kill()
        self._connection.close()


class Bench:
    """Boards on the guest's virtual USB ports; `devices` is the process that is the boards."""

    def __init__(self, devices: Forked) -> None:
        self._devices = devices
        self._ports: dict[int, str] = {}

    def plug(self, kind: str, serial: str) -> int:
        """Plug a board in, wait until kernel and udev are done with it; return its port."""
        port = min(set(range(8)) - set(self._ports))
        self._command("plug", kind=kind, serial=serial, port=port)
        self._ports[port] = serial
        self._until(lambda: serial in serials() and self._has_driver(serial), f"{serial} to be enumerated")
        settle()
        return port

    def unplug(self, port: int) -> None:
        """Pull a board out, wait until the kernel has noticed (it may have been gone already)."""
        serial = self._ports.pop(port, None)
        self._command("unplug", port=port)
        self._until(lambda: serial not in serials(), f"{serial} to go")

    def stall(self, port: int, address: int) -> None:
        """Halt an endpoint until the host clears it."""
        self._command("stall", port=port, address=address)

    def refuse(self, port: int, address: int) -> None:
        """Make an endpoint not answer."""
        self._command("refuse", port=port, address=address)

    def heal(self, port: int) -> None:
        """End stalls and refusals: what waited goes on, late."""
        self._command("heal", port=port)

    def unplug_after(self, port: int, count: int) -> None:
        """Pull the board out when `count` more transfers of data have gone either way."""
        self._command("unplug_after", port=port, count=count)

    def state(self, port: int) -> dict[str, Any]:
        """Figures of a board."""
        return self._command("state", port=port)

    def clear(self) -> None:
        """Pull everything out."""
        for port in list(self._ports):
            self.unplug(port)

    def _command(self, command: str, **arguments: Any) -> dict[str, Any]:
        answer: dict[str, Any] = self._devices.ask({"do": command, **arguments})
        return answer

    @staticmethod
    def _has_driver(serial: str) -> bool:
        """Interfaces are bound to their drivers after the device shows up (vendor interfaces to none)."""
        device = serials()[serial]
        for interface in device.glob(f"{device.name}:*"):
            if (interface / "bInterfaceClass").read_text().strip() != "ff" and not (
                interface / "driver"
            ).exists():
                return False
        return any(device.glob(f"{device.name}:*"))

    @staticmethod
    def _until(condition: Any, what: str) -> None:
        end = time.monotonic() + SETTLE_S
        while True:
            try:
                if condition():
                    return
            except (OSError, KeyError):
                pass  # it changed while it was read
            if time.monotonic() > end:
                raise TimeoutError(f"waited {SETTLE_S} s for {what}")
            time.sleep(0.01)


def serials() -> dict[str, Path]:
    """Folders in sysfs of the devices that the kernel has, by serial number."""
    found = {}
    for device in USB_DEVICES.iterdir():
        try:
            found[(device / "serial").read_text().strip()] = device
        except OSError:
            continue
    return found


def node(serial: str, subsystem: str) -> Path:
    """Device node that the kernel made for a board: subsystem `hidraw` or `tty`; `usb` for its USB node."""
    device = serials()[serial]
    if subsystem == "usb":
        bus, number = (int((device / name).read_text()) for name in ("busnum", "devnum"))
        return Path(f"/dev/bus/usb/{bus:03}/{number:03}")
    names = [path.name for path in device.glob(f"{device.name}:*/**/{subsystem}/*")]
    if len(names) != 1:
        raise LookupError(f"{serial} has {names} in {subsystem}")
    return Path("/dev") / names[0]


def reload_rules() -> None:
    """Have udevd read its rules again; it may hang up on who asks while it is busy, and is asked again."""
    command = ["udevadm", "control", f"--timeout={RELOAD_S}", "--reload"]
    for _ in range(4):
        if subprocess.run(command, check=False, timeout=2 * RELOAD_S).returncode == 0:
            return
        settle()
    subprocess.run(command, check=True, timeout=2 * RELOAD_S)


def settle() -> None:
    """Wait for udevd."""
    subprocess.run(
        ["udevadm", "settle", f"--timeout={SETTLE_S}"],
        check=True,
        env=dict(os.environ),
        timeout=2 * SETTLE_S,
    )
