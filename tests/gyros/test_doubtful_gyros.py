"""Files without gyros at rest in them are taken, and said to look like it; sound ones are not accused."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio import fit
from adis_gonio.calibration.gyro_building import estimates_of_gyro_fit
from adis_gonio.counting import runs
from adis_gonio.errors import DataError
from adis_gonio.model.records import Dwell, Session
from adis_gonio.report import words
from adis_gonio.showing import shown_unit, with_u
from adis_gonio.tracing.outcome.result import ErrorFigures, Step, TraceResult


def session(zero=(0.4, -1.1, 0.2), noise=0.6, rows=60, unit="dps"):
    rng = np.random.default_rng(5)
    dwells = []
    for k in range(4):
        accel = np.array([1000 * np.cos(k * np.pi / 2), -1000 * np.sin(k * np.pi / 2), 0.0])
        time = 100.0 * k + 0.01 * np.arange(rows)
        gyro = np.array(zero) + noise * rng.standard_normal((rows, 3))
        own = accel + 2 * rng.standard_normal((rows, 3))
        dwells.append(Dwell(k, time, own, 90.0 * k, gyro=gyro))
    return Session(tuple(dwells), sensor="adis16354", accel_unit="mg", gyro_unit=unit)


@pytest.mark.parametrize(
    ("own", "told"),
    [
        (session(zero=(0.4, -1.1, 400.0)), ["gyro_bias_z is 400"]),
        (session(unit="radps"), ["gyro_bias_x is", "gyro_bias_y is -6", "gyro_bias_z is"]),
        (session(zero=(0.0, 0.0, 0.0), noise=0.0), [f"gyro {a} reads 0 in every sample" for a in "xyz"]),
    ],
)
def test_what_no_gyro_at_rest_reads_is_said_and_nothing_is_written_by_it(own, told):
    result = fit(own, part="gyro")
    assert len(result.doubts) == len(told)
    for line, piece in zip(result.doubts, told, strict=True):
        assert piece in line
    assert set(result.doubts) <= set(result.warnings)
    assert set(result.doubts) <= set(estimates_of_gyro_fit(result).doubts)


def test_sound_gyros_are_not_accused():
    assert fit(session(), part="gyro").doubts == ()
    assert (
        fit(session(zero=np.radians([0.4, -1.1, 0.2]), noise=0.01, unit="radps"), part="gyro").doubts == ()
    )


def test_one_sample_a_dwell_is_refused_for_what_it_is():
    with pytest.raises(DataError, match="one sample of the gyros each"):
        fit(session(rows=1), part="gyro")


def test_numbers_in_a_row_are_told_as_such():
    assert runs([1, 2, 3, 4, 7, 9, 10]) == "1–4, 7, 9, 10"
    assert runs([3]) == "3"
    assert runs([]) == ""


def test_people_read_degrees_a_second_and_documents_dps():
    assert shown_unit("dps/g") == "°/s/g"
    assert with_u(1.25, 0.02, "dps") == "1.250 °/s (u 0.020 °/s)"
    result = fit(session(), part="gyro")
    assert "°/s" in repr(result)
    assert "dps" not in repr(result)
    assert not [line for line in result.warnings if "dps" in line]
    assert result.as_dict()["parameters"]["gyro_bias_x"]["unit"] == "dps"


def test_a_trace_of_the_gyros_is_told_in_degrees_a_second():
    axes = {"x": 0.11, "y": 0.07, "z": 0.12}
    before = ErrorFigures(0.122, 0.0968, None, 12.6, axes, unit="dps")
    after = ErrorFigures(0.025, 0.0526, None, 0.93, axes, 0.05, unit="dps")
    traced = TraceResult(True, (), (Step("gyro_scale", after),), (), None, before, after, {}, ())
    head, _ = words.error_rows(traced)
    told = " ".join([words.gains(traced), *head])
    assert "from 0.122 to 0.0250 °/s" in told
    assert "x / (°/s)" in head
    assert "dps" not in told
    assert after.as_dict()["residual_rms_dps"] == 0.025
