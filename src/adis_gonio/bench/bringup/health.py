"""Supply, temperature, standing faults, and which part it is."""

from __future__ import annotations

import numpy as np

from adis_gonio.bench.bringup.bench import BringupBench, BringupStep, Floats
from adis_gonio.bench.bringup.result import Findings, StepResult
from adis_gonio.device.sensor.decoding import scales
from adis_gonio.device.sensor.driver import PLAUSIBLE
from adis_gonio.device.sensor.registers import ACCEL_OFF, ACCEL_OUT, BY_NAME, TEMP_OUT, registers
from adis_gonio.device.sensor.settings import Status, white_noise_gain
from adis_gonio.device.sensor.variants import VARIANTS, Variant

SUPPLY_V = (4.75, 5.25)
"""Limits of the supply (DS, B), the ones of STATUS."""
TEMPERATURE_C = (-40.0, 85.0)
"""Range of operation of the siblings (DS, B)."""
GRAVITY_U = 0.0026 / np.sqrt(3)
"""Relative: gravity is within 0.26 % of the standard value at all places on earth's surface."""
_SCANS = 256


def mean_and_u(numbers: Floats, gain: float = 1.0) -> tuple[Floats, Floats]:
    """Means (k,) of numbers (n, k) and their standard uncertainties, in LSB.

    The filter takes no noise out at the lowest frequencies: unfiltered, σ/√n with the σ that filtered
    noise of this `gain` had. Where the noise is below an LSB, its rounding is not random: 1/√12.
    """
    spread = numbers.std(axis=0, ddof=1) / gain
    return numbers.mean(axis=0), np.hypot(spread / np.sqrt(len(numbers)), 1 / np.sqrt(12))


class Health(BringupStep):
    """Supply and temperature, and what STATUS says of them."""

    name = "supply"
    does = f"{_SCANS} readings of supply and temperatures; STATUS, read twice (a read clears it)"

    def run(self, bench: BringupBench) -> StepResult:
        """Compare with the limits of operation."""
        first = bench.status()
        bench.wait_updates()
        standing = Status(bench.status())
        names = ("SUPPLY_OUT", *TEMP_OUT)
        block, _ = bench.scans(_SCANS, names)
        lsb, zero, _ = scales(registers(names), bench.sensor.variant, 300)
        mean, u = mean_and_u(block.numbers().astype(np.float64), _gain(bench))
        value, u = zero + lsb * mean, lsb * u
        found = Findings()
        found.measure("supply", value[0], "V", u[0], 5.0)
        for axis, t, s in zip("xyz", value[1:], u[1:], strict=True):
            found.measure(f"temperature {axis}", t, "degC", s)
        found.measure("STATUS as it was found", first)
        found.measure("STATUS read again", standing.word, expected=0)
        wrong = []
        z = bench.budget.z()
        if not SUPPLY_V[0] - z * u[0] <= value[0] <= SUPPLY_V[1] + z * u[0]:
            bench.supply_ok = False
            wrong.append(f"the supply is {value[0]:.3f} V, the part needs {SUPPLY_V[0]} to {SUPPLY_V[1]} V")
        for axis, t, s in zip("XYZ", value[1:], u[1:], strict=True):
            if not TEMPERATURE_C[0] - bench.budget.z() * s <= t <= TEMPERATURE_C[1] + bench.budget.z() * s:
                wrong.append(f"{axis}TEMP_OUT says {t:.0f} °C")
        if standing.word:
            wrong.append(f"STATUS: {standing}")
        if standing.flags["supply_low"] or standing.flags["supply_high"]:
            bench.supply_ok = False
        if wrong:
            return found.fault("; ".join(wrong))
        warmth = ", ".join(f"{t:.1f}" for t in value[1:])
        return found.ok(f"supply {value[0]:.3f} V, temperatures {warmth} °C, STATUS clear")


class WhichPart(BringupStep):
    """|a| at rest: the only mark of the variant."""

    name = "variant"
    does = (
        f"|a| at rest over {_SCANS} scans, less the offset registers: 2140 LSB on the ADIS16354, 397 on the"
        " ADIS16350/55"
    )

    def run(self, bench: BringupBench) -> StepResult:
        """Compare |a| with 1 g of each variant."""
        block, _ = bench.scans(_SCANS, ACCEL_OUT)
        mean, u = mean_and_u(block.numbers().astype(np.float64), _gain(bench))
        # The table's bias is the part's own, without what somebody wrote against it.
        offsets = [row.number(bench.constants[row.name]) for row in registers(ACCEL_OFF)]
        mean = mean - offsets
        norm = float(np.linalg.norm(mean))
        u_norm = float(np.sqrt((mean * u) @ (mean * u))) / max(norm, 1e-9)
        asked = bench.sensor.variant
        warm = bench.sensor.quantity("XTEMP_OUT").value - 25.0
        tolerance = float(np.hypot(_tolerance(asked, warm), u_norm * asked.accel_mg_per_lsb / 1000))
        off = norm / asked.one_g_lsb - 1
        found = Findings()
        found.measure("|a|", norm, "LSB", u_norm, asked.one_g_lsb)
        for name, m, s in zip(ACCEL_OUT, mean, u, strict=True):
            found.measure(f"mean of {name}, less its offset", m, "LSB", s)
        found.measure("tolerance of |a| (1 sigma)", tolerance * asked.one_g_lsb, "LSB")
        nearest = min(VARIANTS.values(), key=lambda v: abs(np.log(max(norm, 1e-9) / v.one_g_lsb)))
        fits = [v for v in VARIANTS.values() if abs(norm / v.one_g_lsb - 1) <= PLAUSIBLE]
        if nearest.one_g_lsb != asked.one_g_lsb and fits:
            names = " or ".join(v.name.upper() for v in fits)
            bench.sensor.variant = fits[0]
            return found.fault(
                f"|a| is {norm:.0f} LSB: this is an {names}, not an {asked.name.upper()}"
                f" ({asked.one_g_lsb:.0f} LSB); the rest is judged as for an {fits[0].name.upper()}"
            )
        if not fits:
            return found.fault(f"|a| is {norm / asked.one_g_lsb:.2f} g: no known part; was it still?")
        if abs(off) > bench.budget.z() * tolerance:
            return found.differs(
                f"|a| is {1000 * norm / asked.one_g_lsb:.0f} mg, further from 1 g than the table's bias and"
                " gain allow"
            )
        return found.ok(f"|a| is {norm:.0f} LSB, {1 + off:.3f} g of an {asked.name.upper()}")


def _tolerance(part: Variant, warm_c: float) -> float:
    """Relative standard deviation of |a| over parts and places."""
    figures = part.performance
    return float(
        np.sqrt(
            (figures.initial_bias_mg / 1000) ** 2
            + figures.scale_error_typical**2
            + (figures.bias_tempco_mg_per_c * warm_c / 1000) ** 2
            + GRAVITY_U**2
        )
    )


def _gain(bench: BringupBench) -> float:
    """Gain of the filter in force for white noise, rms."""
    return white_noise_gain(BY_NAME["SENS_AVG"].field("m").of(bench.sensor.read("SENS_AVG")))
