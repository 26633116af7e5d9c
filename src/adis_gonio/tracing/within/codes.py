"""What the codes of the samples show: limits of the range (`saturation`), a coarse step (`quantization`).

Saturation
    Samples that pile up at an extreme value (`Readings.converter`). Its p-value is that of so many
    samples at the extreme against those one value inside, were both equally likely.
Quantization
    A step that the noise does not hide: what it leaves on the means, q²/(2π²)·Σ exp(−4π²k²σ²/q²)/k², is
    more than what noise leaves on them, in all dwells together. Its p-value is the chance that noise of the
    scatter at which both are equal scatters no more than was seen. Words of which only every second, third,
    … one occurs have lost bits: that is stated of any scatter, and its p-value is the chance of so many
    differences without another divisor.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize, stats

from adis_gonio.base.numbers import format_number
from adis_gonio.base.uncertainty import FOUND_WITHIN, Value
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.readings import Readings, left_by_quantization
from adis_gonio.model.records import Session
from adis_gonio.tracing.within.finding import WithinFinding, corrected, positions_text
from adis_gonio.tracing.within.samples import Samples


def saturation(session: Session, data: Readings) -> WithinFinding | None:
    """Limits of the range that samples have reached; None where there are none."""
    if data.converter is None or not data.converter.limits:
        return None
    limits = data.converter.limits
    recorded = sum(1 for dwell in session.dwells if len(dwell))
    zero = np.zeros((1, data.axes))
    sizes, steps = [], []
    for limit in limits:
        at = zero.copy()
        at[0, limit.axis] = limit.value
        sizes.append(abs(float(data.unit.mg(at)[0, limit.axis])))
        steps.append(
            float(data.unit.mg(at)[0, limit.axis] - data.unit.mg(zero)[0, limit.axis]) / limit.value
        )
    letters = tuple(sorted({"xyz"[limit.axis] for limit in limits}))
    positions = tuple(sorted({p for limit in limits for p in limit.positions}))
    p = max(float(stats.binom.sf(m.samples - 1, m.samples + m.inside, 0.5)) for m in limits)
    spread = (max(sizes) - min(sizes)) / 2
    step = float(data.converter.steps.max()) * abs(steps[0])
    limit_mg = Value(float(np.mean(sizes)), math.hypot(step / math.sqrt(12), spread), "mg")
    return WithinFinding(
        kind="limit",
        effect="saturation",
        axes=letters,
        positions=positions,
        parameters={"limit": limit_mg},
        p_value=corrected(p, len(limits)),
        sentence=(
            f"{', '.join(letters)} stop at ±{format_number(limit_mg.value)} mg in "
            f"{positions_text(positions, recorded)}: dwells that it moves took no part in the fit"
        ),
        advice="record with a wider range, or without the positions in which an axis stands at its limit",
    )


def quantization(session: Session, samples: Samples, reach: int) -> WithinFinding | None:
    """A step of the converter that noise does not hide; None where it does.

    Parameters
    ----------
    reach : int
        Samples over which neighbours are correlated.
    """
    found: dict[int, float] = {}
    for axis in range(samples.axes):
        p = corrected(min(_coarse(samples, axis, reach), _lost_bits(session, samples, axis)), samples.axes)
        if p < FOUND_WITHIN:
            found[axis] = p
    if not found:
        return None
    letters = tuple(samples.letters[axis] for axis in found)
    step = max(float(samples.quantum[axis]) for axis in found)
    return WithinFinding(
        kind="coarse",
        effect="quantization",
        axes=letters,
        positions=tuple(int(p) for p in samples.position),
        parameters={"lsb": Value(step, None, "mg")},
        p_value=min(found.values()),
        sentence=(
            f"{', '.join(letters)} come in steps of {format_number(step)} mg, which the noise does not"
            " hide: the means follow a staircase"
        ),
        advice=(
            "give the converter more noise or finer words (a shorter filter, a format with all digits), or "
            "measure each angle a few times, a fraction of a step apart"
        ),
    )


def _coarse(samples: Samples, axis: int, reach: int) -> float:
    """Chance that noise which hides the step scatters as little as the samples; 1 where it hides it."""
    step = float(samples.quantum[axis])
    if not step > 0:
        return 1.0
    rows = [values[:, axis : axis + 1] for values in samples.values]
    variance = np.array([float(values.var()) for values in rows])
    worth = np.maximum(samples.counts / reach, 1.0)
    on_means = float(np.mean(np.maximum(variance - step**2 / 12, 0.0) / worth))
    if float(np.mean(left_by_quantization(rows, np.ones(1), np.array([step])))) <= on_means:
        return 1.0
    k = np.arange(1, 50)

    def excess(sigma: float) -> float:
        left = float((np.exp(-4 * np.pi**2 * k**2 * sigma**2) / k**2).sum()) / (2 * np.pi**2)
        return left - sigma**2 / float(np.mean(worth))

    hiding = float(optimize.brentq(excess, 1e-3, 2.0))
    dof = float(np.sum(np.maximum(worth - 1, 1.0)))
    return float(stats.chi2.cdf(dof * float(np.mean(variance)) / (step**2 * (hiding**2 + 1 / 12)), dof))


def _lost_bits(session: Session, samples: Samples, axis: int) -> float:
    """Chance that all differences of words share their divisor; 1 where it is one, or the words unknown."""
    if session.accel_unit != "lsb" or session.sensor not in VARIANTS:
        return 1.0
    words = round(float(samples.quantum[axis]) / VARIANTS[session.sensor].accel_mg_per_lsb)
    if words < 2:
        return 1.0
    differences = sum(len(np.unique(values[:, axis])) - 1 for values in samples.values)
    return float(words) ** -differences
