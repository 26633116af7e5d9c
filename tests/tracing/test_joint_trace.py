"""Several sessions as one model: stacking, effects of groups of sessions, findings and their owners."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import load_session
from adis_gonio.base.arrays import central_differences
from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.trace_commands import print_trace
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.effects import effect
from adis_gonio.model.effects.base import lagged
from adis_gonio.model.measurement import FreeAttitude, JointMeasurement, PlanarTurn, SessionOrigin
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing import joint_trace
from adis_gonio.tracing.joint_trace import (
    JointResult,
    JointRun,
    owner_of,
    stack,
    trace_sessions,
    trace_stacked,
)
from adis_gonio.tracing.linear_problem import Products, amplitudes, linearise, span
from adis_gonio.tracing.model_search import Climb, Search
from adis_gonio.tracing.named_candidates import named_terms, sharings, split_effect
from adis_gonio.tracing.trace import trace_readings
from recordings import recording
from tracing.joint_fleets import U_MG, draw_fleet, draw_part, draw_session, origins
from tracing.small_problems import labelled, names_only


@pytest.mark.parametrize("model", [PlanarTurn, FreeAttitude])
@pytest.mark.parametrize("parts", ["aaa", "aab", "abc"])
def test_joint_measurement_is_that_of_each_session(model, parts) -> None:
    rng = np.random.default_rng(1)
    session = np.repeat([0, 1, 2], [4, 5, 6])
    joint = JointMeasurement(
        [model(1000.0), model(1000.0), model(1001.0)],
        [SessionOrigin(f"s{k}", p) for k, p in enumerate(parts)],
        session,
    )
    base = joint.nominal + 0.02 * rng.normal(size=len(joint.nominal))
    unit = rng.normal(size=(15, 3))
    attitude = 0.1 * unit[:, 0] if joint.planar else unit / np.linalg.norm(unit, axis=1, keepdims=True)
    turn = rng.uniform(0, 6, 15) if joint.planar else np.zeros(15)
    ideal = joint.ideal(base, attitude, turn)
    for k, (own, numbers) in enumerate(joint.sessions):
        rows = session == k
        at = base[numbers], attitude[rows], turn[rows]
        np.testing.assert_allclose(ideal[rows], own.ideal(*at))
        np.testing.assert_allclose(joint.tangent(base, attitude, turn)[rows], own.tangent(*at))
        np.testing.assert_allclose(joint.calibrated(base, ideal)[rows], own.calibrated(at[0], ideal[rows]))
    slopes = central_differences(lambda b: joint.ideal(b, attitude, turn), base, np.full(len(base), 1e-6))
    np.testing.assert_allclose(joint.columns(base, attitude, turn), slopes, atol=1e-5)
    # A start angle is the session's, everything else the part's.
    assert len(joint.parameters) == 3 * joint.planar + len(set(parts)) * (3 if joint.planar else 6)


def test_a_lag_does_not_reach_into_the_next_session() -> None:
    rng = np.random.default_rng(2)
    each = [draw_session(rng, draw_part(rng)) for _ in range(2)]
    times = np.linspace(0, 1500, 40)
    histories = [(times, 25 + k + np.sin(times / 300 + k)) for k in range(2)]
    each = [
        replace(one, conditions=replace(one.conditions, temperature_history=history))
        for one, history in zip(each, histories, strict=True)
    ]
    joint = stack(each, origins(2)).conditions.late("temperature_history", None, 200.0)[0]
    own = [lagged(*h, one.conditions.time_s, 200.0)[0] for one, h in zip(each, histories, strict=True)]
    np.testing.assert_allclose(joint, np.concatenate(own), atol=1e-4)


@pytest.mark.parametrize(
    ("name", "values"),
    [("warm_up", (3.0, -2.0, 1.0, 5.0, 400.0)), ("stage_eccentricity", (0.1, 0.2, -0.1, 0.3))],
)
def test_a_split_effect_acts_in_each_group_with_its_own_amplitudes(name, values) -> None:
    rng = np.random.default_rng(3)
    data = stack([draw_session(rng, draw_part(rng)) for _ in range(3)], origins(3, 2))
    (by_part, by_session) = sharings(data.model.origins)
    assert (by_part.group, by_session.group) == ((0, 1, 0), (0, 1, 2))
    whole = effect(name)
    split, at = split_effect(whole, by_part), np.array(values)
    shapes = at[4:]
    of = "attitude_rad" if whole.enters == "attitude" else "reading"
    arguments = (data.conditions,) if of == "attitude_rad" else (data.mean, data.conditions)
    found = getattr(split, of)(at, *arguments)
    for group, rows in enumerate((np.isin(data.conditions.session, (0, 2)), data.conditions.session == 1)):
        own = getattr(whole, of)(np.array([*at[2 * group : 2 * group + 2], *shapes]), *arguments)
        np.testing.assert_allclose(found[rows], own[rows])
    step = 1e-4 * np.maximum(np.abs(at), 1e-2)
    slopes = central_differences(lambda v: getattr(split, of)(v, *arguments), at, step)
    np.testing.assert_allclose(split.derivative(at, data.mean, data.conditions), slopes, atol=1e-6)
    assert [one.name for one in split.parameters][:2] == [
        f"{one.name}@part0" for one in whole.parameters[:2]
    ]


def test_whitened_rows_of_a_stack_are_those_of_its_sessions() -> None:
    rng = np.random.default_rng(4)
    each = [draw_session(rng, draw_part(rng)) for _ in range(2)]
    each = [replace(one, slow=rng.normal(size=(len(one), 2, 3))) for one in each]
    joint = Fit.begin(stack(each, origins(2, 2)))
    own = [Fit.begin(one) for one in each]
    np.testing.assert_allclose(joint.residual, np.concatenate([fit.residual for fit in own]), rtol=1e-6)


def test_one_session_is_its_own_stack() -> None:
    rng = np.random.default_rng(5)
    one = draw_session(rng, draw_part(rng))
    assert stack([one], origins(1)) is one


def test_a_session_of_samples_and_one_of_averaged_readings_are_joined() -> None:
    rng = np.random.default_rng(5)
    one, two = (draw_session(rng, draw_part(rng)) for _ in range(2))
    parts = {"quantization": np.ones((len(one), 2)), "flicker": np.ones((len(one), 2))}
    for each in ([replace(one, **parts), two], [two, replace(one, **parts)]):
        joint = stack(each, origins(2)).training
        assert len(joint) == len(one) + len(two)
        assert (joint.quantization, joint.flicker) == (None, None)


def test_sessions_of_two_kinds_are_refused() -> None:
    rng = np.random.default_rng(6)
    one, two = (draw_session(rng, draw_part(rng)) for _ in range(2))
    with pytest.raises(UsageError, match="s1: a joint trace cannot join different uncertainties"):
        stack([one, replace(two, fixture_rad=1.0)], origins(2))
    with pytest.raises(UsageError, match="s1: a joint trace cannot join readings with and without a known"):
        stack([one, replace(two, noise_known=False)], origins(2))
    with pytest.raises(UsageError, match="two sessions or more"):
        trace_sessions([])


def names(result: JointResult) -> set[str]:
    return {finding.effect for finding in result.found}


def curved(sizes: Sequence[float], parts: int) -> list[Readings]:
    """Sessions of parts in turn, each with its own curvature of x in mg/g²."""
    rng = np.random.default_rng(10)
    made = [draw_part(rng) for _ in range(parts)]
    return [
        draw_session(rng, made[k % parts], [(effect("quadratic", ("x",)), [size])])
        for k, size in enumerate(sizes)
    ]


def of_few_candidates(readings: list[Readings], where: list[SessionOrigin], *names: str) -> JointResult:
    """The joint trace with these candidates alone, each with all owners."""
    run = JointRun(stack(readings, where), 4)
    run.terms = [term for term in run.terms if term.label.split("@")[0] in names]
    return run.traced()


def test_each_cause_has_an_owner_and_each_session_its_share_and_its_errors() -> None:
    sizes = (3.0, -2.0, 1.0)
    readings = curved(sizes, 3)
    result = of_few_candidates(readings, origins(3, 3), "bias[xy]", "quadratic[x]")
    assert names(result) == {"bias", "quadratic"}
    assert {cause: max(own, key=own.__getitem__) for cause, own in result.owners.items()} == {
        "bias": "part", "quadratic": "part",
    }  # fmt: skip
    assert [(one.session, one.part, one.stage, one.dwells) for one in result.sessions] == [
        (f"s{k}", f"part{k}", "stage0", 24) for k in range(3)
    ]
    # The curvature of each part improves the likelihood of its own session as if it were alone.
    for one, data in zip(result.sessions, readings, strict=True):
        fit = Fit.begin(data).refit()
        terms = labelled(data, "bias[xy]", "quadratic[x]")
        zeros = [np.zeros(len(term.amplitudes)) for term in terms]
        chi2 = [fit.with_terms(terms[:n], zeros[:n]).refit().chi2 for n in (1, 2)]
        assert one.evidence["quadratic"] == pytest.approx((chi2[0] - chi2[1]) / 2, rel=0.1)
        assert one.alone["quadratic"] > 0.9
        # Within a dwell or two of the noise, left out by dwells or as a whole.
        assert 0.5 * U_MG < one.heldout_after_mg < 2 * U_MG
        assert 0.5 * U_MG < one.session_after_mg < 2 * U_MG
        assert min(one.heldout_before_mg, one.session_before_mg) > 10 * U_MG
    assert any("3 sessions of 3 parts on 1 stage" in note for note in result.notes)
    assert result.advice == ()
    with pytest.raises(FitError, match="one session of the part"):
        result.calibration()


def test_a_curvature_of_one_part_is_the_parts_and_predicts_a_session_left_out() -> None:
    result = of_few_candidates(curved((2.0, 2.0, 2.0), 1), origins(3), "bias[xy]", "quadratic[x]")
    assert result.owners["quadratic"]["part"] > 0.9
    assert all(one.session_after_mg < 0.1 * one.session_before_mg for one in result.sessions)


def test_a_session_left_out_is_predicted_by_all_others_and_by_no_other_sessions_alone() -> None:
    data = stack(curved((2.0, 2.0, 50.0), 1), origins(3))
    terms = labelled(data, "bias[xy]", "quadratic[x]")
    fit = Fit.begin(data).refit().with_terms(terms, [np.zeros(2), np.zeros(1)]).refit()
    left = joint_trace.left_out_sessions(fit)
    sizes = np.sqrt((left**2).sum(axis=1).reshape(3, -1).mean(axis=1))
    # The others have a mean curvature of 26, 26 and 2 mg/g²: they miss 24, 24 and 48.
    assert sizes / sizes[0] == pytest.approx([1, 1, 2], rel=0.1)


@pytest.mark.parametrize(
    ("label", "owners"),
    [
        ("quadratic[x]", ("part", "all parts")),
        ("quadratic[x]@part", ("part", "part")),
        ("quadratic[x]@session", ("session", "session")),
        ("stage_ellipticity", ("stage", "stage")),
    ],
)
def test_a_term_belongs_to_its_groups_or_to_what_its_effect_is_of(label, owners) -> None:
    data = stack(curved((0.0,) * 4, 2), origins(4, 2))
    (term,) = labelled(data, label)
    assert tuple(owner_of(term, several=several) for several in (False, True)) == owners


def test_the_candidates_that_are_kept_are_the_best_of_each_effect_and_every_bias(monkeypatch) -> None:
    data = stack(curved((3.0, -2.0, 1.0), 3), origins(3, 3))
    terms = named_terms(data)[0]
    monkeypatch.setattr(joint_trace.limits, "screened", 5)
    kept = {term.label for term in joint_trace.screen(data, terms, 4)}
    assert "quadratic[x]@part" in kept
    assert {term.label for term in terms if term.constant} <= kept
    assert {term.name for term in terms if term.label in kept} > {"cubic", "asymmetry", "stage_ellipticity"}
    assert len(kept) < len(terms) / 2


def test_sessions_together_find_an_effect_that_none_finds_alone() -> None:
    weak = [(effect("backlash"), [0.03])]
    readings, where = draw_fleet(np.random.default_rng(7), 8, present=weak)
    alone = [{finding.effect for finding in trace_readings(one).found} for one in readings[1::2]]
    result = trace_stacked(readings, where)
    assert sum("backlash" in found for found in alone) <= 1
    assert names(result) == {"bias", "backlash"}
    found = next(finding for finding in result.found if finding.effect == "backlash").parameters["backlash"]
    assert abs(found.value - 0.03) < 3.5 * found.u
    # All sessions carry the evidence, and each stands with its own verdict.
    evidence = np.array([one.evidence["backlash"] for one in result.sessions])
    assert evidence.sum() > 10
    assert evidence.max() < 0.5 * evidence.sum()
    assert {one.session for one in result.sessions} == {f"s{k}" for k in range(8)}
    # Leaving a session out costs little: the model of the others is true for it.
    assert all(one.session_after_mg < 0.05 * one.session_before_mg for one in result.sessions)


def test_sessions_without_an_effect_show_none() -> None:
    readings, where = draw_fleet(np.random.default_rng(8), 6, parts=3)
    result = trace_stacked(readings, where)
    assert names(result) == {"bias"}
    assert result.adequate


def test_gains_cover_the_error_by_a_cubic_too_weak_to_be_found(monkeypatch) -> None:
    """Six sessions know the gain of y to 0.004 %, and the cubic moves it by seven times that."""
    rng = np.random.default_rng(23)
    part = draw_part(rng)
    readings = [draw_session(rng, part, [(effect("cubic", ("y",)), [0.35])]) for _ in range(6)]

    def off() -> float:
        result = trace_stacked(readings, origins(6))
        assert names(result) == {"bias"}
        return abs(result.base["scale_y"].value - part[0][1]) / result.base["scale_y"].U

    assert off() < 1
    monkeypatch.setattr(
        "adis_gonio.tracing.findings.missing_curvature",
        lambda fit, _: np.zeros((len(fit.values.parameters),) * 2),
    )
    assert off() > 2


def test_an_error_that_many_parts_show_on_one_stage_is_the_stages() -> None:
    """Alone, two cycles of the stage are a curvature of the part."""
    table = [(effect("stage_ellipticity"), [0.012, -0.008])]
    readings, where = draw_fleet(np.random.default_rng(9), 6, parts=6, present=table)
    result = trace_stacked(readings, where)
    assert "stage_ellipticity" in names(result)
    assert result.owners["stage_ellipticity"]["stage"] > 0.95


def test_a_curvature_of_each_part_is_the_parts() -> None:
    rng = np.random.default_rng(10)
    readings = [
        draw_session(rng, draw_part(rng), [(effect("quadratic"), rng.normal(0, 2, 2))]) for _ in range(6)
    ]
    result = trace_stacked(readings, origins(6, 6))
    assert "quadratic" in names(result)
    assert result.owners["quadratic"]["part"] > 0.95


def test_four_sessions_show_the_warm_up_that_one_calls_a_drift() -> None:
    """The zero of z decays by −0.94, −0.45, −0.17, −0.14 mg/min from session to session."""
    result = trace_sessions([load_session(recording(f"mimu4444/exp{k}_imu1")) for k in (6, 7, 8, 9)])
    assert names(result) == {"bias", "warm_up"}
    assert result.unnamed is None
    assert result.owners["warm_up"]["session"] > 0.9
    warm = next(finding for finding in result.found if finding.effect == "warm_up").parameters
    z = [next(warm[name].value for name in warm if name.startswith(f"warm_up_z@exp{k}")) for k in (6, 7, 8)]
    assert z[0] > z[1] > z[2] > 0
    first = result.sessions[0]
    # Alone, with a bias and without a course, its held-out error is 0.77 mg.
    assert first.heldout_after_mg < 0.77
    assert first.evidence["warm_up"] > max(one.evidence["warm_up"] for one in result.sessions[1:])


def test_a_line_that_moves_is_a_hidden_thermometer_of_three_sessions() -> None:
    """Sensor 4 has a line on x that creeps from 7.1 to 12.9 Hz through the sessions.

    Without the line as a covariate, the model of these sessions and another one (8) has χ² 6.0 per degree
    of freedom and an error of 0.58 mg in the first session if that is left out.
    """
    result = trace_sessions([load_session(recording(f"mimu4444/exp{k}_imu4")) for k in (6, 7, 9)])
    assert result.adequate
    assert result.unnamed is not None
    assert "line_frequency" in result.unnamed.covariates
    assert result.after.chi2_per_dof < 2
    assert result.sessions[0].session_after_mg < 0.3


def test_sessions_of_a_warm_sensor_show_nothing_more(capsys) -> None:
    sessions = [load_session(recording(f"mimu4444/exp{k}_imu1")) for k in (4, 5)]
    result = trace_sessions(sessions)
    assert names(result) == {"bias"}
    assert result.adequate
    print_trace(sessions, result)
    shown = capsys.readouterr().out
    assert "Belongs to" in shown
    assert "Evidence of each session" in shown


def test_the_command_traces_several_files_as_one_model(tmp_path, capsys) -> None:
    paths = [str(tmp_path / f"{name}.session") for name in ("one", "two")]
    for seed, path in enumerate(paths, 1):
        make = ("--plan", "tumble", "--positions", "4", "--dwell", "1", "--seed", str(seed), "-o", path)
        assert main(["simulate", *make]) == 0
    capsys.readouterr()
    assert main(["trace", *paths, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["session"] for one in document["sessions"]] == ["one", "two"]
    assert set(document["owners"]["bias"]) <= {"part", "session", "all parts", "stage"}
    assert main(["trace", *paths, "--time-limit", "0.01"]) == 0
    assert "The time limit of 0.01 s ended the trace" in capsys.readouterr().out
    assert main(["trace", *paths, "--sensor-part", "gyro"]) == 2
    whole = load_session(paths[1])
    checked = tuple(replace(dwell, use="check") for dwell in whole.dwells[1:])
    for dwells in (whole.dwells[:1], (whole.dwells[0], *checked)):
        with pytest.raises(FitError, match=r"two\.session: a joint trace needs two positions"):
            trace_sessions([load_session(paths[0]), replace(whole, dwells=dwells)])
    copy = tmp_path / "copy.session"
    copy.write_bytes((tmp_path / "one.session").read_bytes())
    capsys.readouterr()
    assert main(["trace", paths[0], str(copy)]) == 2
    assert "same samples" in capsys.readouterr().err


def test_no_two_sessions_share_a_name(monkeypatch) -> None:
    monkeypatch.setattr(joint_trace, "reduced", lambda session: session)
    monkeypatch.setattr(joint_trace, "trace_stacked", lambda readings, origins, most: origins)
    sessions = [
        Session((), source=f"{name}.session", title=str(k)) for k, name in enumerate(("a/t", "b/t", "t-1"))
    ]
    monkeypatch.setattr(joint_trace, "digest_of", lambda session: session.title)
    assert [one.label for one in trace_sessions(sessions)] == ["t-1", "t-2", "t-1-3"]


@pytest.mark.parametrize(("parts", "stages"), [(1, 1), (3, 1), (7, 2)])
def test_columns_by_session_give_what_columns_over_all_rows_give(parts, stages) -> None:
    """Sessions of unequal length, of parts with one session and with several."""
    rng = np.random.default_rng(14)
    each = [draw_session(rng, draw_part(rng), [(effect("quadratic", ("x",)), [1.5])]) for _ in range(7)]
    each = [one.rows(np.arange(24) < 24 - 2 * k) for k, one in enumerate(each)]
    data = stack(each, origins(7, parts, stages))
    fit = Fit.begin(data).refit()
    terms = [term for term in named_terms(data)[0] if len(term.effect.parameters) < 24][::3]
    problem = linearise(fit, terms).with_inflation(1.7)
    dense = problem.dense
    own = np.arange(len(problem.terms)) >= len(problem.shared.width)
    assert 5 < own.sum() < len(own) - 5
    assert not dense.split
    some = [int(k) for k in np.flatnonzero(own)[[0, 5]]], [int(np.flatnonzero(~own)[7])]
    for model in ((), some[1], some[0][:1], [*some[1], *some[0]]):
        chi2, rank, gains = Products(problem, problem).extensions(model)
        outside = ~np.isin(np.arange(len(own)), model)
        old = Products(dense, dense).extensions(model)
        assert chi2 == pytest.approx(old[0])
        assert rank == old[1]
        np.testing.assert_allclose(gains[outside], old[2][outside], rtol=1e-5, atol=1e-5)
        assert problem.gain(model) == pytest.approx(dense.gain(model))
        for ours, theirs in zip(amplitudes(problem, model), amplitudes(dense, model), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(problem.off(model, problem.target), span(dense, model)[1], atol=1e-8)
        basis, residual = span(problem, model)
        ours, theirs = (one.gains(basis, residual)[outside] for one in (problem, dense))
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


def test_a_free_turn_among_the_sessions_is_named_with_the_remedy() -> None:
    rest = Dwell(position=0, time_s=np.arange(5.0), accel=np.ones((5, 2)), angle_deg=None)
    free = Session(dwells=(), recording=rest, free_turn=True, source="turn.csv", accel_unit="mg")
    with pytest.raises(DataError, match=r"^turn\.csv: a free turn has no positions; use fit"):
        trace_sessions([free, replace(free, recording=replace(rest, accel=np.zeros((5, 2))))])


def test_a_less_exact_score_of_a_model_replaces_no_other() -> None:
    """The ridge of a gain lowers it if a bias of each session is nearly the bias of all that is added."""
    found = Search(replace(names_only("quadratic", "cubic"), joint=True), np.zeros(2))
    found.promise = np.full(2, -np.inf)
    climb = Climb(found, 1, 2, 1)
    for score in (5.0, 3.0):
        climb._keep((), np.array([[0]]), np.array([score]))
    assert found.scores[0,] == 5.0


def test_columns_by_session_are_those_of_each_session() -> None:
    """The gain of a term with amplitudes by session is the sum of the gains of sessions of other parts."""
    rng = np.random.default_rng(15)
    each = [draw_session(rng, draw_part(rng), [(effect("quadratic", ("x",)), [1.5])]) for _ in range(3)]
    data = stack(each, origins(3, 3))
    problem = linearise(Fit.begin(data).refit(), named_terms(data)[0])
    alone = [linearise(Fit.begin(one).refit(), named_terms(one)[0]) for one in each]
    gains = [{term.label: one.gain((k,)) for k, term in enumerate(one.terms)} for one in alone]
    numbers = {term.label: k for k, term in enumerate(problem.terms)}
    checked = [name for name in gains[0] if f"{name}@part" in numbers and "<" not in name]
    assert len(checked) > 5
    for name in checked:
        whole = sum(one[name] for one in gains)
        assert problem.gain((numbers[f"{name}@part"],)) == pytest.approx(whole, rel=1e-2, abs=1e-2)
