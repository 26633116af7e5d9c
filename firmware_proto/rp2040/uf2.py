"""Write the flash image of the RP2040 as UF2, with the checksum that its boot ROM wants of boot2.

    python3 uf2.py boot2.bin application.bin gonio.uf2

boot2 is padded to 252 bytes and followed by a CRC-32 of its own kind (polynomial 0x04C11DB7, not reflected,
start 0xFFFFFFFF, no final exclusive-or: RP2040 data sheet, 2.8.1.3.1). The application comes behind it.
UF2 is blocks of 512 bytes with 256 of the image each (github.com/microsoft/uf2).
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path

FLASH = 0x1000_0000
FAMILY = 0xE48B_FF56
MAGIC = (0x0A32_4655, 0x9E5D_5157, 0x0AB1_6F30)
HAS_FAMILY = 0x2000
BOOT2_SIZE = 252
PAYLOAD = 256


def crc32(data: bytes) -> int:
    """The boot ROM's CRC."""
    crc = 0xFFFF_FFFF
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C1_1DB7 if crc & 0x8000_0000 else crc << 1) & 0xFFFF_FFFF
    return crc


def image(boot2: bytes, application: bytes) -> bytes:
    """The flash's content from its first byte on.

    Raises
    ------
    ValueError
        boot2 is too long or empty.
    """
    if not 0 < len(boot2) <= BOOT2_SIZE:
        raise ValueError(f"boot2 has {len(boot2)} bytes; it takes 1 to {BOOT2_SIZE}")
    padded = boot2.ljust(BOOT2_SIZE, b"\0")
    return padded + struct.pack("<I", crc32(padded)) + application


def uf2(flash: bytes) -> bytes:
    """A UF2 file that writes this to the flash."""
    count = -(-len(flash) // PAYLOAD)
    blocks = []
    for number in range(count):
        payload = flash[number * PAYLOAD : (number + 1) * PAYLOAD].ljust(PAYLOAD, b"\0")
        place = FLASH + number * PAYLOAD
        head = struct.pack("<8I", *MAGIC[:2], HAS_FAMILY, place, PAYLOAD, number, count, FAMILY)
        blocks.append(head + payload.ljust(476, b"\0") + struct.pack("<I", MAGIC[2]))
    return b"".join(blocks)


def main() -> None:
    """Write the file, or say what is wrong."""
    if len(sys.argv) != 4:
        sys.exit("give boot2.bin, application.bin and the UF2 file to write")
    boot2, application, out = map(Path, sys.argv[1:])
    try:
        out.write_bytes(uf2(image(boot2.read_bytes(), application.read_bytes())))
    except (OSError, ValueError) as error:
        sys.exit(f"uf2.py: {error}")


if __name__ == "__main__":
    main()
