"""The one answer: the same on the screen, on the page, in JSON and in Python."""

import dataclasses
import html
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

import adis_gonio
from adis_gonio import fit, trace
from adis_gonio.base.conformity import Tolerance, state_conformity
from adis_gonio.base.errors import DataError, NotInstalledError, UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.faces.cli import main
from adis_gonio.fitting.answer import Answer, Score
from adis_gonio.fitting.estimation.readings import Unit
from adis_gonio.handover.calibration_report import build_page, certificate_section, facts, scores_section
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.samples_writer import write_samples_csv
from adis_gonio.tracing.findings import in_units_of_file, shares
from adis_gonio.tracing.trace_result import ErrorFigures, Finding
from adis_gonio.tracing.traced_answer import TracedAnswer, answer_with_trace

TURN = (*range(0, 360, 30), *range(330, -30, -30))


def planar(unit="mg", bias=(8.0, -5.0), k2=0.0, seed=1, fixture=0.003):
    """A turn there and back; in counts 2 counts a mg on X, 3 on Y, and zeros of their own."""
    rng = np.random.default_rng(seed)
    psi = np.radians(12.0 - np.array(TURN) + fixture * rng.standard_normal(len(TURN)))
    level = 1000 * np.stack([1.002 * np.cos(psi), np.sin(psi + np.radians(0.2))], axis=1) + bias
    level[:, 0] += k2 * np.cos(psi) ** 2
    level += 0.1 * rng.standard_normal(level.shape)
    if unit == "counts":
        level = level * [2.0, 3.0] + [5000.0, -7000.0]
    dwells = tuple(
        Dwell(
            k,
            np.array([20.0 * k]),
            level[k : k + 1],
            float(a),
            temperature_c=np.array([25.0 + 0.01 * k]),
        )
        for k, a in enumerate(TURN)
    )
    return Session(
        dwells,
        accel_unit=unit,
        sensor="generic",
        fixture_sigma_deg=fixture,
        reading_u_mg=0.1 if unit == "mg" else None,
    )


def spatial(seed=1):
    """Poses in space of a part with biases, gains and skews."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(30, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    skewed = u.copy()
    skewed[:, 1] += 0.004 * u[:, 0]
    level = 1000 * skewed * [1.002, 0.999, 1.001] + [8.0, -5.0, 3.0] + 0.1 * rng.standard_normal(u.shape)
    dwells = tuple(Dwell(k, np.array([20.0 * k]), level[k : k + 1]) for k in range(len(u)))
    return Session(
        dwells, accel_unit="mg", sensor="generic", plane="none", reading_u_mg=0.1, fixture_sigma_deg=np.inf
    )


@pytest.fixture(scope="module")
def bent():
    session = planar(k2=3.0)
    return session, fit(session), trace(session)


@pytest.mark.parametrize(
    "make", [planar, lambda: planar("counts"), spatial], ids=["plane", "counts", "space"]
)
def test_fit_trace_and_report_agree_on_every_shared_name(make):
    session = make()
    by_fit = fit(session, "ml").parameters
    result = trace(session)
    traced = dict(result.base)
    for finding in result.found:
        traced |= finding.parameters
    shared = set(by_fit) & set(traced)
    assert {"scale_x", "scale_y"} <= shared
    # The zero of counts is part of their unit: a trace finds no bias beside it.
    assert session.accel_unit == "counts" or {"bias_x", "bias_y"} <= shared
    document = result.as_dict()
    for name in shared:
        mine, other = by_fit[name], traced[name]
        assert mine.unit == other.unit, name
        assert other.value == pytest.approx(mine.value, abs=mine.U + other.U), name
        assert "degree" not in mine.unit
    assert {"u", "dof", "k", "U"} <= set(next(iter(document["base"].values())))
    page = html.unescape(build_page(session, [fit(session, "ml")], result))
    for name in ("scale_x", "bias_x"):
        assert {"scale_x": "K_x"}.get(name, name) in page
    if session.accel_unit == "counts":
        assert by_fit["bias_x"].unit == "counts"
        assert by_fit["bias_x"].value == pytest.approx(5016, abs=5)
        assert "counts/(m/s²)" in page


def test_a_bias_found_in_counts_is_stated_as_fit_states_it():
    unit = Unit("counts", np.array([5000.0, -7000.0]), np.array([2.0, 3.0]))
    value = {"bias_x": Value(8.0, 0.5, "mg", 10.0), "bias_y": Value(-5.0, None, "mg")}
    stated = in_units_of_file(Finding("bias", ("x", "y"), value, 0.0, 0.0, 1.0), unit).parameters
    assert stated["bias_x"] == Value(5016.0, 1.0, "counts", 10.0)
    assert stated["bias_y"] == Value(-7015.0, None, "counts")


def test_shares_never_exceed_all_and_follow_the_table_of_errors(bent):
    _, _, result = bent
    explained = {finding.effect: finding.explains for finding in result.found}
    assert sum(explained.values()) <= 1 + 1e-12
    chain = [fit.dof * (fit.chi2 / fit.dof - 1) for fit in result.fits]
    for k, step in enumerate(result.steps):
        fall = (chain[k] - max(chain[k + 1], 0)) / chain[0]
        assert explained[step.effect] == pytest.approx(fall, abs=0.02)


def test_shares_of_steps_that_make_it_worse_stay_within_all():
    assert shares(["a", "b", "c"], [10.0, 12.0, 5.0, 1.0]) == pytest.approx({"a": 0, "b": 0.5, "c": 0.4})
    assert sum(shares(["a", "b", "a"], [10.0, 1.0, 8.0, 0.0]).values()) == pytest.approx(1.0)


def test_the_reference_temperature_is_stated(bent):
    session, fitted, result = bent
    mean = float(np.mean([d.temperature_c[0] for d in session.dwells]))
    assert fitted.as_dict()["reference_temperature_c"] == pytest.approx(mean)
    assert result.as_dict()["reference_temperature_c"] == pytest.approx(mean)
    assert f"{mean:.1f} °C" in html.unescape(build_page(session, [fitted], result))


def test_where_a_trace_ran_the_answer_has_its_effects_and_its_values(bent):
    _, fitted, result = bent
    answer = answer_with_trace(fitted, result)
    assert answer.recommended.effects == ("quadratic",)  # biases are the method's own
    assert answer.values["delta_k"] == result.base["delta_k"]
    assert answer.scores["trace"].angle_rms_deg < 0.3 * answer.scores["ml"].angle_rms_deg
    assert answer.values["angle"].value == answer.scores["trace"].angle_rms_deg
    assert abs(answer.values["delta_k"].value - 0.002) < 3 * answer.values["delta_k"].u
    for name, rows in answer.budget.items():
        total = math.sqrt(sum(row.contribution**2 for row in rows))
        assert total == pytest.approx(answer.values[name].u, rel=1e-6)
    assert "Answer by method ml with quadratic\n" in answer.text()
    assert json.loads(json.dumps(answer.as_dict(), allow_nan=False))["recommended"]["effects"]


def test_a_trace_that_predicts_worse_is_not_the_answer(bent):
    _, fitted, result = bent
    poor = dataclasses.replace(result, fits=result.fits[:1])
    answer = answer_with_trace(fitted, poor)
    assert not isinstance(answer, TracedAnswer)
    assert answer.recommended.effects == ()


def test_a_trace_that_finds_the_biases_alone_leaves_the_answer_of_the_fit(bent):
    _, fitted, result = bent
    only = dataclasses.replace(result, steps=tuple(s for s in result.steps if s.effect == "bias"))
    assert only.steps
    answer, plain = answer_with_trace(fitted, only), Answer.of(fitted, own=False)
    assert answer.values == plain.values
    assert answer.title == plain.title
    assert "the trace finds" in answer.why


def test_why_speaks_of_the_method_that_it_recommends():
    given = fit(planar(), method="paper")
    answer = Answer.of(given)
    assert answer.title == "paper (recommended is ml)"
    assert answer.why.startswith("Why ml: it determines the biases")


def test_the_page_leads_with_the_answer_and_has_its_numbers(bent):
    session, fitted, result = bent
    page = html.unescape(build_page(session, [fitted], result))
    headings = re.findall(r"<h2[^>]*>([^<]+)</h2>", page)
    assert headings[:2] == ["Certificate", "Answer"]
    assert {"Uncertainty budget", "Methods on the same readings"} <= set(headings)
    answer = answer_with_trace(fitted, result)
    for line in answer.lines:
        for cell in (line.value, line.u, line.expanded):
            assert cell in page
    assert answer.why in page


def test_in_space_the_answer_is_scale_skew_and_bias():
    answer = Answer.of(fit(spatial()))
    assert {"scale_x", "skew_xy", "bias_z"} <= set(answer.values)
    assert "delta_k" not in answer.values
    assert "angle" not in answer.values
    assert max(map(len, answer.text().splitlines())) <= 80


def test_the_certificate_is_traceable_to_declared_angles_only_if_the_fit_uses_them():
    def trace_line(session, answer):
        return certificate_section(answer, facts(session)).notes[0]

    in_plane, in_space = planar(), spatial()
    answer = Answer.of(fit(in_plane))
    assert "to the stated gravity and to declared angles only" in trace_line(in_plane, answer)
    assert "to the stated gravity only" in trace_line(in_space, Answer.of(fit(in_space)))
    turned = replace(answer, result=replace(answer.result, method="free-turn"))
    assert "to the stated gravity only" in trace_line(in_plane, turned)


def test_methods_without_a_score_make_no_table():
    answer = Answer.of(fit(planar()))
    assert scores_section(answer).tables[0].rows
    unscored = replace(answer, scores=dict.fromkeys(answer.scores, Score(None, None, None, None, 0)))
    section = scores_section(unscored)
    assert not section.tables
    assert "cannot be compared" in section.words[0]


def test_the_table_of_results_is_no_wider_than_the_page():
    session = planar()
    page = build_page(session, list(fit(session).comparison.results), "not traced")
    body = page[page.index("Results by method") :]
    for table in re.findall(r"<table.*?</table>", body, re.DOTALL):
        head = re.findall(r"<th[ >]", table.partition("</thead>")[0])
        if "K_x" in table:
            assert len(head) <= 5
    for name in ("paper", "two-position", "ml", "mmpm"):
        assert name in body


def test_fit_and_trace_take_a_path(tmp_path):
    session = planar()
    path = tmp_path / "turn.csv"
    write_samples_csv(session, path)
    assert fit(path).as_dict()["parameters"] == fit(str(path)).as_dict()["parameters"]
    assert fit(path)["delta_k"].value == pytest.approx(fit(session)["delta_k"].value, abs=1e-9)
    with pytest.raises(DataError):
        fit(tmp_path / "none.csv")
    with pytest.raises(UsageError, match="not int"):
        adis_gonio.trace(3)


def test_results_are_readable_in_a_shell_a_notebook_and_pandas(bent, capsys, tmp_path):
    session, fitted, result = bent
    assert fitted.summary() == str(fitted)
    assert "ΔK" in str(fitted)
    assert len(repr(result)) < 100_000
    assert "Readings(" not in repr(fitted)
    assert "<td>delta_k</td>" in fitted._repr_html_()
    assert "<caption>" in result._repr_html_()
    frame = fitted.to_pandas()
    assert frame.loc["delta_k", "u"] == fitted["delta_k"].u
    assert list(frame.columns) == ["value", "u", "dof", "k", "U", "unit"]
    assert result.to_pandas().loc["k2_x", "unit"] == "mg/g²"
    path = tmp_path / "turn.csv"
    write_samples_csv(session, path)
    assert main(["fit", str(path), "--method", fitted.method]) == 0
    shown = capsys.readouterr().out
    # The same words on the screen, whatever width their sentences are folded to.
    answer = Answer.of(fitted)
    assert fitted.summary().splitlines() == [*answer.doubt_lines(), *answer.headline()]
    for words in (answer.doubt_lines(), answer.headline()):
        assert " ".join(" ".join(words).split()) in " ".join(shown.split())


def test_without_pandas_the_extra_is_named(bent, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(NotInstalledError, match=r"\[pandas\]"):
        bent[1].to_pandas()


def test_a_followed_advice_is_not_given_again():
    everything = Answer.of(fit(planar())).warnings(everything=True)
    assert any("bias cannot be seen" in line for line in everything)
    assert not any("measure 180" in line for line in everything)
    assert Answer.of(fit(planar())).warnings() == []


def test_error_figures_without_a_known_noise_share_by_the_residual():
    from adis_gonio.tracing.findings import excesses

    figures = [ErrorFigures(r, None, None, None) for r in (4.0, 2.0, 1.0)]
    assert shares(["a", "b"], excesses([], figures)) == pytest.approx({"a": 0.75, "b": 0.1875})


def test_an_rms_error_above_u_is_explained_on_every_face():
    session = planar()
    answer = Answer.of(fit(session))
    assert not any("rms error" in text for text in answer.remarks)
    large = {"angle": Value(30 * answer.values["angle"].U, answer.values["angle"].u, "deg")}
    vars(answer)["values"] = large
    (said,) = (text for text in answer.remarks if "rms error" in text)
    assert "not safe" in said
    assert said in " ".join(answer.text(80).split())
    page = certificate_section(answer, facts(session))
    assert said in page.notes


def test_a_pass_below_the_rms_error_of_single_dwells_is_explained_by_their_placement():
    """24 placements with u = 0.2°: the mean is much better than each, and the certificate says so."""
    session = planar(fixture=0.2)
    answer = Answer.of(fit(session))
    tolerance = Tolerance(0.12)
    assert state_conformity(tolerance, answer.error_curves()).with_calibration.verdict == "pass"
    assert answer.values["angle"].value > tolerance.limit_deg
    page = certificate_section(answer, facts(session), tolerance=tolerance)
    (said,) = (text for text in page.notes if "rms error" in text)
    assert "placement on the stage (u 0.2" in said
    assert "conformity are about the calibrated angle" in said


def test_a_stated_noise_is_not_called_the_noise_within_the_dwells():
    bent = fit(planar(k2=8.0))
    assert any("noise of the readings" in text for text in bent.warnings)
    assert not any("within the dwells" in text for text in bent.warnings)
