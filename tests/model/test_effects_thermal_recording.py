"""The thermal effects on a real recording: one pose through a thermal chamber."""

import gzip

import numpy as np
import pytest

from adis_gonio.model import STANDARD_GRAVITY_MPS2
from adis_gonio.model.effects import Conditions, effect
from recordings import recording


@pytest.mark.parametrize(
    ("axis", "tau_s", "cubic_mg", "lag_mg"), [("x", 158.0, 0.75, 0.48), ("y", 424.0, 2.2, 0.95)]
)
def test_lag_explains_held_out_blocks_that_a_cubic_in_temperature_does_not(axis, tau_s, cubic_mg, lag_mg):
    with gzip.open(recording("thermal_cycle"), "rt", encoding="utf-8") as file:
        lines = [line for line in file if not line.startswith("#")]
    column = dict(zip(lines[0].strip().split(","), np.loadtxt(lines[1:], delimiter=",").T, strict=True))
    measured = column[f"a{axis}"] * 1000 / STANDARD_GRAVITY_MPS2
    time, temperature = column["time_s"], column["temp_c"]
    conditions = Conditions(time, temperature_c=temperature, temperature_history=(time, temperature))

    def held_out_rms(*effects: tuple[str, dict[str, int], dict[str, float]]) -> float:
        columns = []
        for name, choices, shape in effects:
            one = effect(name, (axis,), **choices)
            every = one.derivative(one.defaults(shape), np.zeros((len(time), 3)), conditions)
            amplitudes = [k for k, p in enumerate(one.parameters) if not p.shape]
            columns.append(every[:, "xyz".index(axis), amplitudes])
        design = np.hstack(columns)
        left = np.empty(len(time))
        for block in np.array_split(np.arange(len(time)), 10):
            fit = np.setdiff1d(np.arange(len(time)), block)
            values = np.linalg.lstsq(design[fit], measured[fit], rcond=None)[0]
            left[block] = measured[block] - design[block] @ values
        return float(np.sqrt(np.mean(left**2)))

    cubic = (("bias", {}, {}), ("bias_temperature", {"degree": 3}, {}))
    assert held_out_rms(*cubic) > cubic_mg
    assert held_out_rms(*cubic, ("thermal_lag", {}, {"tau": tau_s})) < lag_mg
