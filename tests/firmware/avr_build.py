"""The firmware's ELF, built by avr-gcc, once a test run and set of options."""

import shutil
from functools import cache
from pathlib import Path

from firmware.make import make as run_make

PORT = Path(__file__).parents[2] / "firmware_proto" / "atmega328p"


def missing() -> str:
    """What is missing to build and run the firmware; empty where nothing is."""
    for tool in ("avr-gcc", "make"):
        if shutil.which(tool) is None:
            return f"{tool} is not installed (Debian: gcc-avr avr-libc binutils-avr make)"
    try:
        import yasimavr  # noqa: F401
    except ImportError:
        return "yasimavr is not installed (pip install yasimavr; needs libelf-dev)"
    return ""


def make(folder: Path, *arguments: str) -> str:
    """Run make with its products in a folder; returns what it printed."""
    return run_make(PORT, folder, *arguments)


@cache
def _built(folder: Path, options: tuple[str, ...]) -> Path:
    make(folder, "all", *options)
    return folder / "gonio.elf"


def elf(base: Path, **options: int) -> Path:
    """The ELF for options such as BAUD=1000000."""
    words = tuple(f"{name}={value}" for name, value in sorted(options.items()))
    return _built(base / ("firmware" + "".join(f"-{word}" for word in words)), words)
