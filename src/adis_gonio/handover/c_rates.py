"""What the header's template needs to know of the gyros."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, GyroCalibration
from adis_gonio.handover.fixed import FixedPoint, Q
from adis_gonio.handover.literals import comment, factor_text, shift_text, single, whole
from adis_gonio.handover.polynomial import PARTS
from adis_gonio.handover.rates import (
    FIXED_UDPS,
    FLOAT_DPS,
    LIMIT,
    LIMIT_DPS,
    RATE_Q,
    STEP_DPS,
    FixedRates,
    RatePolynomial,
    rate_polynomial_of,
)
from adis_gonio.model.effects import AXES

CHECKS = 4
_FIELDS = {"t": "temperature", "v": "supply"}


def rates_content(calibration: Calibration, gyro: GyroCalibration, name: str) -> dict[str, Any]:
    """Content of `rates.h.jinja`.

    Raises
    ------
    FitError
        As `rate_polynomial_of`.
    """
    polynomial = rate_polynomial_of(calibration, gyro)
    fixed = FixedRates(polynomial)
    letters = [factor[1] for factor in polynomial.needs if factor.startswith("f")]
    inputs = [factor for factor in polynomial.needs if factor in _FIELDS]
    step, force = fixed.step, fixed.force_step
    return {
        "needs": polynomial.needs,
        "uses_scan": bool(polynomial.needs),
        "lsb": f"{GYRO_OFFSET_DPS:g}",
        "force_mask": sum(1 << AXES.index(letter) for letter in letters),
        "step": whole(step.number),
        "shift": step.shift - RATE_Q,
        "limit": f"{LIMIT}L",
        "most": f"{2 * LIMIT - 1}L",
        "fixed_forces": [
            {"name": f"f{x}", "letter": x, "step": whole(force.number), "shift": force.shift - Q}
            for x in letters
        ],
        "fixed_inputs": [_fixed_input(polynomial, c) for c in inputs],
        "fixed_axes": [_fixed_axis(fixed, k, name) for k in range(3)],
        "stepf": single(STEP_DPS),
        "limitf": single(LIMIT_DPS),
        "float_forces": [
            {"name": f"f{x}", "letter": x, "step": single(polynomial.step_g[0])} for x in letters
        ],
        "float_inputs": [_float_input(polynomial, c) for c in inputs],
        "float_axes": [_float_axis(polynomial, k) for k in range(3)],
        "fixed_udps": FIXED_UDPS,
        "float_udps": round(FLOAT_DPS * 1e6),
        "checks": _checks(fixed),
    }


def of_gyros(gyro: GyroCalibration) -> str:
    """Method and file of the gyros, which may be another than that of the accelerometers."""
    return f"method {gyro.method}, file {gyro.source or 'not stated'}"


def rate_rows(gyro: GyroCalibration) -> list[str]:
    """Lines of the header's table of coefficients."""
    return [
        comment(
            f"{one.name:20} {one.value:<18.9g} {one.unit.replace('dps', 'deg/s'):13} "
            f"{'not known' if one.u is None else f'{one.u:.2g}'}"
        )
        for one in gyro.parameters
    ]


def rate_remarks(gyro: GyroCalibration) -> list[str]:
    """Lines of what the header does not do for the gyros."""
    rows = [f"{name}: not determined, taken as nominal" for name in gyro.assumed]
    rows += [f"not corrected: {one.effect}: {one.reason}" for one in gyro.not_corrected]
    if gyro.offsets_lsb is not None:
        held = ", ".join(map(str, gyro.offsets_lsb))
        rows.append(f"rates hold with {held} in XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF: others need a new header")
    return [comment(row) for row in rows]


def _fixed_input(polynomial: RatePolynomial, condition: str) -> dict[str, Any]:
    fixed = FixedPoint.of(polynomial.accelerometers)
    zero, step = fixed.temperature if condition == "t" else fixed.supply
    return {
        "name": condition,
        "field": _FIELDS[condition],
        "zero": whole(zero),
        "step": whole(step.number),
        "shift": step.shift - Q,
    }


def _fixed_axis(fixed: FixedRates, k: int, name: str) -> dict[str, Any]:
    terms = []
    for term in fixed.polynomial.terms:
        if term.axis != k:
            continue
        first, *rest = term.factors
        product = f"(int64_t){first}"
        for factor in rest:
            product = f"{name}_shifted_({product} * {factor}, {Q})"
        own = fixed.coefficient(term)
        terms.append(shift_text(f"{product} * {whole(own.number)}", own.shift, name))
    row = [
        shift_text(f"(int64_t)free_{AXES[j]} * {whole(entry.number)}", entry.shift, name)
        for j, entry in enumerate(fixed.matrix[k])
        if entry.number
    ]
    warm = fixed.warm[k]
    return {
        "letter": AXES[k],
        "bias": whole(fixed.bias[k]),
        "terms": " + ".join(terms),
        "warm": whole(warm) if warm else "",
        "row": " + ".join(row),
    }


def _float_input(polynomial: RatePolynomial, condition: str) -> dict[str, Any]:
    of = polynomial.accelerometers
    own = of.temperature if condition == "t" else of.supply
    return {
        "name": condition,
        "field": _FIELDS[condition],
        "zero": single(own.zero),
        "step": single(own.step),
    }


def _float_axis(polynomial: RatePolynomial, k: int) -> dict[str, Any]:
    terms = [
        " * ".join([single(term.coefficient), *(factor_text(factor) for factor in term.factors)])
        for term in polynomial.terms
        if term.axis == k
    ]
    row = [
        f"{single(float(polynomial.matrix[k, j]))} * free_{AXES[j]}"
        for j in range(3)
        if polynomial.matrix[k, j] != 0.0
    ]
    warm = polynomial.warm[k]
    return {
        "letter": AXES[k],
        "bias": single(polynomial.bias[k]),
        "terms": " + ".join(terms),
        "warm": single(warm) if warm else "",
        "row": " + ".join(row),
    }


def _checks(fixed: FixedRates) -> list[dict[str, str]]:
    """Turns about every axis, both ways, at forces of 1 g and conditions off their zeros."""
    of, step_g = fixed.polynomial.accelerometers, fixed.polynomial.step_g[0]
    dps = np.array([[250.0, -31.0, 7.0], [-250.0, 90.0, -60.0], [3.0, -4.0, 270.0], [0.0, 0.0, 0.0]])
    g = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.6, -0.8], [0.5, 0.5, 0.7]])
    turns: Any = np.rint(dps / STEP_DPS).astype(np.int64)
    scans: Any = np.rint(g / step_g).astype(np.int64)
    rise = np.arange(CHECKS) - CHECKS // 2
    warm, volts = of.temperature.zero + 23 * PARTS * rise, of.supply.zero + 17 * PARTS * rise
    udps = fixed.rates_udps(turns, scans, warm, volts)
    return [
        {
            "turn": _listed(turns[k].tolist()),
            "scan": _listed([*scans[k].tolist(), int(warm[k]), int(volts[k])]),
            "udps": _listed(udps[k].tolist()),
        }
        for k in range(CHECKS)
    ]


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(whole(number) for number in numbers)
