"""Write the C headers and the Python constants of the wire protocol from firmware_proto/protocol.toml.

`--check` writes nothing and exits with 1 where a file is not up to date.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "firmware_proto" / "protocol.toml"
HEADER = ROOT / "firmware_proto" / "core" / "gonio_protocol.h"
CRC_TABLE = ROOT / "firmware_proto" / "core" / "gonio_crc_table.h"
MODULE = ROOT / "src" / "adis_gonio" / "device" / "bus" / "wire" / "protocol.py"

SIZES = {"u8": 1, "u16": 2, "u32": 4}
FORMATS = {"u8": "B", "u16": "H", "u32": "I"}
TAILS = ("words", "text")
NOTE = "Generated from firmware_proto/protocol.toml by scripts/generate_protocol.py; do not edit."

Table = dict[str, Any]
Fields = list[dict[str, str]]


def bodies(table: Table) -> list[tuple[str, int, str, Fields]]:
    """Name, packet type, text and fields of every body, requests before their replies."""
    rows: list[tuple[str, int, str, Fields]] = []
    reply_bit = table["packet"]["reply_bit"]
    for message in table["message"]:
        name, kind, text = message["name"], message["type"], message["text"]
        rows.append((f"{name}_request", kind, text, message["request"]))
        rows.append((f"{name}_reply", kind | reply_bit, f"Reply to the request {name}.", message["reply"]))
    rows += [(event["name"], event["type"], event["text"], event["body"]) for event in table["event"]]
    return rows


def split(kind: str) -> tuple[str, int]:
    """Element type and count of a field's type; a tail has count 0."""
    if kind in TAILS:
        return kind, 0
    base, _, count = kind.partition("[")
    return base, int(count.rstrip("]")) if count else 1


def size(fields: Fields) -> int:
    """Bytes of a body without its tail."""
    return sum(SIZES[base] * count for base, count in (split(f["type"]) for f in fields) if count)


def check(table: Table) -> None:
    """Types are unique, tails stand last, fixed bodies fit a packet."""
    rows = bodies(table)
    kinds = [kind for _, kind, _, _ in rows]
    if len(set(kinds)) != len(kinds):
        raise SystemExit(f"{TABLE}: a packet type stands twice")
    for name, _, _, fields in rows:
        if any(split(field["type"])[1] == 0 for field in fields[:-1]):
            raise SystemExit(f"{TABLE}: {name}: a tail must be the last field")
        room = table["packet"]["max_raw"] - table["packet"]["header_size"] - table["packet"]["crc_size"]
        if size(fields) > room:
            raise SystemExit(f"{TABLE}: {name}: {size(fields)} bytes do not fit a packet")


def header(table: Table) -> str:
    """The C header."""
    out = [f"/* {NOTE} */", "#ifndef GONIO_PROTOCOL_H", "#define GONIO_PROTOCOL_H", ""]

    def define(name: str, value: str, text: str = "") -> None:
        out.append(f"#define GP_{name.upper()} {value}" + (f" /* {text} */" if text else ""))

    protocol, packet = table["protocol"], table["packet"]
    define("version", f"{protocol['version']}u")
    define("baud", f"{protocol['baud']}ul")
    define("baud_fast", f"{protocol['baud_fast']}ul")
    out.append("")
    for name in ("header_size", "crc_size", "max_raw"):
        define(name, f"{packet[name]}u")
    define("crc_initial", f"0x{packet['crc_initial']:08X}ul", packet["crc"])
    define("crc_final", f"0x{packet['crc_final']:08X}ul")
    define("delimiter", f"0x{packet['delimiter']:02X}u")
    define("reply_bit", f"0x{packet['reply_bit']:02X}u")
    out.append("")
    for name, value in table["limits"].items():
        define(name, f"0x{value:04X}u" if name.endswith(("bit", "frame")) else f"{value}u")
    out.append("")
    for name, value in table["defaults"].items():
        define(f"default_{name}", f"{value}ul")
    out.append("")
    for name, row in table["capabilities"].items():
        define(f"cap_{name}", f"0x{1 << row['bit']:04X}u", row["text"])
    for prefix in ("trigger", "error"):
        out.append("")
        for name, row in table[f"{prefix}s"].items():
            define(f"{prefix}_{name}", f"{row['code']}u", row["text"])
    for name, kind, text, fields in bodies(table):
        out += ["", f"/* {name}: {text} */"]
        define(f"type_{name}", f"0x{kind:02X}u")
        at = 0
        for field in fields:
            base, count = split(field["type"])
            define(f"{name}_{field['name']}", f"{at}u", f"{field['type']}: {field['text']}")
            at += SIZES.get(base, 0) * count
        define(f"{name}_size", f"{at}u", "without a tail")
    return "\n".join([*out, "", "#endif", ""])


def crc_entry(byte: int, polynomial: int) -> int:
    """Remainder of a byte, bits reflected."""
    for _ in range(8):
        byte = byte >> 1 ^ (polynomial if byte & 1 else 0)
    return byte


def crc_table(table: Table) -> str:
    """The C file with the table of the CRC; whoever includes it says by GONIO_IN_FLASH where it is kept."""
    entries = [f"0x{crc_entry(byte, table['packet']['crc_polynomial']):08X}ul," for byte in range(256)]
    rows = ["    " + " ".join(entries[at : at + 8]) for at in range(0, 256, 8)]
    head = [f"/* {NOTE} */", f"/* {table['packet']['crc']}, by bytes. */"]
    return "\n".join([*head, "static const uint32_t crc_table[256] GONIO_IN_FLASH = {", *rows, "};", ""])


def sentence(text: str) -> str:
    """The text with a capital."""
    return text[0].upper() + text[1:]


def class_name(name: str) -> str:
    """`hello_request` as a class."""
    return "".join(part.capitalize() for part in name.split("_"))


def module(table: Table) -> str:
    """The Python module."""
    protocol, packet = table["protocol"], table["packet"]
    out = ['"""Constants and packet bodies of the wire protocol.', "", NOTE, '"""', ""]
    out += ["from __future__ import annotations", ""]
    out += ["from enum import IntEnum, IntFlag", ""]
    out += [
        "from adis_gonio.device.bus.contract import Words",
        "from adis_gonio.device.bus.wire.body import Body",
        "",
    ]
    out += [f"VERSION = {protocol['version']}", f"BAUD = {protocol['baud']:_}"]
    out.append("")
    out += [f"{name.upper()} = {packet[name]}" for name in ("header_size", "crc_size", "max_raw")]
    out += [f"REPLY_BIT = 0x{packet['reply_bit']:02X}", ""]
    limits = table["limits"]
    out += [f"WRITE_BIT = 0x{limits['write_bit']:04X}", f"RETRY_MS = {limits['retry_ms']}"]
    rows = bodies(table)
    out += ["", "", "class PacketType(IntEnum):", '    """Type of a packet: its first byte."""', ""]
    out += [f"    {name.upper()} = 0x{kind:02X}" for name, kind, _, _ in rows]
    out += ["", "", "class FirmwareCapability(IntFlag):", '    """Capabilities of a firmware."""', ""]
    for name, row in table["capabilities"].items():
        out += [f"    {name.upper()} = 1 << {row['bit']}", f'    """{sentence(row["text"])}."""']
    for title, key, text in (
        ("Trigger", "triggers", "Start of a scan of a stream."),
        ("Refusal", "errors", "Reason of a refused request."),
    ):
        out += ["", "", f"class {title}(IntEnum):", f'    """{text}"""', ""]
        for name, row in table[key].items():
            out += [f"    {name.upper()} = {row['code']}", f'    """{sentence(row["text"])}."""']
    out += ["", "", "REFUSAL_TEXT: dict[int, str] = {"]
    out += [f'    Refusal.{name.upper()}: "{row["text"]}",' for name, row in table["errors"].items()]
    out += ["}"]
    for name, _, text, fields in rows:
        formats, names, tail = "", [], ""
        for field in fields:
            base, count = split(field["type"])
            python = {"words": "Words", "text": "str"}.get(base, "int" if count == 1 else "tuple[int, ...]")
            names.append((field["name"], python, field["text"]))
            if count:
                formats += f"{count if count > 1 else ''}{FORMATS[base]}"
            else:
                tail = base
        given = f"type=PacketType.{name.upper()}"
        given += f', layout="{formats}"' if formats else ""
        given += f', tail="{tail}"' if tail else ""
        out += ["", "", f"class {class_name(name)}(Body, {given}):", f'    """{text}"""']
        if names:
            out.append("")
        for field_name, python, field_text in names:
            out += [f"    {field_name}: {python}", f'    """{sentence(field_text)}."""']
    return "\n".join([*out, ""])


def main(arguments: list[str]) -> int:
    """Write or check; returns the exit status."""
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    check(table)
    stale = []
    for path, text in ((HEADER, header(table)), (CRC_TABLE, crc_table(table)), (MODULE, module(table))):
        if arguments == ["--check"]:
            if not path.exists() or path.read_text(encoding="utf-8") != text:
                stale.append(path)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    for path in stale:
        print(f"{path.relative_to(ROOT)} is not up to date: run scripts/generate_protocol.py")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
