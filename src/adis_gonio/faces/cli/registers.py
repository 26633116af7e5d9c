"""`adis-gonio registers`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor import REGISTERS, Adis16354, Register, open_sensor
from adis_gonio.device.sensor.registers import Kind, register
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import console, print_json

if TYPE_CHECKING:
    from adis_gonio.handover.register_offsets import OffsetWord

_ASSIGNMENT = re.compile(r"(?P<name>[A-Za-z0-9_/]+)=(?P<value>.+)")
_VALUE = re.compile(r"(?P<number>[-+]?(0[xX][0-9a-fA-F]+|\d+(\.\d*)?([eE][-+]?\d+)?))\s*(?P<unit>\S*)")
_UNITS = {"dps": "°/s", "degc": "°C", "c": "°C"}


@click.command("registers")
@click.argument("url", required=False)
@click.argument("what", nargs=-1, metavar="[NAME | NAME=VALUE]...")
@click.option("--fields", is_flag=True, help="Show the bit fields of control registers.")
@click.option("--save", is_flag=True, help="Save to flash after writing (ENDURANCE goes up by one).")
@option.file(
    "--cal",
    "calibration_path",
    metavar="FILE",
    help="Show beside the offsets what this calibration (export, JSON) or session would write.",
)
@option.variant
@option.no_check
@option.json
def command(
    *,
    url: str | None,
    what: tuple[str, ...],
    fields: bool,
    save: bool,
    calibration_path: Path | None,
    variant: str,
    no_check: bool,
    as_json: bool,
) -> None:
    """List, read and write registers.

    Without URL the table of registers is shown; with a URL also what they hold. NAME reads one, NAME=VALUE
    writes it and reads it back. VALUE is the register's number (decimal or 0x…) or a quantity with its
    unit, such as XACCL_OFF=-57.3mg, which takes 57.3 mg off: the part adds its offset registers to its
    outputs (`write` puts a session's biases there). Listing all registers leaves STATUS alone, because a
    read clears it; name it to read it. --cal FILE puts what a calibration would write beside the offsets:
    zero rates of the gyros in °/s (without what gravity adds to them), biases of the accelerometers in mg.
    """
    if url is None:
        if calibration_path is not None:
            raise UsageError("--cal goes with a URL: it is compared with what the sensor holds")
        _show([(row, None) for row in REGISTERS], fields=fields, as_json=as_json)
        return
    writes: list[tuple[Register, str]] = []
    reads: list[Register] = []
    for word in what:
        match = _ASSIGNMENT.fullmatch(word)
        if match:
            writes.append((register(match["name"]), match["value"]))
        else:
            reads.append(register(word))
    if save and not writes:
        raise UsageError("--save goes with NAME=VALUE: nothing was to be written")
    wanted_offsets = {} if calibration_path is None else _wanted(calibration_path)
    with open_sensor(url, variant=variant, check=not no_check) as sensor:
        numbers = [(row, _number(sensor, row, text)) for row, text in writes]
        for row, number in numbers:
            sensor.write(row, number)
        if save:
            sensor.save_to_flash()
        if not what:
            reads = [row for row in REGISTERS if row.readable and row.name != "STATUS"]
        wanted = [row for row, _ in writes] + reads
        if not save and any(row.flash_mask for row, _ in writes):
            click.echo("volatile until saved to flash (--save)", err=True)
        held = [(row, sensor.quantity(row)) for row in wanted]
        _show(held, fields=fields, as_json=as_json, beside=wanted_offsets)


def _wanted(path: Path) -> dict[str, OffsetWord]:
    """What a calibration would write, by register."""
    from adis_gonio.handover.register_offsets import offset_words_in

    return {one.name: one for one in offset_words_in(path)}


def _number(sensor: Adis16354, row: Register, text: str) -> int:
    """Number for a register from `0x…`, a decimal, or a quantity with its unit."""
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
    return round((float(number) - zero) / lsb)


def _show(
    rows: list[tuple[Register, Any]],
    *,
    fields: bool,
    as_json: bool,
    beside: Mapping[str, OffsetWord] | None = None,
) -> None:
    beside = beside or {}
    if as_json:
        told = {name: {"calibration": one.as_dict()} for name, one in beside.items()}
        shown = [_as_dict(row, quantity) | told.get(row.name, {}) for row, quantity in rows]
        print_json({"registers": shown})
        return
    from rich.table import Table

    with_values = any(quantity is not None for _, quantity in rows)
    if with_values:
        columns = (">number", ">value", *([">by the calibration"] if beside else []))
    else:
        columns = (">bits", "access", ">default", "flash", "confidence")
    table = Table(box=None, padding=(0, 2, 0, 0))
    for name in ("register", "address", *columns):
        table.add_column(name.lstrip(">"), justify="right" if name[0] == ">" else "left")
    table.add_column("meaning", overflow="fold")
    for row, quantity in rows:
        cells = [row.name, f"0x{row.address:02X}"]
        if with_values:
            plain = row.kind in (Kind.FIELDS, Kind.COUNT)
            cells += [
                f"0x{quantity.number:04X}" if row.kind is Kind.FIELDS else str(quantity.number),
                "" if plain else str(quantity),
                *([str(beside.get(row.name, ""))] if beside else []),
            ]
        else:
            cells += [
                f"{row.bits}{'s' if row.signed else 'u'}",
                row.access.value,
                f"0x{row.default:04X}",
                "yes" if row.flash_mask else "",
                row.confidence,
            ]
        table.add_row(*cells, row.meaning)
        if fields or (with_values and len(rows) <= 4):
            for field in row.fields:
                bits = f"[{field.high}:{field.low}]" if field.high != field.low else f"[{field.low}]"
                spare = [""] * (2 if beside else 1)
                held = [str(field.of(quantity.number)), *spare] if with_values else [""] * 5
                table.add_row(f"  {field.name}", rf"\{bits}", *held, field.meaning, style="dim")
    console().print(table)


def _as_dict(row: Register, quantity: Any) -> dict[str, Any]:
    document: dict[str, Any] = {
        "name": row.name,
        "address": row.address,
        "bits": row.bits,
        "signed": row.signed,
        "access": row.access.value,
        "default": row.default,
        "in_flash": bool(row.flash_mask),
        "meaning": row.meaning,
        "source": row.source,
        "confidence": row.confidence,
    }
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
