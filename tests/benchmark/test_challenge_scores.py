"""Oracle, scoring, contract and runners of the blind residual challenge."""

import hashlib
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from blind_residual import __main__ as program, answers, harness, leaderboard, oracle, scoring
from blind_residual.generator import Truth, draw
from blind_residual.likelihood import Whitened
from blind_residual.runners import adis_gonio, runner
from blind_residual.runners.common import Prepared
from blind_residual.runners.susie import susie


def answer(**keys: object) -> dict:
    return answers.checked(answers.empty() | keys)


def cause(*names: str, p: float = 0.99) -> dict:
    return {"names": list(names), "probability": [p, *[(1 - p) / 2] * (len(names) - 1)]}


@pytest.fixture(scope="module")
def catalogued() -> Truth:
    return replace(
        draw("score", 0, "catalogue")[1], names=["cubic"], kind="cubic", gain=[42.0],
        parameters={"k3_x": 2.0}, base={"delta_k": 0.01, "bias_x": 5.0},
    )  # fmt: skip


# Oracle


@pytest.fixture(scope="module")
def quiet() -> list[tuple[Truth, dict]]:
    """Sessions that hide nothing, and what the oracle says."""
    truths = [draw("quiet", k, "nothing")[1] for k in range(24)]
    return [(truth, answers.checked(oracle.answer(truth))) for truth in truths]


def _clear(family: str, draws: int, least: float) -> list[tuple[Truth, dict]]:
    truths = [draw(f"oracle {family}", k, family)[1] for k in range(draws)]
    return [(truth, answers.checked(oracle.answer(truth))) for truth in truths if min(truth.gain) > least]


def test_the_oracle_finds_what_it_should_where_the_gain_is_high():
    told = _clear("catalogue", 30, 50)
    assert len(told) >= 6
    assert np.mean([scoring.score(t, a)["right_set"] for t, a in told]) >= 0.85


def test_the_oracle_claims_nothing_where_nothing_is(quiet):
    assert sum(bool(a["causes"]) for _, a in quiet) <= 1


def test_the_oracle_gives_a_stranger_that_it_knows_no_name():
    told = _clear("stranger", 24, 40)
    assert len(told) >= 5
    assert np.mean([scoring.score(t, a)["covariate"] for t, a in told]) >= 0.7


def test_the_oracle_holds_the_true_base_parameters_in_its_intervals(quiet):
    z = [v for t, a in quiet for v in scoring.score(t, a)["base_z"].values()]
    held, of, rms = scoring.coverage(z)
    assert held / of > 0.88
    assert 0.7 < rms < 1.35


def test_what_the_oracle_leaves_is_the_noise_and_the_fixture_that_it_knows(quiet):
    left = [Whitened(t.problem()) for t, _ in quiet]
    chi2, dof = sum(float(w.left @ w.left) for w in left), sum(w.dof for w in left)
    assert dof > 600
    assert abs(chi2 / dof - 1) < 4 * np.sqrt(2 / dof)


# Scores


def test_wilson_agrees_with_published_values():
    assert scoring.wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert scoring.wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert scoring.wilson(0, 0) == (0.0, 1.0)


def test_rungs_of_the_ladder_by_the_smallest_gain():
    rungs = [scoring.gain_bin(g) for g in ([], [3.9], [4.0], [15.9], [200.0, 20.0], [100.0])]
    assert rungs == ["-", "<4", "4-10", "10-16", "16-30", ">100"]


@pytest.mark.parametrize(
    ("causes", "top", "held", "wrong", "sure"),
    [
        ([cause("cubic")], 1, 1, False, False),
        ([cause("stage_ellipticity", "cubic", p=0.6)], 0, 1, False, False),
        ([cause("quadratic")], 0, 0, True, True),
        ([cause("quadratic", p=0.8)], 0, 0, True, False),
        ([cause("cubic"), cause("backlash", p=0.7)], 1, 1, True, False),
        ([cause("bias")], 0, 0, False, False),
        ([], 0, 0, False, False),
    ],
)
def test_a_catalogued_effect_is_scored_by_hand(catalogued, causes, top, held, wrong, sure):
    record = scoring.score(catalogued, answer(causes=causes))
    got = record["right_top"], record["right_set"], record["wrong"], record["wrong_confident"]
    assert got == (top, held, wrong, sure)
    assert record["bin"] == "30-50"


def test_intervals_are_judged_in_standard_uncertainties(catalogued):
    said = cause("cubic") | {"parameters": {"k3_x": {"value": 2.6, "u": 0.2}}}
    record = scoring.score(
        catalogued, answer(causes=[said], base={"delta_k": {"value": 0.011, "u": 0.0005}})
    )
    assert record["amplitude_z"] == {"k3_x": pytest.approx(3.0)}
    assert record["base_z"] == {"delta_k": pytest.approx(2.0)}
    assert scoring.coverage([1.0, -1.9, 2.0, 3.0]) == (
        2,
        4,
        pytest.approx(math.sqrt((1 + 3.61 + 4 + 9) / 4)),
    )


def test_a_stranger_wants_every_group_of_covariates_and_no_name(catalogued):
    truth = replace(catalogued, family="stranger", names=[], covariates=[["angle"], ["order", "time"]])
    both = scoring.score(truth, answer(covariates=["time", "angle"]))
    one = scoring.score(truth, answer(covariates=["angle"]))
    named = scoring.score(truth, answer(covariates=["time", "angle"], causes=[cause("backlash")]))
    assert (both["covariate"], one["covariate"], named["covariate"]) == (True, False, False)
    assert (both["wrong"], one["covariate_some"], named["wrong_confident"]) == (False, True, True)


def test_a_name_that_the_catalogue_has_had_since_is_right_and_not_asked_for(catalogued):
    truth = replace(catalogued, family="foreign", names=[], covariates=[["time"]], since=["scale_drift"])
    named = scoring.score(truth, answer(causes=[cause("scale_drift")]))
    nameless = scoring.score(truth, answer(covariates=["time"]))
    wrong = scoring.score(truth, answer(causes=[cause("scale_drift"), cause("cubic")]))
    assert (named["covariate"], nameless["covariate"], wrong["covariate"]) == (True, True, False)
    assert (named["wrong"], nameless["wrong"], wrong["wrong_names"]) == (False, False, ["cubic"])
    assert "right_set" not in nameless


def test_scatter_is_right_by_its_own_name_and_fabricated_by_any_other(catalogued):
    truth = replace(catalogued, family="scatter", names=[], scatter=True)
    good = scoring.score(truth, answer(causes=[cause("reading_scatter")]))
    bad = scoring.score(truth, answer(covariates=["temperature"]))
    assert (good["fabricated"], good["wrong"], good["scatter_named"]) == (False, False, True)
    assert bad["fabricated"]
    walk = replace(truth, covariates=[["order", "time"]])
    assert not scoring.score(walk, answer(covariates=["time"]))["fabricated"]
    assert scoring.score(walk, answer(covariates=["time"], causes=[cause("bias_drift")]))["fabricated"]


def test_nothing_hidden_makes_any_claim_but_the_bias_false(catalogued):
    truth = replace(catalogued, family="nothing", names=[], gain=[])
    assert not scoring.score(truth, answer(causes=[cause("bias")]))["false"]
    assert scoring.score(truth, answer(causes=[cause("cubic")]))["false"]
    assert scoring.score(truth, answer(covariates=["time"]))["false"]


def test_brier_log_score_and_reliability_by_hand():
    pairs = [(0.9, True), (0.9, False), (0.2, False)]
    assert scoring.brier(pairs) == pytest.approx((0.01 + 0.81 + 0.04) / 3)
    assert scoring.log_score(pairs) == pytest.approx(-(math.log(0.9) + math.log(0.1) + math.log(0.8)) / 3)
    assert scoring.reliability(pairs) == [
        ("0-0.5", 1, pytest.approx(0.2), 0.0),
        ("0.9-0.95", 2, pytest.approx(0.9), 0.5),
    ]


def test_set_size_and_left_out_error_are_taken_over_the_oracles(catalogued):
    told = answer(causes=[cause("cubic", "asymmetry")], heldout={"heldout_rms_mg": 0.2})
    said = answer(
        causes=[cause("cubic", "asymmetry", "quadratic", "backlash")], heldout={"heldout_rms_mg": 0.3}
    )
    record = scoring.score(catalogued, said, told)
    assert (record["set_size"], record["oracle_set_size"]) == (4, 2)
    assert record["heldout_ratio"] == pytest.approx(1.5)


def test_predictions_are_scored_at_the_attitude_within_the_tolerance():
    truth = replace(draw("heldout", 2, "nothing")[1], fixture_deg=0.05)
    assert truth.plane
    linear = truth.problem()
    measured = np.array(truth.readings_mg)
    checks = np.flatnonzero(linear.c.check)

    def rms(shift: np.ndarray) -> float:
        cells = {str(k): dict(zip(("ax", "ay"), measured[k] - shift[k], strict=True)) for k in checks}
        return harness.heldout_of(truth, cells)["heldout_rms_mg"]

    turned = (linear.tangent @ np.full(linear.c.n, np.radians(truth.fixture_deg))).reshape(2, -1).T
    radial = linear.ideal_g * np.sqrt(np.mean(turned**2) / np.mean(linear.ideal_g**2))
    assert rms(np.zeros_like(measured)) == 0
    assert rms(radial) == pytest.approx(np.sqrt(np.mean(radial[checks] ** 2)), rel=0.02)
    noise = (
        np.diag(linear.covariance).reshape(2, -1).T
        - np.radians(truth.fixture_deg) ** 2 * linear.tangent.sum(axis=1).reshape(2, -1).T ** 2
    )
    share = noise / (
        noise + np.sum(turned**2, axis=1)[:, None]
    )  # what is left of a turn within the tolerance
    assert share.max() < 0.6
    assert rms(turned) == pytest.approx(np.sqrt(np.mean((share * turned)[checks] ** 2)), rel=0.05)


# Contract


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        ([], "one JSON object"),
        ({"sure": 1}, "unknown key 'sure'"),
        ({"something": 1.2}, "from 0 to 1"),
        ({"causes": [{"names": []}]}, r"causes\[0\].names"),
        ({"causes": [{"names": ["cubic"], "probability": []}]}, "one number from 0 to 1 a name"),
        ({"base": {"delta_k": {"value": float("nan"), "u": 1}}}, "base.delta_k"),
        ({"base": {"delta_k": {"value": 1, "u": -1}}}, "u not below 0"),
        ({"covariates": "time"}, "list of words"),
    ],
)
def test_an_answer_that_breaks_the_contract_gets_one_clear_line(bad, word):
    with pytest.raises(answers.AnswerError, match=word) as caught:
        answers.checked(bad, "s00001")
    assert "\n" not in str(caught.value)


@pytest.fixture
def work(tmp_path: Path) -> Path:
    for k, family in enumerate(("nothing", "catalogue")):
        harness.make("work", 1, tmp_path / "sessions", tmp_path / "truths", k, family)
    return tmp_path


def _program(folder: Path, text: str) -> str:
    path = folder / "entrant.py"
    path.write_text(text, encoding="utf-8")
    return f"{sys.executable} {path}"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("import sys; sys.exit('no idea')", "status 1: no idea"),
        ("pass", "wrote no such file"),
        ("import sys,pathlib; pathlib.Path(sys.argv[1],'answer.json').write_text('{')", "no JSON"),
        (
            "import sys,pathlib; pathlib.Path(sys.argv[1],'answer.json').write_text('{\"sure\": 1}')",
            "unknown key",
        ),
    ],
)
def test_a_program_that_fails_is_one_line_and_an_empty_answer(work, text, word):
    lines: list[str] = []
    bad = harness.run(
        work / "sessions", work / "truths", work / "a.jsonl", "x", _program(work, text), lines.append
    )
    assert bad == len(lines) == 2
    assert all(word in line and "\n" not in line for line in lines)
    rows = [json.loads(line) for line in (work / "a.jsonl").read_text("utf-8").splitlines()]
    assert [row["answer"]["causes"] for row in rows] == [[], []]


def test_a_program_that_is_not_there_ends_the_run_with_one_line(work, capsys):
    (work / "answers").mkdir()
    status = program.main(["run", "x", "--program", "no-such-program-here", "--work", str(work)])
    assert (status, capsys.readouterr().err) == (
        1,
        "blind_residual: no-such-program-here: no such program\n",
    )
    assert not (work / "answers" / "x.jsonl").exists()


def test_a_runner_sees_one_file_and_no_reading_of_a_check_dwell(work):
    text = (
        "import json,sys,pathlib\n"
        "here = pathlib.Path(sys.argv[1])\n"
        "assert [p.name for p in here.iterdir()] == ['session.csv']\n"
        "rows = [r.split(',') for r in (here/'session.csv').read_text().splitlines() if r[0] != '#']\n"
        "use = rows[0].index('use'); axes = [rows[0].index(a) for a in ('ax','ay','az') if a in rows[0]]\n"
        "checks = [r for r in rows if r[use] == 'check']\n"
        "assert checks and all(any(r[i] == '' for i in axes) for r in checks)\n"
        "(here/'answer.json').write_text(json.dumps({'something': 0.5}))\n"
    )
    assert harness.run(work / "sessions", work / "truths", work / "a.jsonl", "x", _program(work, text)) == 0


def test_what_was_answered_is_not_asked_again(work):
    harness.run(work / "sessions", work / "truths", work / "a.jsonl", "oracle")
    before = (work / "a.jsonl").read_text("utf-8")
    harness.run(work / "sessions", work / "truths", work / "a.jsonl", "oracle")
    assert (work / "a.jsonl").read_text("utf-8") == before


def test_truth_is_not_written_where_runners_run(tmp_path: Path, capsys):
    with pytest.raises(harness.ChallengeError, match="must not lie within"):
        harness.make("x", 1, tmp_path, tmp_path / "truths")
    assert program.main(["run", "nobody", "--work", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


# Runners


def test_simple_runners_answer_and_predict_hidden_cells(work):
    for path in sorted((work / "truths").glob("*.json")):
        truth = Truth.load(path)
        folder = work / truth.id
        folder.mkdir()
        (folder / "session.csv").write_text(
            harness.blind((work / "sessions" / truth.id / "session.csv").read_text("utf-8")),
            encoding="utf-8",
        )
        for name in ("stepwise", "susie"):
            said = answers.checked(runner(name)(folder))
            left = harness.heldout_of(truth, said["heldout"])["heldout_rms_mg"]
            best = oracle.answer(truth)["heldout"]["heldout_rms_mg"]
            assert left < 3 * best + 0.5


def test_a_large_effect_is_named_by_the_simple_runners(tmp_path: Path):
    found = 0
    chosen = [(c, t) for c, t in (draw("big", k, "catalogue") for k in range(14)) if min(t.gain) > 60][:5]
    for csv, truth in chosen:
        (tmp_path / "session.csv").write_text(harness.blind(csv), encoding="utf-8")
        found += scoring.score(truth, answers.checked(runner("susie")(tmp_path)))["right_set"] == 1
    assert found >= len(chosen) - 2


def test_susie_puts_its_weight_on_the_true_columns():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(80, 30))
    x /= np.linalg.norm(x, axis=0)
    y = 9 * x[:, 3] - 8 * x[:, 17] + rng.normal(size=80)
    alpha, factors = susie(x, y, np.full(30, 1 / 30))
    best = {int(np.argmax(alpha[j])) for j in range(len(alpha)) if factors[j] > 3}
    assert best == {3, 17}


def test_hidden_cells_in_space_are_solved_from_the_length_of_the_reading(tmp_path: Path):
    csv, truth = next((c, t) for c, t in (draw("space", k, "nothing") for k in range(40)) if not t.plane)
    (tmp_path / "session.csv").write_text(harness.blind(csv), encoding="utf-8")
    prepared = Prepared(tmp_path)
    hidden = np.argwhere(prepared.hidden)
    assert len(hidden) == sum(truth.circumstances["check"])
    error = [prepared.filled[k, i] - truth.readings_mg[k][i] for k, i in hidden]
    assert np.abs(error).max() < 12  # a bias of tens of mg was not known


def test_the_trace_is_brought_into_an_answer():
    error = {"heldout_rms_mg": 0.2}
    trace = {
        "found": [
            {"effect": "quadratic", "probability": 0.9, "parameters": {"k2_x": {"value": 3.0, "u": 0.1}}},
            {"effect": "bias", "probability": 1.0, "parameters": {"bias_x": {"value": 9.0, "u": 0.1}}},
        ],
        "sets": [
            {"names": ["quadratic", "asymmetry", "unnamed: reading"], "probability": [0.6, 0.3, 0.06]},
            {"names": ["bias"], "probability": [1.0]},
            {"names": ["unnamed: angle and time", "cubic"], "probability": [0.7, 0.26]},
        ],
        "confounded": [["quadratic", "asymmetry"]],
        "unnamed": {"covariates": ["time"], "probability": 0.7},
        "error": {"after": error},
        "rivals": [{"terms": ["bias[xy]"], "probability": 0.1},
                   {"terms": ["quadratic[x]", "bias[xy]"], "probability": 0.9}],
        "base": {"scale_x": {"value": 1.01, "u": 0.001}, "scale_y": {"value": 1.0, "u": 0.001},
                 "delta_phi": {"value": 0.1, "u": 0.01}},
    }  # fmt: skip
    said = answers.checked(adis_gonio.from_trace(trace))
    cause, bias = said["causes"]
    assert bias["names"] == ["bias"]  # counts only where a bias is what was hidden
    assert cause["names"] == ["quadratic", "asymmetry"]
    assert cause["probability"] == [0.6, 0.3]
    assert cause["parameters"] == {"k2_x": {"value": 3.0, "u": 0.1}}
    assert said["something"] == pytest.approx(0.9)
    assert said["covariates"] == ["angle", "time"]
    assert said["base"]["bias_x"] == {"value": 9.0, "u": 0.1}
    assert said["base"]["delta_k"]["value"] == pytest.approx(0.01)
    assert said["heldout"] == error
    assert adis_gonio.from_trace(trace | {"adequate": False})["something"] == 0.99
    unsure = trace | {"found": [], "sets": [{"names": ["cubic", "quadratic"], "probability": [0.6, 0.36]}]}
    assert adis_gonio.from_trace(unsure)["causes"][0]["names"] == ["cubic", "quadratic"]


# Seal and board


def test_a_secret_is_checked_against_the_seal(capsys):
    sealed = (Path(program.__file__).parent / "SEAL").read_text("utf-8").strip()
    assert len(sealed) == 64
    assert int(sealed, 16)
    assert hashlib.sha256(b"train").hexdigest() != sealed
    assert program.main(["seal", "--secret", "train"]) == 1
    assert "not the sealed one" in capsys.readouterr().out


def test_the_leaderboard_holds_every_entrant_and_the_arithmetic(work):
    for name in ("oracle", "stepwise"):
        harness.run(work / "sessions", work / "truths", work / f"{name}.jsonl", name)
    board, lines = work / "board.md", work / "lines.jsonl"
    leaderboard.write(work / "truths", work, ["oracle", "stepwise"], board, lines)
    page = board.read_text("utf-8")
    assert "| oracle |" in page
    assert "| stepwise |" in page
    assert len(lines.read_text("utf-8").splitlines()) == 4
    assert leaderboard.percent([{"k": True}, {"k": False}, {}], "k") == "50 % (9–91 %), 1 of 2"
    with pytest.raises(harness.ChallengeError, match="run susie first"):
        leaderboard.write(work / "truths", work, ["susie"], board)
