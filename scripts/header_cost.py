"""What the exported C header costs a firmware: bytes of flash, and clocks on an ATmega328P.

    python scripts/header_cost.py        # needs avr-gcc, simavr and arm-none-eabi-gcc

A calibration in the plane with gains, directions and g-sensitivities of all gyros; sizes are those of a
program with the function less those of one without (libgcc counts), clocks are those of simavr's timer 1,
the mean of 16 calls.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.handover.c_header import c_header
from handover.calibrations import CURVED, PLANE, calibration
from handover.gyros import FULL, with_gyros
from handover.machines import MACHINES, Machine

CALLS = {
    "angle, fixed point": "adis_gonio_angle_udeg(&scan)",
    "angle, float": "(uint32_t)adis_gonio_angle_deg(&scan)",
    "rates, fixed point": "(adis_gonio_rates_udps(&turn, &scan, fixed), fixed[0] + fixed[1] + fixed[2])",
    "rates, float": "(adis_gonio_rates_dps(&turn, &scan, single), (uint32_t)(single[0] + single[1]))",
    "self-check": "adis_gonio_self_check()",
}
_KEPT = ("-Wl,--gc-sections", "-Wl,--undefined=vectors")
PROGRAM = """
#define HEADER "own.h"
#define PREFIX adis_gonio
#include HEADER
#include "machine.h"
#if defined(__AVR__)
#define BEGIN() (TCCR1A = 0, TCCR1B = 0, TCNT1 = 0, TCCR1B = 2)
#define CLOCKS() (8UL * TCNT1)
#else
#define BEGIN() ((void)0)
#define CLOCKS() 0UL
#endif
int main(void)
{
    volatile uint32_t sink = 0;
    uint32_t clocks = 0;
    int k;
    state = 12345UL;
    for (k = 0; k < 16; k++) {
        int32_t fixed[3] = { 0, 0, 0 };
        float single[3] = { 0, 0, 0 };
        adis_gonio_scan scan;
        adis_gonio_turn turn;
        scan.x = (int32_t)(next() % 600000UL) - 300000L;
        scan.y = (int32_t)(next() % 600000UL) - 300000L;
        scan.z = (int32_t)(next() % 600000UL) - 300000L;
        scan.temperature = (int32_t)(next() % 20000UL);
        scan.supply = 700000L;
        turn.x = (int32_t)(next() % 4000000UL) - 2000000L;
        turn.y = (int32_t)(next() % 4000000UL) - 2000000L;
        turn.z = (int32_t)(next() % 4000000UL) - 2000000L;
        (void)fixed;
        (void)single;
        BEGIN();
        sink += (uint32_t)(CALL) + (uint32_t)(scan.x ^ turn.x);
        clocks += CLOCKS();
    }
    put_word(clocks / 16);
    put('\\n');
    (void)put_float;
    finish(0);
    return 0;
}
"""


def main() -> None:
    """Print the table."""
    own = with_gyros(calibration(PLANE, CURVED), FULL)
    targets = {one.name: one for one in MACHINES if one.name in ("avr", "cortex-m0", "cortex-m4f")}
    for name, machine in targets.items():
        if reason := machine.missing():
            print(f"{name}: {reason}")
            continue
        empty, _ = _measured(machine, c_header(own), "0")
        for what, call in CALLS.items():
            size, clocks = _measured(machine, c_header(own), call)
            told = f", {clocks:6d} clocks" if name == "avr" else ""
            print(f"{name:11} {what:20} {size - empty:6d} bytes{told}")


def _measured(machine: Machine, header: str, call: str) -> tuple[int, int]:
    """Flash of a program with a call in bytes, and clocks of the call."""
    kept = _KEPT[:1] if machine.name == "avr" else _KEPT
    small = replace(machine, compiler=(*machine.compiler, "-ffunction-sections", *kept))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "own.h").write_text(header)
        source = folder / "cost.c"
        source.write_text(PROGRAM)
        text = small.run(folder, "-Os", f"-DCALL={call}", "-Wno-unused-function", source=source)
        program = folder / f"cost-{machine.name}.elf"
        sizes = "avr-size" if machine.name == "avr" else "arm-none-eabi-size"
        row = subprocess.run([sizes, str(program)], capture_output=True, text=True, check=True).stdout
        words = row.splitlines()[1].split()
        clocks = re.search(r"\b[0-9a-f]{8}\b", text)
        return int(words[0]) + int(words[1]), int(clocks[0], 16) if clocks else 0


if __name__ == "__main__":
    main()
