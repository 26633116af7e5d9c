"""The blind sessions themselves: physics, noise, what a file tells, and a judge that can say no."""

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.model.effects import Conditions, catalogue
from tracing import rounds as blind_rounds
from tracing.blind import FOREIGN, KINDS, SEEN, SIZES, draw, write
from tracing.lens import Lens
from tracing.named_truth import NAMES, draw_named
from tracing.plans import draw_bench, draw_noise
from tracing.undeclared import BEYOND, GRAMMAR
from tracing.verdict import covariate, judge, oracle_rms

ERROR = {"residual_rms_mg": 1.0, "heldout_rms_mg": 1.0, "angle_rms_deg": 0.0, "chi2_per_dof": 1.0}


def answer(*names: str, unnamed: dict | None = None) -> dict:
    """A trace's JSON that claims these names."""
    return {
        "adequate": True,
        "found": [{"effect": name, "axes": ["x"], "parameters": {}} for name in names],
        "confounded": [],
        "unnamed": unnamed,
        "error": {"before": ERROR, "after": ERROR},
    }


@pytest.mark.parametrize("name", NAMES)
def test_own_physics_agrees_with_the_catalogue(name: str) -> None:
    rng = np.random.default_rng(5)
    bench = draw_bench(rng)
    rows, check = bench.dwells, bench.check
    term = draw_named(rng, name, rows, check)
    effects = catalogue()
    axes = (
        tuple(sorted({label.rsplit("_", 1)[1][0] for label in term.reported})) if not term.attitude else ()
    )
    choices = {
        "dwell": int(np.argmax(term.basis(rows, np.ones((len(check), 2)))[0].reshape(len(check), -1)[:, 0]))
    }
    if "cycles" in term.shapes:
        choices["cycles"] = int(term.shapes["cycles"])
    kind = effects[name]
    effect = kind(axes=axes, **{c: choices[c] for c in kind.choices() if c in choices})
    truth = dict(zip(term.reported, term.coefficients, strict=True)) | term.shapes
    values = np.array([truth[parameter.name] for parameter in effect.parameters])
    conditions = Conditions(
        time_s=rows.time_s,
        angle_rad=rows.angle_rad,
        order=rows.order,
        approach=rows.approach,
        previous_angle_rad=rows.previous_rad,
        temperature_c=rows.temperature_c,
        supply_v=rows.supply_v,
        temperature_history=rows.history,
        load_history=(rows.history[0], rows.loads),
    )
    ideal = bench.ideal_mg(bench.alpha - rows.angle_rad)
    own = term.value(rows, ideal)
    if term.attitude:
        np.testing.assert_allclose(effect.attitude_rad(values, conditions), np.deg2rad(own), atol=1e-12)
    else:
        np.testing.assert_allclose(
            effect.reading(values, ideal, conditions), own, rtol=1e-6, atol=2e-3 * np.abs(own).max()
        )


def test_dwell_means_scatter_by_the_declared_uncertainty() -> None:
    rng = np.random.default_rng(0)
    bench = replace(draw_bench(rng), taps=4)
    scores = np.concatenate([bench.mean(draw_noise(rng, bench)) / bench.u_mg for _ in range(60)])
    assert np.std(scores) == pytest.approx(1.0, abs=0.04)
    noise = draw_noise(rng, bench)[: bench.starts[1], 0]
    assert np.corrcoef(noise[:-1], noise[1:])[0, 1] > 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_put_in_can_be_seen(kind: str) -> None:
    for index in range(24):
        blind, _ = draw(kind, 3, index)
        lens = Lens(blind.bench)
        for k, term in enumerate(blind.terms):
            others = [lens.columns(other) for j, other in enumerate(blind.terms) if j != k]
            assert SIZES[0] <= lens.peak(term) <= SIZES[1]
            assert lens.unexplained(lens.contribution(term), others) >= SEEN
        if blind.undeclared:
            target = lens.contribution(blind.terms[0])
            assert min(lens.unexplained_by_names(target, [name]) for name in NAMES) >= FOREIGN


def test_sessions_are_as_varied_as_asked() -> None:
    benches = [draw("none", 3, index)[0].bench for index in range(300)]
    fitted = [int((~bench.check).sum()) for bench in benches]
    assert min(fitted) == 12
    assert max(fitted) == 48
    settings = {bench.setting.split(",")[0] for bench in benches}
    assert settings == {"order", "reverse", "shuffled", "forth and back"}
    assert {bench.setting.split(",")[1] for bench in benches} == {" 1 turns", " 2 turns", " 3 turns"}
    assert 0.003 <= min(b.fixture_deg for b in benches) < 0.004
    assert 0.015 < max(b.fixture_deg for b in benches) <= 0.02
    assert np.std([b.zero_mg for b in benches]) == pytest.approx(10, rel=0.1)
    assert len(GRAMMAR) >= 12
    assert len(BEYOND) >= 10


def test_file_does_not_tell_what_was_put_in(tmp_path) -> None:
    blind, samples = draw("two", 3, 1)
    write(tmp_path / "session.csv", blind, samples)
    text = (tmp_path / "session.csv").read_text()
    keys = [line for line in text.splitlines() if line.startswith("#")]
    assert all(line.split(":")[0] in {"# sensor", "# fixture_sigma_deg", "# accel_unit"} for line in keys)
    assert not any(name in text for name in blind.names)


def test_same_seed_gives_the_same_session() -> None:
    (first, one), (second, two) = draw("beyond", 3, 4), draw("beyond", 3, 4)
    np.testing.assert_array_equal(one, two)
    assert first.terms[0].name == second.terms[0].name


def test_oracle_errs_as_the_noise_does() -> None:
    ratios = []
    for kind in ("none", "one", "beyond"):
        for index in range(40):
            blind, _ = draw(kind, 3, index)
            if not blind.bench.check.any():
                continue
            # The fixture's tolerance takes up most of the tangential part; what is left is the noise's own.
            ratios.append(oracle_rms(blind)[0] / np.sqrt(np.mean(blind.bench.u_mg**2)))
    assert 0.75 < np.median(ratios) < 1.15


def test_truth_is_right_and_another_name_is_wrong() -> None:
    for index in range(len(NAMES)):
        blind, _ = draw("one", 3, index)
        good = judge(blind, answer(NAMES[index]))
        assert good.exact
        assert not good.wrong
        assert not judge(blind, answer()).found
        assert judge(blind, answer(NAMES[index], "bias")) == good  # every part has a zero
        assert not judge(blind, answer(NAMES[index], "supply_bias" if index != 9 else "cubic")).exact
        assert not judge(blind, answer(NAMES[index], unnamed={"covariates": ["time"], "form": ""})).exact


def test_a_name_is_equivalent_only_where_the_session_cannot_tell() -> None:
    pairs = {
        "quadratic": "asymmetry",
        "bias_drift": "warm_up",
        "position_slip": "outlier_dwell",
        "hysteresis": "backlash",
    }
    verdicts: dict[str, list[bool]] = {name: [] for name in pairs}
    for index in range(200):
        name = NAMES[index % len(NAMES)]
        if name in pairs:
            verdicts[name].append(judge(draw("one", 3, index)[0], answer(pairs[name])).exact)
    assert 0 < np.mean(verdicts["quadratic"]) < 1
    assert all(verdicts["bias_drift"])  # beside a zero, an exponential that lasts four sessions is a line
    assert not any(verdicts["hysteresis"])  # a step of a reading is no turn
    assert all(verdicts["position_slip"])  # a slip is an outlier of the tangent


def test_undeclared_needs_its_covariate_and_suffers_no_name() -> None:
    jump = next(
        draw("uncatalogued", 3, k)[0] for k in range(len(GRAMMAR)) if list(GRAMMAR)[k] == "stage_jump"
    )
    right = judge(jump, answer(unnamed={"covariates": ["time"], "form": "true angle ~ a step at t = 9 s"}))
    assert right.covariate
    assert right.form
    assert right.exact
    wrong = judge(jump, answer("thermal_lag", unnamed={"covariates": ["supply_v"], "form": "line"}))
    assert wrong.wrong == ("thermal_lag",)
    assert not wrong.covariate
    both = judge(jump, answer(unnamed={"covariates": ["time", "supply_v"], "form": ""}))
    assert not both.covariate


def test_leading_part_of_the_cause_is_no_wrong_name() -> None:
    index = list(GRAMMAR).index("temperature_knee")
    blind, _ = draw("uncatalogued", 3, index)
    with_knee = answer("bias_temperature", unnamed={"covariates": ["temperature_c"], "form": "knee"})
    assert judge(blind, with_knee).exact


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("temperature_c", "temperature"),
        ("previous_angle_rad", "previous"),
        ("angle_deg", "angle"),
        ("t", "time"),
        ("supply_v", "supply"),
        ("reading", "reading"),
        ("approach", "approach"),
    ],
)
def test_covariates_are_known_by_their_names(word: str, meant: str) -> None:
    assert covariate(word) == meant


def test_a_tracer_that_raises_is_reported_with_its_session() -> None:
    verdict = blind_rounds.judge_answer({"failure": "broken", "seconds": 0.1}, "none", 3, 0)
    assert verdict.failure.startswith("none 3/0 ")
    assert verdict.failure.endswith("broken")
    assert verdict.wrong
    assert not verdict.exact
