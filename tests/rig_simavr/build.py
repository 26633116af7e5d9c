"""The rig's programs and libraries, built by gcc once a folder."""

import shutil
import subprocess
from functools import cache
from pathlib import Path

from firmware import avr_build

HERE = Path(__file__).parent
_HEADERS = ("/usr/include/simavr/sim_avr.h", "/usr/include/libelf.h")


def missing_compiler() -> str:
    """What is missing to build the libraries; empty where nothing is."""
    for tool in ("gcc", "make"):
        if shutil.which(tool) is None:
            return f"{tool} is not installed (Debian: gcc make)"
    return ""


def missing() -> str:
    """What is missing to build and run the rig; empty where nothing is."""
    if reason := missing_compiler():
        return reason
    if shutil.which("avr-gcc") is None:
        return "avr-gcc is not installed (Debian: gcc-avr avr-libc binutils-avr)"
    if not all(Path(header).is_file() for header in _HEADERS):
        return "simavr is not installed (Debian: libsimavr-dev libelf-dev)"
    return ""


@cache
def make(folder: Path, target: str) -> Path:
    """Build `chip` or `rig` with the products in a folder, which is returned."""
    run = subprocess.run(
        ["make", "-s", "-C", str(HERE), f"BUILD={folder}", target],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    if run.returncode:
        raise RuntimeError(f"make {target} failed:\n{run.stdout}{run.stderr}")
    return folder


def elf(folder: Path) -> Path:
    """The firmware's ELF."""
    return avr_build.elf(folder)
