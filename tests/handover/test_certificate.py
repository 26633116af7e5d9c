"""The certificate has the structure that PTB publishes, values in SI units, and nothing invented."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from scipy.stats import t as student

from adis_gonio import Calibration, fit, load_session, trace
from adis_gonio.base.conformity import Tolerance
from adis_gonio.base.errors import FitError
from adis_gonio.calibrate import NotCorrected
from adis_gonio.handover.c_header import c_header
from adis_gonio.handover.certificate import SI_UNITS, certificate_text
from adis_gonio.handover.register_offsets import registers_text
from adis_gonio.model.effects import BUILT_IN, effect
from handover.calibrations import CURVED, EVERY, PLANE, SPACE, calibration, of_counts
from handover.dcc_structure import DCC, SI, judge

KINDS = {
    "plain": lambda: calibration(PLANE),
    "every effect": lambda: calibration(PLANE, EVERY),
    "space": lambda: calibration(SPACE),
    "counts": of_counts,
    "no noise": lambda: replace(calibration(PLANE), covariance=None),
    "remarks": lambda: replace(
        calibration(PLANE, title="T", serial="S 7", operator="M. Muster", stage="table 2"),
        assumed=("bias_x",),
        not_corrected=(NotCorrected("backlash", "belongs to the stage"),),
    ),
    "hostile": lambda: calibration(PLANE, title="<a> & \x00 \ud800 ]]>", serial="  ", operator="\n\t"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_element_is_as_documented(kind):
    judge(certificate_text(KINDS[kind](), date(2026, 5, 4)))


def quantities(root):
    found = {}
    for quantity in root.iter(f"{DCC}quantity"):
        name = quantity.find(f"{DCC}name/{DCC}content").text
        real = quantity.find(f"{SI}real")
        if real is not None:
            found[re.sub(r".*\((\w+)\)", r"\1", name)] = {
                one.tag[len(SI) :]: one.text for one in real.iter()
            }
    return found


def test_values_are_in_si_units_with_expanded_uncertainties():
    own = calibration(PLANE, CURVED)
    found = quantities(judge(certificate_text(own)))
    g = 9.80665
    expected = {
        "scale_x": (1.012, 1e-4, r"\one"),
        "delta_phi": (0.41, 1e-4, r"\degree"),
        "bias_x": (12.3e-3 * g, 1e-7 * g, r"\metre\second\tothe{-2}"),
        "k2_x": (6.1e-3 * g / g**2, 1e-7 / g, r"\metre\tothe{-1}\second\tothe{2}"),
        "tempco_x": (0.31e-3 * g, 1e-7 * g, r"\metre\second\tothe{-2}\kelvin\tothe{-1}"),
    }
    for name, (value, u, unit) in expected.items():
        real = found[name]
        assert float(real["value"]) == pytest.approx(value, rel=1e-12)
        assert real["unit"] == unit
        assert float(real["uncertainty"]) == pytest.approx(1.95996 * u, rel=1e-5)
        assert float(real["coverageProbability"]) == 0.95
    ratio = float(found["delta_k"]["value"])
    assert ratio == pytest.approx(1.012 / 0.991 - 1, rel=1e-12)


def test_few_degrees_of_freedom_widen_the_interval_by_student_s_quantile():
    own = calibration(PLANE)
    few = replace(own, parameters=tuple(replace(one, dof=4.0) for one in own.parameters))
    real = quantities(judge(certificate_text(few)))["scale_x"]
    assert real["coverageFactor"] == "2.7764"  # Student's table, 4 degrees of freedom, 95 %
    assert float(real["uncertainty"]) == pytest.approx(2.7764e-4, rel=1e-4)
    assert real["distribution"] == "t"


def test_numbers_and_dates_are_those_of_a_fit_with_few_readings_over_midnight(tmp_path):
    lines = [
        "# sensor: generic",
        "# accel_unit: mg",
        "# fixture_sigma_deg: 0.02",
        "time_s,position,angle_deg,ax,ay",
    ]
    noise = np.random.default_rng(3).normal(0, 0.3, (8, 2))
    for k, (x, y) in enumerate(noise):
        psi = np.radians(2.0 - 45 * k)
        reading = f"{1004 * np.cos(psi) + 7 + x:.4f},{998 * np.sin(psi) - 4 + y:.4f}"
        clock = "2024-05-31 23:59" if k < 4 else "2024-06-01 00:00"
        lines.append(f"{clock}:0{k}Z,{k},{45 * k},{reading}")
    path = tmp_path / "few.csv"
    path.write_text("\n".join(lines) + "\n")
    traced = trace(load_session(path))
    found = quantities(judge(certificate_text(traced.calibration())))
    assert traced.base["delta_k"].k > 2.05
    for name, value in traced.base.items():
        assert float(found[name]["coverageFactor"]) == pytest.approx(value.k, abs=1e-4), name
    result = fit(load_session(path))
    made = result.calibration()
    made.save(tmp_path / "few.json")
    for own in (made, Calibration.load(tmp_path / "few.json")):
        root = judge(certificate_text(own))
        assert root.find(f".//{DCC}beginPerformanceDate").text == "2024-05-31"
        assert root.find(f".//{DCC}endPerformanceDate").text == "2024-06-01"
        found = quantities(root)
        for name, value in result.parameters.items():
            factor = 9.80665e-3 if value.unit == "mg" else 1
            assert value.k > 2.05, name  # Student's quantile: few degrees of freedom
            assert float(found[name]["uncertainty"]) == pytest.approx(factor * value.U, rel=1e-6), name
            assert float(found[name]["coverageFactor"]) == pytest.approx(value.k, abs=1e-4), name
        # One U of the angle: `fit` and the certificate state conformity with the same quantile.
        quantile = student.ppf(0.975, result.shown_angle.dof)
        assert float(root.find(f".//{SI}coverageFactorXMLList").text) == pytest.approx(quantile, abs=1e-4)
        assert root.find(f".//{SI}distributionXMLList").text == "t"
        for ours, theirs in zip(result.error_curves(), own.error_curves(), strict=True):
            assert theirs.U_deg == pytest.approx(ours.U_deg, rel=1e-9)
    # A file that does not state the degrees of freedom of the angle has at least those of one parameter.
    most = max(value.k for value in result.parameters.values())
    curve = replace(made, angle_dof=None).error_curves()[1]
    assert curve.U_deg == pytest.approx(most * curve.u_deg, rel=1e-6)


def test_the_values_are_stated_with_their_temperature():
    plain, heated = calibration(PLANE), calibration(PLANE, {"bias_temperature": (0.31, 0.4)})
    assert "acceleration, at 25 °C." in certificate_text(heated)
    assert "acceleration, at the session's mean conditions." in certificate_text(plain)
    assert "hold at 25 °C.\n" in registers_text(heated)
    assert "hold at the session's mean conditions" in registers_text(plain)
    assert "gravity: the values hold at 25 degC\n" in c_header(heated)
    # The supply's effect alone leaves the values at the temperature of the session.
    assert calibration(PLANE, {"supply_bias": (0.3, 0.4)}).holds_at == "5 V"
    both = calibration(PLANE, {"bias_temperature": (0.31, 0.4), "supply_bias": (0.3, 0.4)})
    assert both.holds_at == "25 °C and 5 V"


@pytest.mark.parametrize(
    ("own", "model"),
    [
        (calibration(PLANE), "gains, misalignment and biases in the plane"),
        (calibration(SPACE), "gains, skews and biases"),
        (
            calibration(PLANE, {"bias_temperature": (0.31, 0.4), "supply_bias": (0.3, 0.4)}),
            "gains, misalignment and biases in the plane; effects: bias_temperature, supply_bias",
        ),
    ],
)
def test_the_method_names_its_model_and_its_effects(own, model):
    root = judge(certificate_text(own))
    assert root.find(f".//{DCC}usedMethod/{DCC}description/{DCC}content").text == model


def test_what_nobody_stated_is_not_invented():
    text = certificate_text(calibration(PLANE), date(2026, 5, 4))
    root = judge(text)
    assert root.find(f".//{DCC}customer/{DCC}name/{DCC}content").text == "not stated"
    assert root.find(f".//{DCC}respPerson/{DCC}person/{DCC}name/{DCC}content").text == "not stated"
    assert root.find(f".//{DCC}countryCodeISO3166_1").text == "ZZ"
    assert root.find(f".//{DCC}beginPerformanceDate").text == "2026-05-04"
    assert "The date of recording is not stated" in text
    assert "not signed" in text


def test_what_the_session_states_is_in_its_place():
    own = calibration(
        PLANE, operator="M. Muster", serial="S 7", stage="table 2", recorded_utc="2026-03-01T10:00:00Z"
    )
    root = judge(certificate_text(own))
    assert root.find(f".//{DCC}respPerson/{DCC}person/{DCC}name/{DCC}content").text == "M. Muster"
    assert root.find(f".//{DCC}identification/{DCC}value").text == "S 7"
    assert root.find(f".//{DCC}measuringEquipment/{DCC}name/{DCC}content").text == "table 2"
    assert root.find(f".//{DCC}endPerformanceDate").text == "2026-03-01"


def test_without_noise_there_is_no_uncertainty():
    text = certificate_text(replace(calibration(PLANE), covariance=None, parameters=tuple(
        replace(one, u=None) for one in calibration(PLANE).parameters
    )))  # fmt: skip
    assert "expandedUnc" not in text
    assert "no uncertainty is stated" in text


def test_every_unit_of_the_catalogue_has_one_of_si_or_is_refused():
    from adis_gonio.model.effects import catalogue

    correctable = [name for name, kind in catalogue("accelerometer").items() if kind.correctable]

    units = {p.unit for name in correctable for p in effect(name, **_most(name)).parameters}
    assert units <= set(SI_UNITS)
    own = calibration(PLANE)
    odd = replace(own, parameters=(*own.parameters[:-1], replace(own.parameters[-1], unit="furlong")))
    with pytest.raises(FitError, match="furlong"):
        certificate_text(odd)


def test_the_factor_of_every_unit_follows_from_its_name():
    g = 9.80665
    parts = {"mg": g / 1000, "g": g, "g²": g**2, "g³": g**3, "ppm": 1e-6}
    for name, (_, factor) in SI_UNITS.items():
        above, _, below = name.partition("/")
        assert factor == pytest.approx(parts.get(above, 1) / parts.get(below, 1), rel=1e-12), name


def test_every_unit_is_read_by_the_reader_of_ptb():
    """dsiUnits parses the notation of D-SI; it gives the base units that the name of a unit means."""
    dsi_unit = pytest.importorskip("dsi_unit", reason="dsiunits is not installed (pip install '.[test]')")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of its own notation
        read = {name: dsi_unit.DsiUnit(unit) for name, (unit, _) in SI_UNITS.items()}
    assert [name for name, unit in read.items() if not unit.valid] == []
    meant = {"mg": "ms⁻²", "mg/g²": "m⁻¹s²", "mg/°C": "ms⁻²K⁻¹", "ppm/V": "V⁻¹", "dps": "°s⁻¹", "deg": "°"}
    assert {name: read[name].to_utf8() for name in meant} == meant


def test_the_laboratory_and_the_customer_are_in_their_places():
    own = calibration(PLANE, laboratory="Angle Lab", customer="A. Customer")
    root = judge(certificate_text(own))
    assert (
        root.find(f".//{DCC}calibrationLaboratory//{DCC}contact/{DCC}name/{DCC}content").text == "Angle Lab"
    )
    assert root.find(f".//{DCC}customer/{DCC}name/{DCC}content").text == "A. Customer"
    assert "laboratory" not in certificate_text(own).partition("Made by a program")[2].partition("</")[0]


@pytest.mark.parametrize(("limit_deg", "verdicts"), [(0.1, ["pass", "fail"]), (2.5e-4, ["noPass", "fail"])])
def test_conformity_is_stated_for_machines(limit_deg, verdicts):
    text = certificate_text(calibration(PLANE), tolerance=Tolerance(limit_deg))
    statements = judge(text).findall(f".//{DCC}statement")
    found = [s for s in statements if s.find(f"{DCC}conformity") is not None]
    assert [s.find(f"{DCC}conformity").text for s in found] == verdicts
    assert "With calibration" in found[0].find(f"{DCC}declaration/{DCC}content").text
    assert f"±{limit_deg:g}°" in text


def test_no_conformity_is_stated_with_a_bias_that_nobody_determined():
    blind = replace(calibration(PLANE), assumed=("bias_x", "bias_y"))
    with pytest.raises(FitError, match="bias_x, bias_y not determined"):
        certificate_text(blind, tolerance=Tolerance(0.1))


def _most(name):
    return {"degree": 3} if "degree" in BUILT_IN[name].choices() else {}
