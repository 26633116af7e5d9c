"""The certificate of a stage corrects declared angles; its covariance is in the uncertainty of a fit."""

from __future__ import annotations

import json

import numpy as np
import pytest

from adis_gonio import fit
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.faces.cli import main
from adis_gonio.handover.certificate import certificate_text, read_stage_curve
from adis_gonio.model.records import Dwell, Session, StageCurve
from adis_gonio.record.loading import Overrides, load_session
from adis_gonio.record.samples_writer import write_samples_csv
from handover.calibrations import PLANE, calibration

ANGLE = np.arange(0.0, 360.0, 15.0)
EXPANDED = [0.01] * len(ANGLE)


def shapes(angle_deg):
    """One and two cycles a turn, the second of which looks like ΔK and Δφ."""
    theta = np.radians(angle_deg)
    return np.column_stack([np.cos(theta), np.sin(theta), np.cos(2 * theta), np.sin(2 * theta)])


COVARIANCE = 0.01**2 * shapes(ANGLE) @ shapes(ANGLE).T


def certificate(path, error_deg, uncertainty, *, unit=r"\degree", angle=ANGLE):
    """A certificate as a laboratory issues it, reduced to its results."""

    def listed(values, more=""):
        return (
            f"<si:realListXMLList><si:valueXMLList>{' '.join(map(repr, np.asarray(values).tolist()))}"
            f"</si:valueXMLList><si:unitXMLList>{unit}</si:unitXMLList>{more}</si:realListXMLList>"
        )

    path.write_text(
        '<dcc:digitalCalibrationCertificate xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si">'
        "<dcc:measurementResults><dcc:measurementResult><dcc:results><dcc:result><dcc:data><dcc:list>"
        f'<dcc:quantity refType="basic_nominalValue">{listed(angle)}</dcc:quantity>'
        f'<dcc:quantity refType="basic_measurementError">{listed(error_deg, uncertainty)}</dcc:quantity>'
        "</dcc:list></dcc:data></dcc:result></dcc:results></dcc:measurementResult></dcc:measurementResults>"
        "</dcc:digitalCalibrationCertificate>",
        encoding="utf-8",
    )
    return path


def of_covariance(matrix):
    columns = "".join(
        "<si:column>"
        + "".join(
            f"<si:covariance><si:value>{v!r}</si:value><si:unit>\\degree\\tothe{{2}}</si:unit></si:covariance>"
            for v in column
        )
        + "</si:column>"
        for column in matrix.tolist()
    )
    return (
        f"<si:ellipsoidalRegionXMLList><si:covarianceMatrix>{columns}</si:covarianceMatrix>"
        "<si:coverageFactor>2.0</si:coverageFactor><si:coverageProbability>0.95</si:coverageProbability>"
        "</si:ellipsoidalRegionXMLList>"
    )


def of_u(expanded, factor):
    listed = " ".join(map(repr, expanded))
    return (
        f"<si:expandedUncXMLList><si:uncertaintyXMLList>{listed}</si:uncertaintyXMLList>"
        f"<si:coverageFactorXMLList>{factor}</si:coverageFactorXMLList></si:expandedUncXMLList>"
    )


def test_the_error_curve_is_read_with_its_covariance(tmp_path):
    error = 0.05 * np.sin(2 * np.radians(ANGLE))
    found = read_stage_curve(certificate(tmp_path / "stage.xml", error, of_covariance(COVARIANCE)))
    assert found.error_deg == pytest.approx(error)
    assert found.covariance_deg2 == pytest.approx(COVARIANCE)
    # Between two angles of the certificate a straight line; a full turn on, the same.
    there, changes = found.at(np.array([7.5, 352.5, 367.5]))
    assert there == pytest.approx([(error[0] + error[1]) / 2, (error[-1] + error[0]) / 2, there[0]])
    halfway = (COVARIANCE[0, 0] + COVARIANCE[1, 1] + 2 * COVARIANCE[0, 1]) / 4
    assert (changes[0] ** 2).sum() == pytest.approx(halfway)


def test_without_a_covariance_the_errors_are_independent_and_units_are_converted(tmp_path):
    turn = certificate(
        tmp_path / "s.xml", [3.0, 6.0, -3.0, 0.0], of_u([2.0] * 4, "2.0"),
        unit=r"\arcsecond", angle=np.array([0.0, 90.0, 180.0, 270.0]) * 3600,
    )  # fmt: skip
    found = read_stage_curve(turn)
    assert found.angle_deg == pytest.approx([0, 90, 180, 270])
    assert found.error_deg == pytest.approx(np.array([3, 6, -3, 0]) / 3600)
    assert found.covariance_deg2 == pytest.approx(np.eye(4) / 3600**2)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<a", "is no XML"),
        (None, "there is no|cannot be read"),
        ("<a/>", "no error curve"),
        (certificate_text(calibration(PLANE)), "no error curve"),  # of a sensor, not of a stage
    ],
)
def test_a_file_without_an_error_curve_is_refused_in_one_line(tmp_path, text, told):
    path = tmp_path / "stage.xml"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=told) as caught:
        read_stage_curve(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("uncertainty", "told"),
    [("", "its uncertainty"), (of_u([0.01] * 3, "2"), "its uncertainty"),
     (of_covariance(-COVARIANCE), "negative variance"), (of_covariance(COVARIANCE[:5]), "its uncertainty"),
     (of_covariance(COVARIANCE).replace("<si:value>", "<si:value>a", 1), "covariance has to be numbers"),
     (of_u(EXPANDED, "2 2"), "its uncertainty"), (of_u(EXPANDED, "0"), "its uncertainty"),
     (of_u([*EXPANDED[1:], float("inf")], "2"), "its uncertainty")],
)  # fmt: skip
def test_a_curve_without_its_uncertainty_is_refused(tmp_path, uncertainty, told):
    with pytest.raises(DataError, match=told):
        read_stage_curve(certificate(tmp_path / "stage.xml", 0 * ANGLE, uncertainty))


def measured(error_deg, rng, noise_mg=0.05):
    """Readings of a part with ΔK 0.002 and Δφ 0.2° at the angles of a stage with these errors."""
    declared = np.arange(0.0, 360.0, 30.0)
    psi = np.radians(12.0) - np.radians(declared - error_deg(declared))
    ideal = 1000 * np.stack([1.002 * np.cos(psi), np.sin(psi + np.radians(0.2))], axis=1) + [8.0, -5.0]
    ideal += noise_mg * rng.standard_normal(ideal.shape)
    dwells = [Dwell(k, np.array([20.0 * k]), ideal[k : k + 1], float(d)) for k, d in enumerate(declared)]
    return Session(
        tuple(dwells), accel_unit="mg", fixture_sigma_deg=0.05, reading_u_mg=noise_mg, sensor="generic"
    )


@pytest.mark.parametrize("method", ["ml", "mmpm"])
def test_a_fit_with_the_certificate_is_off_by_as_much_as_it_states(method):
    """Stages drawn from the certificate's own covariance; mmpm trusts the declared angles."""
    rng, true = np.random.default_rng(8), {"delta_k": 0.002, "delta_phi": 0.2}
    curve = StageCurve("stage.xml", ANGLE, 0.05 * np.sin(2 * np.radians(ANGLE)), COVARIANCE)
    pulls = []
    for _ in range(50):
        drawn = rng.standard_normal(4)
        session = measured(lambda d, a=drawn: 0.05 * np.sin(2 * np.radians(d)) + 0.01 * shapes(d) @ a, rng)
        found = fit(Overrides(stage_curve=curve, fixture_sigma_deg=0.0).apply(session), method)
        pulls.append([(found[n].value - v) / found[n].u for n, v in true.items()])
    assert np.std(pulls, axis=0) == pytest.approx(np.ones(2), abs=0.3)
    assert np.mean(pulls, axis=0) == pytest.approx(np.zeros(2), abs=0.45)
    fixture = next(row for row in found.budget["delta_phi"] if row.source == "fixture")
    assert "certificate" in fixture.note
    assert fixture.u == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    if method == "mmpm":
        assert fixture.share > 0.9
        without = fit(Overrides(fixture_sigma_deg=0.0).apply(session), method)
        assert max(abs(without[n].value - v) / found[n].u for n, v in true.items()) > 3


def test_a_certificate_that_does_not_cover_the_angles_is_refused():
    part = StageCurve("part.xml", np.array([0.0, 20.0, 40.0]), np.zeros(3), np.eye(3) * 1e-6)
    with pytest.raises(UsageError, match=r"part\.xml: the certificate has no errors of the stage near 60°"):
        Overrides(stage_curve=part).apply(measured(np.zeros_like, np.random.default_rng(1)))


@pytest.mark.parametrize(("step_deg", "covered"), [(45.0, True), (45.1, False)])
def test_a_certificate_covers_steps_of_45_degrees_and_its_own_angles(step_deg, covered):
    angles = np.append(45.0 * np.arange(7), 270.0 + step_deg)
    part = StageCurve("part.xml", angles, np.zeros(8), np.eye(8))
    part.check([270.0, float(angles[-1]), 0.0, 359.0, None])
    if covered:
        part.check([300.0])
    else:
        with pytest.raises(UsageError, match="near 300°"):
            part.check([300.0])


def test_a_certificate_has_no_use_for_poses_in_space():
    curve = StageCurve("stage.xml", ANGLE, 0 * ANGLE, COVARIANCE)
    rng = np.random.default_rng(1)
    dwells = tuple(
        Dwell(k, np.arange(9) + 10.0 * k, 1000 * row + rng.standard_normal((9, 3)), angle_deg=60.0 * k)
        for k, row in enumerate(np.concatenate([np.eye(3), -np.eye(3)]))
    )
    poses = Session(dwells, accel_unit="mg", sensor="generic", plane="none", source="poses.csv")
    with pytest.raises(
        DataError, match=r"poses\.csv: the certificate of a stage corrects angles in a plane"
    ):
        fit(Overrides(stage_curve=curve).apply(poses))


def test_fit_takes_the_certificate_and_records_it(tmp_path, capsys):
    session = tmp_path / "s.csv"
    write_samples_csv(
        measured(lambda d: 0.05 * np.sin(2 * np.radians(d)), np.random.default_rng(2)), session
    )
    stage = certificate(
        tmp_path / "stage.xml", 0.05 * np.sin(2 * np.radians(ANGLE)), of_covariance(COVARIANCE / 100)
    )
    assert main(["fit", str(session), "--fixture", f"dcc:{stage}", "--fixture", "0.001", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["overrides"]["stage_curve"]["new"] == "stage.xml"
    assert document["fixture_sigma_deg"] == pytest.approx(0.001)
    phi = document["parameters"]["delta_phi"]
    assert phi["value"] == pytest.approx(0.2, abs=4 * phi["u"])
    assert main(["fit", str(session), "--fixture", "dcc:none.xml"]) == 2
    assert "none.xml" in capsys.readouterr().err


def test_calibrate_keeps_the_certificate_and_every_later_fit_uses_it(tmp_path):
    """Two sessions on one stage: what its certificate does not know moves both results alike."""
    stage = certificate(tmp_path / "stage.xml", 0 * ANGLE, of_covariance(COVARIANCE))
    path = tmp_path / "s.session"
    command = ["calibrate", "sim:?seed=3", "--plan", "mmpm", "--dwell", "0.5", "--auto", "--fixture"]
    assert main([*command, f"dcc:{stage}", "-o", str(path)]) == 0
    session = load_session(path)
    assert session.stage_curve.digest == read_stage_curve(stage).digest
    assert session.fixture_sigma_deg is None
    # Its CSV states the certificate too, and gives the same answer.
    copy = tmp_path / "s.csv"
    assert main(["export", str(path), "-o", str(copy)]) == 0
    again = load_session(copy)
    assert again.stage_curve.digest == session.stage_curve.digest
    assert fit(again, "mmpm").as_dict()["parameters"] == fit(session, "mmpm").as_dict()["parameters"]
    result = fit(session, "mmpm")
    influence = result.stage_influence["delta_phi"]
    row = next(row for row in result.budget["delta_phi"] if row.source == "fixture")
    assert 0 < np.linalg.norm(influence) <= row.contribution * (1 + 1e-9)
    assert result.stage_influence["delta_phi"].shape == (4,)
    assert main([*command, f"dcc:{stage}", "--plan", "poses", "-o", str(tmp_path / "p.session")]) == 2
