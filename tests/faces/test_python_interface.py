"""The Python interface as somebody meets it in a shell or a notebook."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

import adis_gonio
from adis_gonio.base.errors import DataError, FitError, NotInstalledError, UsageError
from adis_gonio.record.samples_writer import write_samples_csv
from calibrate.sessions import planar_session


@pytest.fixture(scope="module")
def session():
    return planar_session(np.random.default_rng(3))


@pytest.fixture(scope="module")
def result(session):
    return adis_gonio.fit(session, method="ml")


def test_fit_takes_a_session_or_a_path_of_either_kind(session, tmp_path):
    path = tmp_path / "s.csv"
    write_samples_csv(session, path)
    ours = adis_gonio.fit(session).as_dict()["parameters"]
    assert adis_gonio.fit(path).as_dict()["parameters"] == ours
    assert adis_gonio.fit(str(path), method="ml").method == "ml"


@pytest.mark.parametrize("call", [adis_gonio.fit, adis_gonio.trace])
def test_what_is_neither_is_refused_with_a_typed_error(call, tmp_path):
    for wrong in (None, 7, [1, 2], np.zeros(3)):
        with pytest.raises(UsageError, match="takes a Session or the path of a file"):
            call(wrong)
    with pytest.raises(DataError, match="there is no such file"):
        call(tmp_path / "none.session")


def test_reprs_are_one_short_line_without_an_array(session, result):
    for thing in (session, session.dwells[0], result, result.calibration()):
        text = repr(thing)
        assert len(text) < 200
        assert "\n" not in text
        assert "array" not in text
    assert "delta_k" in repr(result)
    assert repr(session.dwells[0]) == "Dwell(0: 0°, 200 samples)"


def test_the_summary_of_a_fit_is_its_headline(result):
    assert result.summary().startswith("Answer by method ml")
    assert "ΔK" in result.summary()


def test_notebooks_get_a_table_that_is_well_formed_and_escaped(result):
    for thing in (result, result.calibration()):
        table = ET.fromstring(thing._repr_html_())
        assert table.tag == "table"
        assert len(table.findall("./tbody/tr")) == len(thing.parameters)


def test_data_frames_hold_the_same_numbers(session, result):
    pytest.importorskip("pandas")
    for frame in (result.to_pandas(), result.calibration().to_pandas()):
        for name in (name for name in result.parameters if name in frame.index):
            assert frame.loc[name, "value"] == result[name].value
            assert frame.loc[name, "u"] == result[name].u
        assert {"scale_x", "scale_y", "bias_x", "bias_y"} <= set(frame.index)
    samples = session.to_pandas()
    assert list(samples.columns) == ["time_s", "position", "angle_deg", "ax", "ay"]
    assert len(samples) == 12 * 200
    means = samples.groupby("position")["ax"].mean().to_numpy()
    assert np.allclose(means, [dwell.accel[:, 0].mean() for dwell in session.dwells])


def test_without_pandas_the_extra_is_named(session, result, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    for call in (result.to_pandas, session.to_pandas, result.calibration().to_pandas):
        with pytest.raises(NotInstalledError, match=r"pip install '\.\[pandas\]'"):
            call()


def test_a_trace_shows_itself_too():
    from adis_gonio.base.uncertainty import Value
    from adis_gonio.tracing.trace_result import ErrorFigures, Finding, TraceResult

    figures = ErrorFigures(1.0, 1.0, 0.1, 1.0)
    finding = Finding(
        "quadratic", ("x",), {"k2_x": Value(6.0, 0.1, "mg/g²")}, 0.0, 0.9, 1.0, cause="<curved>"
    )
    result = TraceResult(True, (finding,), (), figures, figures, advice=("go on",))
    assert repr(result) == "TraceResult(found quadratic; adequate)"
    assert "k2_x: 6.00 ± 0.20 mg/g²" in result.summary().replace("\u00a0", " ")
    ET.fromstring(result._repr_html_())


@pytest.mark.parametrize("call", [adis_gonio.fit, adis_gonio.trace])
def test_a_matrix_without_an_inverse_is_an_error_of_the_fit(call, session, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    for name in ("adis_gonio.fitting.determination.determine", "adis_gonio.tracing.trace.select"):
        monkeypatch.setattr(name, fail)
    with pytest.raises(FitError, match=r"session: no fit is possible .*Singular matrix.*check the times"):
        call(replace(session, source=""))


def test_so_is_one_that_comes_with_the_comparison_of_methods(result, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("adis_gonio.fitting.answer.compare_methods", fail)
    with pytest.raises(FitError, match="no fit is possible"):
        replace(result).as_dict()
