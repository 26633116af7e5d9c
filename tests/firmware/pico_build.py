"""The Pico's firmware as UF2, built by arm-none-eabi-gcc, once a test run and set of options."""

import shutil
from functools import cache
from pathlib import Path

from firmware.make import make as run_make

PORT = Path(__file__).parents[2] / "firmware_proto" / "rp2040"
RIG = Path(__file__).parents[1] / "rig_rp2040"


def missing() -> str:
    """What is missing to build and run the firmware; empty where nothing is."""
    for tool, package in (
        ("arm-none-eabi-gcc", "gcc-arm-none-eabi picolibc-arm-none-eabi"),
        ("make", "make"),
        ("node", "nodejs"),
    ):
        if shutil.which(tool) is None:
            return f"{tool} is not installed (Debian: {package})"
    if not (RIG / "node_modules" / "rp2040js").is_dir():
        return "rp2040js is not installed (npm ci in tests/rig_rp2040)"
    return ""


def make(folder: Path, *arguments: str) -> str:
    """Run make with its products in a folder; returns what it printed."""
    return run_make(PORT, folder, *arguments)


@cache
def _built(folder: Path, options: tuple[str, ...]) -> Path:
    make(folder, "all", *options)
    return folder / "gonio.uf2"


def uf2(base: Path, **options: str) -> Path:
    """The UF2 file for options such as VID="0x2E8A"; gonio.elf lies beside it."""
    words = tuple(f"{name}={value}" for name, value in sorted(options.items()))
    return _built(base / ("pico" + "".join(f"-{word}" for word in words)), words)
