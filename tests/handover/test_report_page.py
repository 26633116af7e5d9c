"""The page: complete, self-contained, safe, and true to the results."""

import html
import html.parser
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import fit, trace
from adis_gonio.base.conformity import Tolerance, state_conformity
from adis_gonio.base.numbers import format_uncertain, with_unit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.slips.session_positions import Named, PositionFinding
from adis_gonio.handover.calibration_report import (
    build_page,
    detection_section,
    facts,
    fitted_section,
    found_section,
    further_terms_section,
    positions_section,
    residual_section,
    rivals_section,
)
from adis_gonio.model.effects import Conditions, effect
from adis_gonio.model.records import Dwell, Session
from adis_gonio.page.document import Figure, Section, Series, Table, plot
from adis_gonio.record.loading import Overrides
from adis_gonio.tracing.trace_figures import views_of
from adis_gonio.tracing.trace_result import Unnamed
from adis_gonio.tracing.trace_summary import group_undetected, headline, how_sure
from adis_gonio.tracing.traced_answer import answer_with_trace


def planar(k2_x=0.0, bias=(8.0, -5.0), eccentric=0.0, seed=1, check=False, title=""):
    """A turn forth and back in steps of 20°, single readings of 0.1 mg."""
    rng = np.random.default_rng(seed)
    angles = np.concatenate([np.arange(0, 360, 20.0), np.arange(350, -10, -20.0)])
    theta = np.radians(angles)
    psi = np.radians(12.0) - theta + np.radians(0.003) * rng.standard_normal(len(theta))
    conditions = Conditions(np.arange(len(theta)) * 20.0, angle_rad=theta)
    psi = psi + effect("stage_eccentricity", ()).attitude_rad(np.array([eccentric, 0.0]), conditions)
    ideal = 1000 * np.stack([1.002 * np.cos(psi), np.sin(psi + np.radians(0.2))], axis=1)
    ideal = ideal + np.array(bias)
    ideal[:, 0] += k2_x * np.cos(psi) ** 2
    ideal += 0.1 * rng.standard_normal(ideal.shape)
    dwells = tuple(
        Dwell(
            k,
            np.array([20.0 * k]),
            ideal[k : k + 1],
            angle_deg=float(angles[k]),
            use="check" if check and k % 6 == 0 else "fit",
        )
        for k in range(len(angles))
    )
    return Session(
        dwells, accel_unit="mg", fixture_sigma_deg=0.003, reading_u_mg=0.1, sensor="generic", title=title
    )


class Outline(html.parser.HTMLParser):
    """Tags that are open, and every attribute that could load something."""

    void = ("meta", "br", "hr", "img", "link", "input")

    def __init__(self):
        super().__init__()
        self.open, self.loads, self.headings, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in self.void:
            self.open.append(tag)
        if tag in ("script", "link", "img", "iframe", "object", "embed"):
            self.loads.append(tag)
        self.loads += [
            f"{k}={v}"
            for k, v in attrs
            if k[:2] == "on" or (k in ("src", "href", "xlink:href", "data") and v[:1] != "#")
        ]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("h2", "h3"):
            self.headings.append(data)
        self.text.append(data)


def outline(page):
    seen = Outline()
    seen.feed(page)
    assert seen.open == []
    return seen


@pytest.fixture(scope="module")
def curved():
    session = planar(k2_x=3.0, seed=2)
    result = trace(session)
    # The page is under test here, not the choice of effects: only the two that were put in are kept.
    steps = tuple(step for step in result.steps if step.effect in ("bias", "quadratic"))
    found = tuple(finding for finding in result.found if finding.effect in ("bias", "quadratic"))
    assert {finding.effect for finding in found} == {"bias", "quadratic"}
    result = replace(
        result, steps=steps, found=found, after=steps[-1].error, adequate=True, confounded=(), reasons={}
    )
    return session, result, views_of(readings_of(session), result)


@pytest.fixture(scope="module")
def page(curved):
    session, result, _ = curved
    return build_page(session, [fit(session, "mmpm"), fit(session, "ml")], result)


def test_the_page_is_well_formed_and_loads_nothing(page):
    assert outline(page).loads == []
    assert not re.search(r"url\(|@import|https?://(?!www\.w3\.org/2000/svg)", page)


def test_the_page_answers_every_question(page):
    wanted = {
        "Summary", "Results by method", "Effects found", "Error before and after",
        "Residual, step by step", "Remaining residual", "Other probable models",
        "Smallest detectable amplitudes", "What to measure next", "Data and configuration",
    }  # fmt: skip
    assert wanted <= set(outline(page).headings)


def test_the_page_weighs_the_models_and_counts_their_terms(curved):
    _, result, _ = curved
    (rivals,) = rivals_section(result).tables
    shares = [float(share.removesuffix("%")) for _, share in rivals.rows]
    assert shares == sorted(shares, reverse=True)
    assert 95 < sum(shares) < 100.5
    assert not rivals_section(replace(result, rivals=())).tables
    (by_terms,) = further_terms_section(result).tables
    assert [row[0] for row in by_terms.rows] == ["0", "1", "2", "3"]
    assert by_terms.rows[0][1] == "base model"
    # A term gains something over the model with a term less; the base model has none less.
    assert ["±" in row[4] for row in by_terms.rows] == [False, True, True, True]


def test_a_session_without_effects_says_so_in_place_of_their_table(curved):
    _, result, _ = curved
    some, none = found_section(result), found_section(replace(result, found=()))
    assert (len(some.tables), list(some.words)) == (1, [])
    assert (len(none.tables), list(none.words)) == (0, ["No added term could be named."])
    bare = found_section(replace(result, found=(), steps=()))
    assert list(bare.words) == ["No effect had to be added."]
    for finding in result.found:
        (note,) = (note for note in some.notes if note.startswith(f"{finding.effect}: "))
        assert note.endswith(finding.cause)
    assert list(none.notes) == []


def test_a_structure_without_a_name_is_told_with_its_form(curved):
    _, result, _ = curved
    step = Unnamed(("time",), "x ~ a step at t = 9 s", 0.4, 0.97, 0.001)
    told, silent = (
        [text for part in found_section(replace(result, unnamed=one)).parts for text in part.points]
        for one in (step, None)
    )
    (more,) = (text for text in told if text not in silent)
    assert more.startswith("x ~ a step at t = 9 s (explains 40")


def test_remaining_residuals_share_a_figure_by_covariate_and_name_their_quantity(curved):
    *_, views = curved
    figures = residual_section(views).figures
    covariates = {panel.covariate for panel in views.left}
    assert len(figures) == len(covariates) < len(views.left)
    assert all("residual / mg" in figure.svg for figure in figures)
    assert "Residual of the final model against the declared angle" in {one.caption for one in figures}
    norm = replace(views, left=(replace(views.left[0], quantity="norm"),))  # as in space
    (figure,) = residual_section(norm).figures
    assert "residual of the norm / mg" in figure.svg


def test_the_results_of_a_session_without_any_method_say_why(curved):
    session, *_ = curved
    empty = fitted_section([], {})
    assert (len(empty.tables), len(empty.words)) == (0, 1)
    assert "too few poses" in empty.words[0]
    failed = fitted_section([], {"mmpm": "the angles are not equidistant"})
    assert (list(failed.words), list(failed.notes)) == ([], ["mmpm: the angles are not equidistant"])
    assert list(fitted_section([fit(session, "ml")], {}).words) == []


def test_a_wrong_position_has_its_angles_by_gravity_and_by_the_gyro():
    gravity, gyro = (31.04, 0.1), (31.2, 0.5)  # with standard uncertainties; the page states 95 %
    named = (Named("slipped", (3,), 0.9),)
    wrong = PositionFinding(3, "slipped", 30.0, gravity, gyro, gravity, (1.04, 0.1), None, (), 0.99, named)
    section = positions_section([wrong, replace(wrong, declared_deg=None, gyro_deg=None)])
    cells = [[cell.replace("\xa0", " ") for cell in row[1:4]] for row in section.tables[0].rows]
    assert cells == [["30°", "(31.04 ± 0.20)°", "(31.20 ± 0.98)°"], ["–", "(31.04 ± 0.20)°", "–"]]
    swapped = replace(wrong, finding="swapped", others=(5,))
    assert len(positions_section([swapped, replace(swapped, position=5, others=(3,))]).words) == 1


def test_results_by_method_begin_with_delta_k_and_delta_phi(page):
    body = page[page.index("Results by method") :]
    assert body.index(">ΔK</th>") < body.index(">Δφ</th>") < body.index(">α</th>")


def test_every_step_has_a_figure(page, curved):
    _, result, _ = curved
    steps = [h for h in outline(page).headings if h.startswith("Step ")]
    assert steps == [f"Step {k}: {step.effect}" for k, step in enumerate(result.steps, 1)]
    body = page[page.index("Residual, step by step") : page.index("Remaining residual")]
    assert body.count("<svg") >= len(result.steps)


def test_figures_show_the_residual_that_the_steps_state(curved):
    _, result, drawn = curved
    assert len(drawn.steps) == len(result.steps)
    by_axis = [p for p in drawn.left if p.covariate == "angle"]
    rms = np.sqrt(np.mean([p.after**2 for p in by_axis]))
    assert rms == pytest.approx(result.after.residual_rms, rel=1e-3)
    assert np.sqrt(np.mean([p.before**2 for p in by_axis])) == pytest.approx(
        result.before.residual_rms, rel=1e-3
    )


def test_a_quadratic_is_drawn_against_the_reading_that_it_curves(curved):
    _, result, drawn = curved
    (panel,) = drawn.steps[[step.effect for step in result.steps].index("quadratic")]
    assert (panel.covariate, panel.quantity) == ("reading_x", "residual_x")
    curve = np.polyfit(panel.x, panel.before, 2)[0]
    assert curve == pytest.approx(3.0, abs=1.0)
    assert abs(np.polyfit(panel.x, panel.after, 2)[0]) < 0.2


def test_an_error_of_the_stage_is_drawn_as_an_angle():
    session = planar(eccentric=0.1)
    result = trace(session)
    drawn = views_of(readings_of(session), result)
    (panel,) = drawn.steps[[step.effect for step in result.steps].index("stage_eccentricity")]
    assert (panel.covariate, panel.quantity) == ("angle", "angle")
    assert np.ptp(panel.before) > 0.1 > 4 * np.std(panel.after)


def test_check_dwells_are_drawn_apart():
    session = planar(k2_x=3.0, check=True)
    panel = views_of(readings_of(session), trace(session)).steps[0][0]
    assert (len(panel.x), len(panel.check_x)) == (30, 6)


def test_delta_k_of_the_final_model_has_its_covariance(curved):
    _, result, _ = curved
    base = result.base
    assert base["delta_k"].value == pytest.approx(
        base["scale_x"].value / base["scale_y"].value - 1, abs=1e-4
    )
    assert abs(base["delta_k"].value - 0.002) < 4 * base["delta_k"].u
    assert 0 < base["delta_k"].u < 2 * np.hypot(base["scale_x"].u, base["scale_y"].u)


def test_whatever_comes_from_a_file_is_escaped():
    bad = '<script>alert("x")</script>'
    session = planar(title=bad)
    session = replace(session, notes=(bad,), sensor=bad, facts={"url": bad, "problems": [bad]})
    page = build_page(
        session, [], bad, sections=[Section(bad, [bad], [bad], tables=[Table([bad], [[bad]])])]
    )
    assert "<script" not in page
    assert outline(page).loads == []


def test_no_text_of_a_file_is_a_character_of_control():
    bad = "\x1b]0;title\x07\x9b2J\u202e"
    session = replace(planar(title=bad), facts={"started_utc": bad, "url": bad, "problems": [bad]})
    page = build_page(session, [], bad, sections=[Section(bad, [bad], tables=[Table([bad], [[bad]])])])
    assert "]0;title?" in page
    assert not set(page) & set(bad) - set("]0;title2J")


def test_a_session_that_cannot_be_traced_still_has_a_page():
    page = build_page(planar(), [], "2 positions give 4 equations", failures={"ml": "singular"})
    assert "2 positions give 4 equations" in page
    assert "ml: singular" in page


def test_a_row_has_as_many_cells_as_its_table_has_heads():
    with pytest.raises(ValueError, match="2 heads, but 1 cells"):
        Table(["axis", "bias"], [["x", "3 mg"], ["y"]])


def test_the_page_says_who_measured_which_part_where_and_what_was_overridden():
    corrected = Overrides(
        gravity_mps2=9.81, fixture_sigma_deg=math.inf, reverse=True, columns={"ax": "Acc_X"}
    )
    session = corrected.apply(planar())
    for name, text in {"operator": "Ada <b>", "serial": "0042", "stage": "T2"}.items():
        object.__setattr__(session, name, text)  # as a session has them that was recorded on a bench
    said = " ".join(outline(build_page(session, [], "none")).text)
    assert "part 0042 · stage T2 · operator Ada <b>" in said
    for text in (
        "overridden: gravity 9.81 m/s² instead of 9.80665",
        "uncertainty of a declared angle free instead of",
        "the stage turned the other way",
        "columns ax = 'Acc_X'",
    ):
        assert text in said
    texts = [*facts(session).values()]
    assert [texts.count(text) for text in ("0042", "T2", "Ada <b>")] == [1, 1, 1]


def test_the_facts_of_a_session_are_stated_with_their_units():
    def dwell(k, count, **more):
        return Dwell(k, 60.0 * k + 0.01 * np.arange(count), np.ones((count, 2)), angle_deg=90.0 * k, **more)

    measured = {"temperature_c": np.array([21.5, 23.25]), "supply_v": np.array([5.0, np.nan])}
    configuration = {"filter_m": 4, "sample_rate_hz": 819.2}
    session = Session(
        (dwell(0, 2, **measured), dwell(1, 11)),
        accel_unit="mg",
        gravity_mps2=9.81,
        fixture_sigma_deg=0.02,
        facts={"configuration": configuration, "simulated": True, "url": "sim:", "note": "lamp on"},
    )
    stated = {
        "sensor": "adis16354 (simulated)", "bus": "sim:", "note": "lamp on", "begun (UTC)": "",
        "samples": "13, 2 to 11 a dwell", "duration": "1.0 min", "sample rate": "819.2 Hz",
        "filter": "2^4 taps, twice", "plane of rotation": "xy", "local gravity": "9.81000 m/s²",
        "standard uncertainty of a declared angle": "0.02°", "unit of the accelerations": "mg",
        "temperature": "21.50 to 23.25 °C", "supply": "5.00 V",
        "reference temperature of the parameters": "22.4 °C",
    }  # fmt: skip
    found = facts(session, 22.36)
    assert {name: found[name].replace("\xa0", " ") for name in stated} == stated
    plain = replace(
        session, plane="none", fixture_sigma_deg=None, facts={}, dwells=(dwell(0, 3), dwell(1, 3))
    )
    others = {
        "plane of rotation": "none: attitudes in space", "filter": "", "sample rate": "",
        "samples": "6, 3 a dwell", "standard uncertainty of a declared angle": "not stated",
        "temperature": "not recorded", "reference temperature of the parameters": "",
    }  # fmt: skip
    found = facts(plain)
    assert {name: found[name] for name in others} == others
    free = facts(replace(session, fixture_sigma_deg=math.inf))
    assert free["standard uncertainty of a declared angle"] == "free: declared angles are not used"


def test_the_answer_stands_first_in_large_numerals_with_what_covers_it(page, curved):
    session, result, _ = curved
    values = answer_with_trace(fit(session, "ml"), result).values
    key = page[page.index('<dl class="key">') : page.index("</dl>")]
    assert page.index("<main>") < page.index('<dl class="key">') < page.index("<p>", page.index("<main>"))
    assert key.count("<dt>") == 3
    phi = values["delta_phi"]
    assert with_unit(format_uncertain(phi.value, phi.U), "deg") in key
    assert f"k\u00a0=\u00a0{phi.k:.2f}" in key
    assert "U of a displayed angle" in key
    assert f"Left out: {result.heldout_design}; `fit` leaves out one dwell at a time" in page
    assert "adds the source temperature to U." in page


def test_sections_of_others_stand_before_the_data():
    figure = Figure(plot([Series([0, 1], [0, 1])], "x", "y", title="twin"), "a caption")
    mine = Section("The twin against the data", figures=[figure])
    page = build_page(planar(), [], "none", sections=[mine])
    assert page.index("The twin against the data") < page.index("Data and configuration")
    assert figure.svg in page


def test_words_say_what_was_found_and_how_sure(curved):
    _, result, _ = curved
    assert headline(result).startswith("Two effects bring the residual down to the noise of the readings: ")
    assert "bias (x, y)" in headline(result)
    assert "quadratic (x)" in headline(result)
    sure = replace(result.found[0], probability=1.0, p_value=0.0)
    assert how_sure(sure).startswith("as good as certain")


def test_an_inadequate_model_is_never_said_to_reach_the_noise(curved):
    said = headline(replace(curved[1], adequate=False))
    assert "down to the noise of the readings" not in said
    assert "stays larger than the noise" in said


def test_effects_of_what_was_not_recorded_are_said_to_be_unseen(curved):
    reasons = {
        name: reason for reason, names in group_undetected(curved[1]).blind.items() for name in names
    }
    assert reasons["bias_temperature"] == "temperature not recorded"
    assert "supply" in reasons["supply_bias"]


def test_every_effect_that_was_looked_for_has_a_row_with_its_conclusion(curved):
    result = curved[1]
    (table,) = detection_section(result).tables
    conclusions = {name: row[-1] for row in table.rows for name in row[0].split(", ")}
    assert set(conclusions) == set(result.detectable)
    assert conclusions["quadratic"] == "found"
    assert {conclusions[name] for name in group_undetected(result).weak} == {"absent or smaller"}


def certificate_of(page):
    """Texts of the first section, which is printed on a page of its own."""
    first = page[page.index('<section class="sheet">') : page.index("</section>")]
    assert page.index("<main>") + 7 >= page.index('<section class="sheet">')
    rows = re.findall(r"<div><dt>([^<]*)</dt><dd>([^<]*)</dd></div>", first)
    return first, {name: html.unescape(text) for name, text in rows}


def test_page_one_is_a_certificate_that_a_laboratory_can_sign(curved):
    session, result, _ = curved
    session = replace(
        session,
        **{"serial": "A7", "stage": "table 2", "operator": "M. Muster", "laboratory": "Lab <1>"},
        facts={"started_utc": "2026-03-01T10:00:00Z"},
    )
    fits = [fit(session, "ml")]
    page = build_page(session, fits, result, tolerance=Tolerance(0.05))
    first, facts = certificate_of(page)
    stated = {
        "sensor": "generic", "serial": "A7", "stage": "table 2", "operator": "M. Muster",
        "laboratory": "Lab <1>", "customer": "not stated", "date (UTC)": "2026-03-01 10:00",
        "session": "36 dwells, one plane, generic", "local gravity": "9.80665 m/s²",
        "u of a stage angle": "0.003°",
        "temperature": "not recorded", "supply": "not recorded",
    }  # fmt: skip
    assert {name: facts[name] for name in stated} == stated
    assert {"date", "name, signature"} <= set(facts)
    assert first.count("name, signature") == 1
    assert first.count("<svg") == 2
    assert [first.count(f">{angle}</text>") for angle in (0, 90, 180, 270, 360)] == [2] * 5
    answer = answer_with_trace(fits[0], result)
    statement = state_conformity(Tolerance(0.05), answer.error_curves())
    assert [line for line in statement.lines if html.escape(line[1:]) not in first] == []
    assert statement.with_calibration.verdict == "pass"
    assert statement.without_calibration.verdict == "fail"
    assert "@bottom-right" in page
    assert "break-after: page" in page


def test_without_a_tolerance_or_an_uncertainty_the_certificate_states_no_conformity(curved):
    session, result, _ = curved
    first, _ = certificate_of(build_page(session, [fit(session, "ml")], result))
    assert "Conformity is not stated: no tolerance was given." in first
    pair = (Dwell(0, np.zeros(1), np.array([[999.0, 3.0]]), 0.0),)
    pair += (Dwell(1, np.full(1, 60.0), np.array([[4.0, -1001.0]]), 90.0),)
    vague = Session(pair, accel_unit="mg", sensor="generic")
    first, _ = certificate_of(build_page(vague, [fit(vague, "two-position")], "not traced"))
    assert "Conformity is not stated: " in first
    assert "<svg" not in first


def test_the_curves_are_the_errors_of_the_sensor_that_was_measured(curved):
    """K_x 1.002, Δφ 0.2°, biases 8 and −5 mg, 3 mg of quadratic: the error of X and Y read as they are."""
    session, result, _ = curved
    before, after = answer_with_trace(fit(session, "ml"), result).error_curves()
    theta = np.radians(before.angle_deg)
    psi = np.radians(12.0) - theta
    x = 1002 * np.cos(psi) + 8 + 3 * np.cos(psi) ** 2
    y = 1000 * np.sin(psi + np.radians(0.2)) - 5
    wrong = np.degrees(np.angle(np.exp(1j * (psi - np.arctan2(y, x)))))
    assert before.error_deg == pytest.approx(wrong, abs=5 * before.U_deg.max())
    assert before.U_deg == pytest.approx(after.U_deg)
    assert np.abs(wrong).max() > 20 * before.U_deg.max()
    assert not after.error_deg.any()
