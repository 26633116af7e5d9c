"""What the paper leaves open: the reading chosen, why, and what another reading would give.

Numbers are computed from noise-free readings of the planar model with the table's gains and Δφ, except
where the question is about noise, or about a cause that the simulated world has.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.fitting.closed_form import FOUR, as_printed
from adis_gonio.handover.paper.comparison import printed_verdicts
from adis_gonio.handover.paper.crossing import MMPM_ANGLES_DEG, by_positions, readings
from adis_gonio.handover.paper.sessions import Part, Results
from adis_gonio.handover.paper.truth import TABLE, row_of, truth_of

ALPHA_DEG = 5.0
"""Start angle of the examples: the largest that the simulated stage draws."""
K2_MG = 3.0
"""Quadratic term of X in mg/g² for the question of the static load."""
_NOISE_G = 1e-4
_DRAWS = 20_000


@dataclass(frozen=True)
class LabelledValue:
    """A number with its words: `as read`, or `with the other reading`."""

    name: str
    value: float | None
    unit: str


@dataclass(frozen=True)
class Ambiguity(JsonRecord):
    """An open question of the paper.

    Attributes
    ----------
    what : str
        The question in a few words.
    reading, why : str
        The reading chosen, and the reason.
    values : tuple of LabelledValue
        By the reading chosen and by others.
    """

    what: str
    reading: str
    why: str
    values: tuple[LabelledValue, ...] = ()


def two_readings(alpha_deg: float, *, turn: int = 1) -> Floats:
    """U_x1, U_y1, U_x2, U_y2 without noise and bias; `turn` −1: the stage turned the other way."""
    at = readings(
        truth_of("x"), [0.0, 90.0 * turn], np.radians([alpha_deg]), np.zeros((1, 2)), np.zeros((1, 2, 2))
    )
    return np.asarray(at[0].ravel())


def load_parts(seed: int) -> tuple[Part, Part]:
    """The same part without and with a gain that depends on the load, same noise in both."""
    part = Part(seed, truth_of("x"))
    return part, replace(part, effects=f"quadratic:k2_x={K2_MG:g}")


def ambiguities(rng: np.random.Generator, load: Sequence[Results]) -> tuple[Ambiguity, ...]:
    """All of them.

    Parameters
    ----------
    rng : Generator
        Draws the noise at 45°.
    load : sequence of two Results
        Of `load_parts`.
    """
    return (
        _other_axis(),
        _sense(),
        _equation_10(),
        _pole(rng),
        _units(),
        _sign_of_n(),
        _two_angles(),
        _static_load(load),
        Ambiguity(
            "The part's name",
            "ADIS16354",
            "The paper writes ADIS16534 in places; no part is called so.",
        ),
    )


def _other_axis() -> Ambiguity:
    x1, y1, x2, y2 = two_readings(ALPHA_DEG)
    return Ambiguity(
        "U_x′ in equation 5, ΔK = U_x/U_x′ − 1",
        "What the other axis reads in the place where X was: −U_y2.",
        "Only so does the quotient compare two gains. The other candidates depend on the start angle"
        " first.",
        (
            LabelledValue("ΔK, true", truth_of("x").delta_k, "1"),
            LabelledValue("ΔK with U_x′ = −U_y2", x1 / -y2 - 1, "1"),
            LabelledValue("ΔK with U_x′ = U_x2 (X itself after the turn)", x1 / x2 - 1, "1"),
            LabelledValue("ΔK with U_x′ = U_y1 (Y before the turn)", x1 / y1 - 1, "1"),
        ),
    )


def _sense() -> Ambiguity:
    right, wrong = two_readings(ALPHA_DEG), two_readings(ALPHA_DEG, turn=-1)
    with np.errstate(invalid="ignore"):
        values = [as_printed(*reading) for reading in (right, wrong)]
    return Ambiguity(
        "The sign of the turn",
        "Equation 6 fixes it: at 90° X reads K_x G sin α and Y reads −K_y G cos(Δφ + α).",
        "The figure does not show it. Turned the other way both readings change their sign, and equation 5"
        " compares a gain with its negative.",
        (
            LabelledValue("ΔK with this sense", float(values[0][0]), "1"),
            LabelledValue("ΔK of a stage that turns the other way", float(values[1][0]), "1"),
            LabelledValue("Δφ with this sense", math.degrees(values[0][1]), "deg"),
            LabelledValue("Δφ of a stage that turns the other way", math.degrees(values[1][1]), "deg"),
        ),
    )


def _equation_10() -> Ambiguity:
    x1, y1, x2, y2 = two_readings(ALPHA_DEG)
    gain = x1 / -y2
    a, b = gain * y1 / x1, gain * y2 / x2
    alpha = math.radians(ALPHA_DEG)
    literal = (1 + alpha * b) / (alpha + b)
    return Ambiguity(
        "Equation 10 as printed mixes α and a, and has an equals sign too many",
        "sin Δφ = (1 + ab)/(a + b), a = U_y1/U_x1, b = U_y2/U_x2.",
        "Equations 11 and 12 follow from this form and from no other.",
        (
            LabelledValue("Δφ, true", truth_of("x").delta_phi_deg, "deg"),
            LabelledValue("Δφ with a", math.degrees(math.asin((1 + a * b) / (a + b))), "deg"),
            LabelledValue(
                "Δφ with α (in radians) in the place of a", math.degrees(math.asin(literal)), "deg"
            ),
        ),
    )


def _pole(rng: np.random.Generator) -> Ambiguity:
    values = []
    noise = _NOISE_G * rng.standard_normal((_DRAWS, 2, 2))
    for alpha in (5.0, 30.0, 44.0, 45.0):
        at = readings(
            truth_of("x"), FOUR[:2], np.full(_DRAWS, math.radians(alpha)), np.zeros((_DRAWS, 2)), noise
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            phi = as_printed(at[:, 0, 0], at[:, 0, 1], at[:, 1, 0], at[:, 1, 1])[1]
        finite = np.degrees(phi[np.isfinite(phi)])
        # Half the width of the middle 68 %: at the pole there is no variance.
        low, high = np.quantile(finite, (0.1587, 0.8413))
        values.append(LabelledValue(f"spread of Δφ at α = {alpha:g}°", float(high - low) / 2, "deg"))
    exact = np.degrees(by_positions(FOUR[:2], at, bias=False)[:, 3])
    values.append(LabelledValue("the same at 45° by two-position", float(exact.std()), "deg"))
    return Ambiguity(
        "The singularity at 45°",
        "The method is applied as printed, and refused where a + b of equation 12 nearly vanishes.",
        "The paper does not mention it. The closed form of the same four readings has no such place. Here a"
        f" reading has a noise of {_NOISE_G:g} G; the spread is half the width of the middle 68 %.",
        tuple(values),
    )


def _units() -> Ambiguity:
    two_sigma = math.degrees(math.sqrt(2) * 0.16e-3)
    return Ambiguity(
        "The table's units: Δφ in “g/deg/s”, SF and N without",
        "Δφ is the offset of zeros of equation 2 in g, N the angle of equation 3 in degrees, SF the"
        " relative error K − 1.",
        "The paper uses Δφ twice. As an angle in degrees the table's −0.003 would be far below what two"
        " readings can show; N in radians would be beyond any part. Whether “after” is what a method gives"
        " or what it leaves is not said either: as what is left, each would leave more than half of SF.",
        (
            LabelledValue(
                "standard deviation of Δφ from two readings with a noise of 0.16 mg", two_sigma, "deg"
            ),
            LabelledValue("the table's Δφ of X, were it an angle", row_of("offset", "x").measured, "deg"),
            LabelledValue(
                "the table's N of X, were it in radians",
                math.degrees(row_of("non_orthogonality", "x").measured),
                "deg",
            ),
        ),
    )


def _sign_of_n() -> Ambiguity:
    angles = [-a for a in MMPM_ANGLES_DEG]
    at = readings(truth_of("x"), angles, np.radians([ALPHA_DEG]), np.zeros((1, 9)), np.zeros((1, 9, 2)))
    phi = float(np.degrees(by_positions(MMPM_ANGLES_DEG, at, bias=True)[0, 3]))
    folded = (phi + 90.0) % 180.0 - 90.0
    verdicts = printed_verdicts()
    signed = sum(v["nearer"] == "paper" for v in verdicts.values())
    sizes = sum(v["nearer_without_sign"] == "paper" for v in verdicts.values())
    return Ambiguity(
        "The jump of sign of N: measured and the paper's positive, MMPM's negative",
        "The table's numbers are shown as printed; a sense of turn that differs between the two is the"
        " likely cause.",
        "MMPM finds −Δφ (beside a gain of Y of the other sign) where the stage turned against what was"
        " declared, and the printed sizes are alike. On the sign alone rests that the paper's method is"
        " nearer to the measured column anywhere in its table.",
        (
            LabelledValue(
                "N by MMPM of X's truth, turned as declared",
                row_of("non_orthogonality", "x").measured,
                "deg",
            ),
            LabelledValue("N by MMPM, turned the other way (modulo 180°)", folded, "deg"),
            LabelledValue("N by MMPM as printed", row_of("non_orthogonality", "x").mmpm, "deg"),
            LabelledValue(f"of {len(TABLE)} rows as printed, the paper's method is nearer in", signed, ""),
            LabelledValue("of as many without signs", sizes, ""),
        ),
    )


def _two_angles() -> Ambiguity:
    x, y = (row_of("non_orthogonality", axis).measured for axis in ("x", "y"))
    return Ambiguity(
        "Two values of N, one angle between X and Y",
        "Two determinations of the same angle: sessions of column X have Δφ = 0.0612°, of column Y"
        " 0.0673°.",
        "A turn in one plane cannot tell how each axis leans, only how far their angle is from 90°; in each"
        " column of the table but the first the two values are the same within 0.002°.",
        (
            LabelledValue("Δφ, column X", x, "deg"),
            LabelledValue("Δφ, column Y", y, "deg"),
            LabelledValue("Δφ if each were the lean of its axis towards the other", x + y, "deg"),
        ),
    )


def _static_load(load: Sequence[Results]) -> Ambiguity:
    values = []
    for method, key, name, unit in (
        ("paper", "delta_k", "ΔK", "1"),
        ("paper", "non_orthogonality", "Δφ", "deg"),
        ("mmpm", "delta_k", "ΔK", "1"),
        ("mmpm", "offset_x", "offset of X", "g"),
    ):
        before, after = (one.found[method].values[key] for one in load)
        moved = None if before is None or after is None else after - before
        values.append(LabelledValue(f"{name} by {method} moves by", moved, unit))
    return Ambiguity(
        "A “static load” that moves gain and zero",
        "Gravity along the axis is the load: a quadratic term of the response, part of which is read as"
        " gain and part as zero.",
        "Nothing else in a goniometer loads the part. A load on the stage would bend it and turn the part,"
        " which is an error of the angle and no property of the sensor. Here X has"
        f" {K2_MG:g} mg/g², the session with and without it, through chip and driver.",
        tuple(values),
    )
