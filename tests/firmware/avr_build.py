"""The firmware's ELF, built by avr-gcc, once a test run and set of options."""

import shutil
import subprocess
from functools import cache
from pathlib import Path

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
    run = subprocess.run(
        ["make", "-s", "-C", str(PORT), f"BUILD={folder}", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    if run.returncode:
        raise RuntimeError(f"make failed:\n{run.stdout}{run.stderr}")
    return run.stdout


@cache
def _built(folder: Path, options: tuple[str, ...]) -> Path:
    make(folder, "all", *options)
    return folder / "gonio.elf"


def elf(base: Path, **options: int) -> Path:
    """The ELF for options such as BAUD=1000000."""
    words = tuple(f"{name}={value}" for name, value in sorted(options.items()))
    return _built(base / ("firmware" + "".join(f"-{word}" for word in words)), words)
