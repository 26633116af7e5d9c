"""Compilers and machines on which the header is run: what each is, and why it cannot be where it cannot."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
STRICT = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
SIMAVR_HEADER = Path("/usr/include/simavr/avr/avr_mcu_section.h")
PATIENCE_S = 600


@dataclass(frozen=True)
class Machine:
    """A compiler with its options, and what runs the program."""

    name: str
    compiler: tuple[str, ...]
    runner: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()
    needs: tuple[Path, ...] = ()

    def missing(self) -> str:
        """What is not installed; empty where nothing is."""
        tools = [self.compiler[0], *self.runner[:1]]
        lacking = [tool for tool in tools if shutil.which(tool) is None]
        lacking += [str(path) for path in self.needs if not path.exists()]
        return f"{', '.join(lacking)} not installed (scripts/install_rigs.sh)" if lacking else ""

    def run(self, folder: Path, *options: str, source: Path = HERE / "sweep.c") -> str:
        """Compile with a folder among the include paths, run, and return what was printed."""
        program = folder / f"{source.stem}-{self.name}.elf"
        words = [
            *self.compiler,
            *STRICT,
            f"-I{folder}",
            f"-I{HERE}",
            "-o",
            str(program),
            *options,
            str(source),
            *self.libraries,
        ]
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        ran = subprocess.run(
            [*self.runner, str(program)],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
            env={**os.environ, "TERM": "dumb"},
        )
        assert ran.returncode == 0, ran.stderr
        return _plain(ran.stdout + ran.stderr)


_M = (
    "arm-none-eabi-gcc", "-std=c99", "-mthumb", "-nostartfiles", "-nostdlib", "-static",
    "-Wl,--section-start=.vectors=0,-Ttext=0x100,-Tdata=0x20000000,-e,start",
)  # fmt: skip
_QEMU = (
    "qemu-system-arm",
    "-nographic",
    "-monitor",
    "none",
    "-serial",
    "none",
    "-semihosting-config",
    "enable=on,target=native",
)
_LIBGCC = ("-lgcc",)
MACHINES = (
    Machine("host", ("gcc", "-std=c99")),
    Machine("host-O0", ("gcc", "-std=c99", "-O0")),
    Machine("c++", ("g++", "-std=c++11", "-x", "c++")),
    Machine(
        "avr",
        (
            "avr-gcc",
            "-std=c99",
            "-mmcu=atmega328p",
            f"-I{SIMAVR_HEADER.parent}",
            "-Wl,--undefined=_mmcu,--section-start=.mmcu=0x910000",
        ),
        ("simavr", "-m", "atmega328p", "-f", "16000000"),
        needs=(SIMAVR_HEADER,),
    ),
    Machine("cortex-m0", (*_M, "-mcpu=cortex-m0"), (*_QEMU, "-M", "microbit", "-kernel"), _LIBGCC),
    Machine(
        "cortex-m4f",
        (*_M, "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
        (*_QEMU, "-M", "mps2-an386", "-kernel"),
        _LIBGCC,
    ),
)


def _plain(text: str) -> str:
    """Lines without the colours and marks of simavr."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    return "\n".join(line.rstrip(".").strip() for line in text.splitlines())
