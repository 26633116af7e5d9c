"""What-if: forced terms, excluded names, a closed set, and the comparison with the best model."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from adis_gonio import load_session
from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import main
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.tracing.findings import finding_of
from adis_gonio.tracing.trace import TraceRun, trace_readings
from adis_gonio.tracing.trace_result import TraceResult
from adis_gonio.tracing.what_if import AskedModel, compare, forced_terms
from tracing.small_problems import U, ideal_mg, labelled, read, surroundings

FORMULA = "mine_x = (T - 25)**2 * gx"


def turned(seed: int, formula: float = 0.0, quadratic: float = 0.0, bias=(5.0, -3.0), n=24) -> Readings:
    """A turn at changing temperature with a bias, an effect outside the catalogue and a curvature on x."""
    c = surroundings(n, seed)
    mean = ideal_mg(c)
    g = mean[:, 0] / 1000
    mean = mean + bias + np.random.default_rng([seed, 5]).normal(0, U, mean.shape)
    mean[:, 0] += formula * (c.temperature_c - 25) ** 2 * g + quadratic * g**2
    return read(c, mean)


def closed(data: Readings, *include: str) -> TraceResult:
    """The trace with these terms and no other, without the comparison with the best model."""
    return TraceRun(data, 6, (), AskedModel(include, only=True)).traced()


def test_the_amplitude_of_a_planted_formula_lies_within_its_uncertainty_in_95_percent() -> None:
    seeds, truth, inside = range(60), 0.01, 0
    for seed in seeds:
        run = TraceRun(turned(seed, formula=truth), 6, (), AskedModel((FORMULA, "bias"), only=True))
        run.search()
        value = finding_of(run.selection, "mine").parameters["mine_x"]
        inside += abs(value.value - truth) <= value.U
    low, high = stats.binom.interval(0.999, len(seeds), 0.95)
    assert low <= inside <= high


def test_a_formula_that_is_the_cause_is_better_than_the_best_model_and_its_amplitude_is_the_truth() -> None:
    result = trace_readings(turned(3, formula=0.02), request=AskedModel((FORMULA,)))
    what_if = result.what_if
    (term,) = what_if.forced
    assert what_if.odds > 20
    # The best model has an unnamed function in its place, which predicts about as well.
    assert what_if.best.error.heldout_rms < 0.1 * what_if.before.error.heldout_rms
    assert what_if.asked.error.heldout_rms < 1.2 * what_if.best.error.heldout_rms
    value = term.parameters["mine_x"]
    assert abs(value.value - 0.02) <= value.U
    assert term.differs_from_zero
    assert "mine" not in {finding.effect for finding in result.found}  # asked for, not found
    assert {finding.effect for finding in result.found} == {"bias"}
    assert result.adequate


def test_a_formula_that_is_no_cause_costs_odds_and_does_not_differ_from_zero() -> None:
    what_if = trace_readings(turned(4), request=AskedModel((FORMULA,))).what_if
    assert what_if.odds < 0.1
    assert not what_if.forced[0].differs_from_zero
    assert what_if.prior_odds == pytest.approx(0.0175)


def test_the_true_effect_put_in_has_the_amplitude_that_the_free_trace_found() -> None:
    data = turned(5, quadratic=1.5)
    free = next(one for one in trace_readings(data).found if one.effect == "quadratic")
    what_if = trace_readings(data, request=AskedModel(("quadratic:x",))).what_if
    assert what_if.odds == pytest.approx(1, rel=1e-6)
    (term,) = what_if.forced
    assert term.parameters["k2_x"].value == pytest.approx(free.parameters["k2_x"].value, rel=1e-6)
    assert free.parameters["k2_x"].u == pytest.approx(term.parameters["k2_x"].u, rel=0.2)


def test_without_the_true_effect_its_rival_is_in_the_sets() -> None:
    data = turned(6, quadratic=1.5)
    free = trace_readings(data)
    assert "what_if" not in free.as_dict()
    assert "quadratic" in {name for one in free.sets for name in one.names}
    result = trace_readings(data, request=AskedModel(exclude=("quadratic",)))
    names = {name for one in result.sets for name in one.names}
    assert "quadratic" not in names
    assert "cross_quadratic" in names
    assert "quadratic" not in {step.effect for step in result.steps}
    assert result.what_if.log_odds < 0
    assert result.detectable["quadratic"].reason == "left out of the model as asked"


def test_only_without_a_term_is_the_base_model() -> None:
    data = turned(7, quadratic=1.5)
    result = trace_readings(data, request=AskedModel(only=True))
    base = Fit.begin(data).refit()
    assert not result.steps
    assert not result.found
    assert result.fits[-1].chi2 == pytest.approx(base.chi2)
    assert result.what_if.asked.error == result.what_if.before.error
    assert result.what_if.asked.log_evidence == pytest.approx(0, abs=1e-3)


def test_only_has_the_named_terms_in_this_order_and_no_scatter() -> None:
    result = closed(turned(8, quadratic=1.5), "cubic:y", FORMULA)
    assert {step.effect for step in result.steps} == {"cubic", "mine"}
    assert not result.adequate  # the bias is not in it


def by_hand(data: Readings, terms: list, priors: list[float]) -> float:
    """Log evidence of a model by a fit and the documented prices, from columns of plain least squares."""
    base = Fit.begin(data).refit()
    fit = base.with_terms(terms, [term.start(np.zeros(len(term.amplitudes))) for term in terms]).refit()
    rows = np.linalg.qr(base.base_columns.reshape(-1, 4) / U)[0]
    total = -0.5 * fit.chi2
    for term, prior in zip(terms, priors, strict=True):
        columns = base.candidate(term).reshape(len(rows), -1) / U
        own = np.linalg.qr(columns - rows @ (rows.T @ columns))[0]
        total += math.log(prior) - 0.5 * np.log1p(16 / (own**4).sum(axis=0)).sum()
    return total


@pytest.mark.parametrize("include", [("cubic:x",), ("bias_drift:x",), ("asymmetry:y", "cubic:x")])
def test_odds_are_those_of_all_models_of_a_small_set_of_candidates(include: tuple[str, ...]) -> None:
    data = turned(9, quadratic=0.25)
    labels = ("bias[xy]", "quadratic[x]", "cubic[x]", "bias_drift[x]", "asymmetry[y]")
    terms = labelled(data, *labels)
    heights = {}
    for size in range(len(terms) + 1):
        for model in itertools.combinations(terms, size):
            chosen = frozenset(term.label for term in model)
            heights[chosen] = by_hand(data, list(model), [math.exp(-term.cost) for term in model])
    asked = {term.label for term in forced_terms(data, include)}
    runs = [TraceRun(data, 5, ()), TraceRun(data, 5, (), AskedModel(include))]
    for run in runs:
        forced = [term for term in run.terms if term.forced]
        run.terms = [*forced, *(term for term in terms if term.label not in asked or not forced)]
        run.traced()
    free, with_terms = runs
    best = max(heights, key=heights.__getitem__)
    chosen = max((model for model in heights if asked <= model), key=heights.__getitem__)
    assert {term.label for term in free.selection.terms} == best
    assert {term.label for term in with_terms.selection.terms} == chosen
    what_if = compare(free, with_terms, AskedModel(include))
    assert what_if.log_odds == pytest.approx(heights[chosen] - heights[best], abs=0.05)


def test_two_formulas_may_share_a_name_of_no_axis_and_keep_their_amplitudes() -> None:
    data = turned(10, formula=0.02)
    result = closed(data, "bias", "one_xy = (T - 25)**2 * gx")
    (step,) = [step for step in result.steps if step.effect == "one"]
    values = result.fits[-1].values.terms[result.steps.index(step)]
    assert values == pytest.approx([0.02, 0.0], abs=2e-3)


# -- the command ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("what_if") / "q.session"
    more = ["--effect", "bias", "--effect", "quadratic:k2_x=3", "--seed", "3", "--dwell", "2"]
    assert main(["simulate", "--plan", "tumble", "--positions", "6", *more, "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def data(session: Path) -> Readings:
    return readings_of(load_session(session))


WRONG = [
    (["--with", "mine_x = gx"], "it from the base model (alpha, scale_x, scale_y, delta_phi)"),
    (["--with", "mine_x = 3"], "it is constant, as is bias:x,"),
    (["--with", "mine_x = 0 * gx"], "it is zero at every position"),
    (["--with", "mine_x = gy"], "cannot distinguish it from the base model"),
    (["--with", "mine_x = foo * 2"], "no covariate is called 'foo'"),
    (["--with", "mine_x = gz"], "the session does not record gz"),
    (["--with", "mine_z = gx**2"], "mine acts on z, but z was not recorded"),
    (["--with", "mine_x = gx / 0"], "no finite value at position"),
    (["--with", "bias_x = gx**2"], "bias is an effect of the catalogue"),
    (["--with", "quadrati:x"], "did you mean 'quadratic'?"),
    (["--with", "quadratic:q"], "it has x, y, xy"),
    (["--with", "position_slip:dwell=999"], "no such candidate of position_slip"),
    (["--with", "tone"], "looked for within the dwells"),
    (
        ["--with", "quadratic:x", "--with", "mine_x = 7 * gx**2"],
        "cannot distinguish it from the base model (alpha, scale_x, scale_y, delta_phi) or",
    ),
    (["--with", "quadratic:x", "--without", "quadratic"], "name the same effect: quadratic"),
    (["--without", "nothing"], "no effect is called 'nothing'"),
    (["--without", "scale"], "it is a base parameter of every model"),
    (["--only", "--without", "bias"], "--only leaves out everything"),
]


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_a_wrong_request_is_refused_with_its_reason(
    data: Readings, options: list[str], message: str
) -> None:
    words = {
        name: [b for a, b in itertools.pairwise(options) if a == name] for name in ("--with", "--without")
    }
    with pytest.raises(UsageError) as caught:
        TraceRun(data, 6, (), AskedModel.of(*words.values(), only="--only" in options))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("options", "message"), [WRONG[4], WRONG[-4], WRONG[-1]])
def test_a_wrong_request_is_one_line_and_status_2(
    session: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["trace", str(session), *options]) == 2
    shown = capsys.readouterr()
    assert not shown.out
    (line,) = [line for line in shown.err.replace("\r", "\n").splitlines() if "adis-gonio:" in line]
    assert message in line
    assert "Traceback" not in shown.err


def test_a_session_of_one_pose_refuses_a_what_if(capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(__file__).parents[2] / "examples" / "measured" / "thermal_cycle.csv.gz"
    assert main(["trace", str(path), "--only"]) == 2
    assert "--with, --without and --only need dwells in several poses" in capsys.readouterr().err


def test_the_comparison_is_printed_in_80_columns(
    session: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["trace", str(session), "--with", "cubic:x", "--without", "quadratic"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert "What if: with cubic:x, without quadratic" in text
    assert [line.split(":")[0].strip() for line in text.splitlines() if " : " in line][:3] == [
        "base",
        "best",
        "asked",
    ]
    assert "(not different from zero)" in text


def test_the_document_has_the_comparison_if_asked(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["trace", str(session), "--json", "--with", "quadratic:x", "--with", "bias", "--only"]) == 0
    found = json.loads(capsys.readouterr().out)["what_if"]
    assert found["with"] == ["quadratic:x", "bias"]
    assert found["only"]
    assert set(found["asked"]) >= {
        "terms",
        "residual_rms_mg",
        "heldout_rms_mg",
        "chi2_per_dof",
        "log_evidence",
    }
    k2 = found["forced"][0]["parameters"]["k2_x"]
    assert abs(k2["value"] - 3) < 3 * k2["u"]


def test_the_report_compares_the_models_and_shows_what_one_more_term_buys(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    assert (
        main(["report", str(session), "--with", "cubic:x", "--without", "quadratic", "-o", str(page)]) == 0
    )
    text = page.read_text(encoding="utf-8")
    for heading in ("What if: with cubic:x, without quadratic", "What each further term buys"):
        assert f"<h2>{heading}</h2>" in text
        assert "<svg" in text.split(f"<h2>{heading}</h2>")[1].split("</section>")[0]
    assert "gain ± U" in text
    assert text.count(" (chosen)</td>") == 1
    capsys.readouterr()
    wrong = ["report", str(session), "--with", "mine_x = gx", "-o", str(tmp_path / "no.html")]
    assert main(wrong) == 2
    assert "cannot distinguish it from the base model" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "no.html").exists()
