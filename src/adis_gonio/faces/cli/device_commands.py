"""The commands `devices`, `registers`, `selftest`, `serve` and `frames`: the driver from the shell."""

from __future__ import annotations

import ipaddress
import math
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import use_minus
from adis_gonio.device.bus import find_devices
from adis_gonio.device.bus.host import udev_rules
from adis_gonio.device.sensor import REGISTERS, Adis16354, Register, open_sensor
from adis_gonio.device.sensor.driver import MARK
from adis_gonio.device.sensor.registers import CONFIDENCES, Kind, register
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import console, opened, print_json, print_table, say

if TYPE_CHECKING:
    from adis_gonio.handover.register_offsets import OffsetWord

_ASSIGNMENT = re.compile(r"(?P<name>[A-Za-z0-9_/]+)=(?P<value>.+)")
_VALUE = re.compile(r"(?P<number>[-+]?(0[xX][0-9a-fA-F]+|\d+(\.\d*)?([eE][-+]?\d+)?))\s*(?P<unit>\S*)")
_UNITS = {"dps": "°/s", "degc": "°C", "c": "°C"}


@option.command("devices")
@option.flag("--udev", help="Print the udev rules that let a user open the bridges.")
@option.json
def devices_command(*, udev: bool, as_json: bool) -> None:
    """List the buses and the connected devices, with the URL that opens each.

    If the program cannot search a bus, its row gives the reason; the exit status is still 0.

    Linux needs a rule before a user may open the devices. Write it, then plug the device in again:

    \b
    adis-gonio devices --udev | sudo tee /etc/udev/rules.d/70-adis-gonio.rules
    """  # noqa: D301 - click keeps the lines of a paragraph with this character
    if udev:
        click.echo(udev_rules(), nl=False)
        return
    devices = find_devices()
    if as_json:
        print_json({"devices": [device.as_dict() for device in devices]})
        return
    rows = [(device.url, device.description) for device in devices]
    print_table(console(), ("URL", "device"), rows, texts=(0, 1))


@option.command("selftest")
@option.url
@option.variant
@option.no_check
@option.json
def selftest_command(*, url: str, variant: str, no_check: bool, as_json: bool) -> int:
    """Run the sensor's internal self-test and report STATUS.

    The outputs are unavailable for 35 ms. Reading STATUS clears it. The exit status is 1 if the test
    failed.
    """
    with opened(open_sensor, url, variant=variant, check=not no_check) as sensor:
        before = sensor.status()
        after = sensor.self_test()
        supply = sensor.quantity("SUPPLY_OUT")
        written = sensor.read("ENDURANCE")
    failures = after.self_test_failures
    if as_json:
        print_json(
            {
                "passed": not failures,
                "failures": failures,
                "status_before": before.messages,
                "status_after": after.messages,
                "supply_v": supply.value,
                "endurance": written,
            }
        )
    else:
        click.echo(f"self-test    {'FAILED: ' + '; '.join(failures) if failures else 'passed'}")
        click.echo(f"STATUS       {before} (before)")
        click.echo(f"             {after} (after)")
        click.echo(f"supply       {supply.value:.3f} V")
        click.echo(f"flash        written {written} times of 10 000")
    return 1 if failures else 0


@option.command("serve")
@option.url
@option.with_default(
    "--iio",
    "port",
    type=click.IntRange(0, 65535),
    default=30431,
    metavar="PORT",
    help="TCP port; 0: a free one.",
)
@option.with_default(
    "--listen", "host", default="127.0.0.1", metavar="ADDRESS",
    help="Address to listen on; 0.0.0.0 is every address of this machine.",
)  # fmt: skip
@option.flag("--allow-writes", help="Let clients write calibbias, rate and filter.")
@option.variant
@option.no_check
def serve_command(
    *, url: str, port: int, host: str, allow_writes: bool, variant: str, no_check: bool
) -> None:
    """Serve the sensor as an IIO device to libiio's clients (iio_info, iio_readdev, pyadi-iio).

    Ctrl-C or SIGTERM ends the server. The sensor streams while a client has a buffer open; if the bridge
    can use data-ready, it is enabled during that time and then set back. Anybody who reaches the address
    can connect, because there is no password. Without --listen only this machine reaches it.
    """
    from adis_gonio.faces.serve import IioServer

    def ready(address: str, taken: int) -> None:
        writing = "clients may write" if allow_writes else "read-only"
        click.echo(
            f"{url}: served as iio:device0 at ip:{address}:{taken}, {writing}; Ctrl-C ends it", err=True
        )
        if not ipaddress.ip_address(address.partition("%")[0]).is_loopback:
            say("anybody who reaches this address can connect; there is no password")

    with opened(open_sensor, url, variant=variant, check=not no_check) as sensor:
        tell = partial(click.echo, err=True)
        IioServer(sensor, host, port, allow_writes=allow_writes, tell=tell, ready=ready).run()


@option.command("frames")
@click.argument("recording", type=option.FILE, metavar="RECORDING")
@option.variant
@option.json
def frames_command(*, recording: Path, variant: str, as_json: bool) -> int:
    """List the frames of a RECORDING with register names and decoded words.

    RECORDING is a file of record: or the VCD file of a logic analyser on CS, SCLK, MOSI and MISO, such as
    capture.vcd.

    Put record:FILE: before the URL of any command to record it: record:run.rec:serial:/dev/ttyACM0. A URL
    replay:FILE plays it back to any command; `stream` then shows the values of a block. A row has the
    number of the record, the time on the clock of the bus, the register, the frame, the word that answers
    it, and its value. A row with ! has an error, or a frame that breaks a rule of timing of the data sheet;
    grep finds it. The exit status is 1 if there is such a row, or if the recording is damaged.
    """
    from adis_gonio.device.bus.capture import LogicCapture
    from adis_gonio.device.bus.recording import BusRecording
    from adis_gonio.device.sensor.frame_log import FrameLog
    from adis_gonio.device.sensor.registers import variant as variant_of

    capture = recording.suffix.lower() == ".vcd"
    source = LogicCapture(recording) if capture else BusRecording(recording)
    problems, listed = 0, []
    for row in FrameLog(variant_of(variant)).rows(source):
        problems += bool(row.problem)
        if as_json:
            listed.append(row.as_dict())
        else:
            frame, word = (f"{x:04X}" if x is not None else "    " for x in (row.frame, row.word))
            line = f"{row.record:6} {row.time_s:12.6f} {row.action:5} {row.register:10} {frame} {word}"
            problem = f"  ! {row.problem}" if row.problem else ""
            say(f"{line} {row.value}".rstrip() + problem, err=False, hang=48)
    if as_json:
        print_json({"frames": listed, "problems": problems, "damage": source.damage})
    else:
        say(f"{problems} with a problem")
        if source.damage:
            say(f"{recording}: {source.damage}")
    return 1 if problems or source.damage else 0


@option.command("registers")
@click.argument("url", required=False)
@click.argument("words", nargs=-1, metavar="[NAME | NAME=VALUE]...")
@option.flag("--save", help="Save to flash after writing (ENDURANCE goes up by one).")
@option.file(
    "--cal", "calibration_path",
    help="Also show the offsets that this calibration (export, JSON) or session would write.",
)  # fmt: skip
@option.variant
@option.no_check
@option.json
def registers_command(
    *,
    url: str | None,
    words: tuple[str, ...],
    save: bool,
    calibration_path: Path | None,
    variant: str,
    no_check: bool,
    as_json: bool,
) -> None:
    """List, read and write registers.

    Without a URL, the command lists the table of registers; with a URL, also their contents. NAME reads one
    register, NAME=VALUE writes it and reads it back. VALUE is the register's number (decimal or 0x…) or a
    quantity with its unit. XACCL_OFF=-57.3mg lowers the output by 57.3 mg, because the sensor adds the
    offset registers to its outputs (`write` uses a session's biases). A list of all registers omits STATUS,
    because a read clears it; name it to read it. --cal FILE compares the offsets with a calibration: zero
    rates of the gyros in °/s (without the part due to gravity), biases of the accelerometers in mg.
    """
    if url is None:
        if calibration_path is not None:
            raise UsageError("--cal needs a URL: it is compared with the sensor's offsets")
        _show_registers([(row, None) for row in REGISTERS], {}, as_json=as_json)
        return
    matches = [(word, _ASSIGNMENT.fullmatch(word)) for word in words]
    writes = [(register(match["name"]), match["value"]) for _, match in matches if match]
    reads = [register(word) for word, match in matches if not match]
    if save and not writes:
        raise UsageError("--save needs NAME=VALUE: there is nothing to write")
    wanted: dict[str, OffsetWord] = {}
    if calibration_path is not None:
        from adis_gonio.handover.register_offsets import offset_words_in

        offsets, refused = offset_words_in(calibration_path)
        wanted = {offset.name: offset for offset in offsets}
        for reason in refused:
            say(f"not compared: {reason}")
    with opened(open_sensor, url, variant=variant, check=not no_check) as sensor:
        # All values are parsed before the first one is written.
        numbers = [(row, _parse_number(sensor, row, text)) for row, text in writes]
        for row, number in numbers:
            sensor.write(row, number)
        if save:
            sensor.save_to_flash()
        if not words:
            reads = [row for row in REGISTERS if row.readable and row.name != "STATUS"]
        if not save and any(row.flash_mask for row, _ in writes):
            say("volatile until saved to flash (--save)")
        held = [(row, sensor.quantity(row)) for row in [row for row, _ in writes] + reads]
        _show_registers(held, wanted, as_json=as_json)


def _parse_number(sensor: Adis16354, row: Register, text: str) -> int:
    """Parse the number for a register: `0x…`, a decimal number, or a quantity with its unit.

    Raises `UsageError` if the text is none of these or the unit is not the register's unit.
    """
    match = _VALUE.fullmatch(text.strip())
    if not match:
        raise UsageError(f"{row.name}={text}: write a number, 0x…, or a quantity such as -57.3mg")
    number, unit = match["number"], match["unit"]
    if not unit:
        try:
            return int(number, 0)
        except ValueError:
            raise UsageError(
                f"{row.name}={text}: a register holds whole numbers; give a unit for a quantity"
            ) from None
    lsb, zero, own = sensor.variant.lsb(row.kind, sensor.configuration().gyro_range_dps or 300)
    if not own or _UNITS.get(unit.lower(), unit) != own:
        raise UsageError(f"{row.name}={text}: its unit is {own or 'none'}, not {unit}")
    value = (float(number) - zero) / lsb
    if not math.isfinite(value):
        raise UsageError(f"{row.name}={text}: no register holds so large a number")
    return round(value)


def _show_registers(
    rows: list[tuple[Register, Any]], wanted: Mapping[str, OffsetWord], *, as_json: bool
) -> None:
    """Show registers with their contents as numbers and as physical values.

    `rows` has each register with its content as a `Quantity`, or None if the register was not read.
    `wanted` has the offsets of a calibration by register name; `as_json` prints a JSON document instead of
    a table.
    """
    for row, quantity in rows:
        if row.name.startswith("ALM_MAG") and quantity is not None and quantity.number == MARK:
            text = f"{row.name} holds the mark of an interrupted session, which has no effect"
            say(f"{text}; the next calibrate or flash update removes it")
    if as_json:
        documents = []
        for row, quantity in rows:
            offset = wanted.get(row.name)
            more = {} if offset is None else {"calibration": offset.as_dict()}
            documents.append(_register_document(row, quantity) | more)
        print_json({"registers": documents})
        return
    with_values = any(quantity is not None for _, quantity in rows)
    columns = ("number", "value", *(["by the calibration"] if wanted else []))
    head = ("register", "at", *(columns if with_values else ("bits", "access", "evidence")), "meaning")
    listed: list[list[str]] = []
    for row, quantity in rows:
        meaning = row.meaning
        if with_values:
            number = (
                f"0x{quantity.number:04X}" if row.kind is Kind.FIELDS else use_minus(str(quantity.number))
            )
            cells = [number, "" if row.kind in (Kind.FIELDS, Kind.COUNT) else str(quantity)]
            cells += [str(wanted.get(row.name, ""))] if wanted else []
        else:
            access = row.access + (", flash" if row.flash_mask else "")
            cells = [f"{row.bits}{'s' if row.signed else 'u'}", access, row.confidence]
            meaning += f" (default 0x{row.default:04X})" if row.default else ""
        listed.append([row.name, f"0x{row.address:02X}", *cells, meaning])
        for field in row.fields if with_values and len(rows) <= 4 else ():
            bits = f"[{field.high}:{field.low}]" if field.high != field.low else f"[{field.low}]"
            held = [str(field.of(quantity.number)), *[""] * (len(cells) - 1)]
            listed.append([f"  {field.name}", bits, *held, field.meaning])
    screen = console()
    print_table(screen, head, listed, {0, 1, len(head) - 1} | (set() if with_values else {3, 4}))
    if not with_values:
        screen.print("\n".join(f"evidence {letter}: {meaning}" for letter, meaning in CONFIDENCES.items()))


def _register_document(row: Register, quantity: Any) -> dict[str, Any]:
    document: dict[str, Any] = {
        name: getattr(row, name)
        for name in ("name", "address", "bits", "signed", "default", "meaning", "source")
    }
    document |= {"access": row.access, "in_flash": bool(row.flash_mask), "confidence": row.confidence}
    if row.fields:
        document["fields"] = [
            {"name": field.name, "high": field.high, "low": field.low, "meaning": field.meaning}
            for field in row.fields
        ]
    if quantity is not None:
        document |= {"number": quantity.number, "value": quantity.value, "unit": quantity.unit}
        if row.fields:
            document["held"] = {field.name: field.of(quantity.number) for field in row.fields}
    return document
