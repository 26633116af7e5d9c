"""Which dwells are left out together, what is predicted of them, and which errors are said of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from adis_gonio.base.budget import Budget, within
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import MeanRate
from adis_gonio.tracing import validation
from adis_gonio.tracing.trace_result import ErrorFigures
from adis_gonio.tracing.validation import (
    Fold,
    HeldOut,
    cross_validate,
    error_figures,
    folds,
    guard_errors,
    nest_fits,
    predicted_dwells,
    without_folds,
)
from tracing.small_problems import G, biased, chosen, function, ideal_mg, labelled, noisy, read, turn

STEPS = np.arange(0, 360, 15.0)


def in_space(up: np.ndarray) -> Readings:
    """Still poses with gravity along these directions."""
    up = np.asarray(up, dtype=float) / np.linalg.norm(up, axis=1)[:, None]
    return from_means(
        G * up, np.tile(0.01 * np.eye(3), (len(up), 1, 1)), Conditions(60.0 * np.arange(len(up)))
    )


def gyros(n: int = 24) -> Readings:
    """Rates beside which no force was recorded, so that they have no pose."""
    c = Conditions(60.0 * np.arange(n), rate_dps=np.zeros((n, 3)))
    rates = np.random.default_rng(81).normal(size=(n, 3))
    return from_means(rates, np.tile(np.eye(3), (n, 1, 1)), c, measurement=MeanRate())


class TestDesigns:
    def in_blocks(self, data: Readings) -> bool:
        return "blocks of time" in folds(data)

    def test_blocks_of_time_are_left_out_where_others_stand_within_two_and_a_half_steps(self) -> None:
        assert not self.in_blocks(noisy(turn(angles_deg=STEPS), 81)), "a quarter of the turn would miss"
        there_and_back = [*STEPS, *STEPS[::-1]]
        assert self.in_blocks(noisy(turn(angles_deg=there_and_back), 81))
        # Of four dwells in a row the inner ones are two steps from the others, of five the middle is three.
        assert self.in_blocks(noisy(turn(16), 81))
        assert not self.in_blocks(noisy(turn(20), 81))

    def test_angles_count_round_the_turn_and_a_whole_turn_on_is_one_position(self) -> None:
        assert self.in_blocks(noisy(turn(angles_deg=[*STEPS, *(STEPS + 360)]), 81))

    @pytest.mark.parametrize(("dwells", "blocks"), [(7, False), (8, True)])
    def test_a_block_has_two_dwells_at_least(self, dwells: int, blocks: bool) -> None:
        data = noisy(turn(angles_deg=(90.0 * np.arange(dwells)) % 360), 81)
        assert self.in_blocks(data) == blocks

    def test_without_angles_or_poses_whole_dwells_alone_are_left_out(self) -> None:
        c = replace(turn(24), angle_rad=None)
        assert set(folds(read(c, noisy(turn(24), 81).mean))) == {"whole dwells"}
        assert set(folds(gyros())) == {"whole dwells"}

    def test_in_space_another_pose_within_45_degrees_stands_in(self) -> None:
        def tilted(deg: float) -> np.ndarray:
            # Two blocks of two dwells each end of x and y, then the same leaned towards z.
            lean = math.radians(deg)
            flat = np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]])
            return np.concatenate([flat, math.cos(lean) * flat + math.sin(lean) * np.array([0, 0, 1.0])])

        assert self.in_blocks(in_space(tilted(40.0)))
        assert not self.in_blocks(in_space(tilted(50.0)))

    def test_dwells_about_one_end_of_a_body_axis_are_one_group(self) -> None:
        data = noisy(turn(angles_deg=[*STEPS, *STEPS]), 82)
        psi = 3.0 - np.concatenate([STEPS, STEPS])
        quarter = np.round(psi / 90.0) % 4  # no angle is half-way between two
        told = {tuple(np.flatnonzero(mask)) for mask in validation.masks_about_axes(data)}
        assert told == {tuple(np.flatnonzero(quarter == k)) for k in range(4)}

    @pytest.mark.parametrize(("repeated", "groups"), [(5, 0), (8, 4)])
    def test_of_a_turn_half_of_the_dwells_must_stand_in_positions_that_repeat(
        self, repeated: int, groups: int
    ) -> None:
        # 16 positions and some of them again: 10 of 21, or 16 of 24. One of them is 359° and 1° apart.
        first = np.arange(16) * 22.5 - 0.75
        data = noisy(turn(angles_deg=[*first, *(first[:repeated] + 1.5 - 360)]), 82)
        assert len(validation.masks_about_axes(data)) == groups

    def test_poses_in_space_are_grouped_whether_they_repeat_or_not(self) -> None:
        up = [[9, 1, 1], [8, -2, 1], [-9, 1, 1], [1, 1, -9]]
        told = [
            np.flatnonzero(mask).tolist() for mask in validation.masks_about_axes(in_space(np.array(up)))
        ]
        assert sorted(told) == [[0, 1], [2], [3]]

    @pytest.mark.parametrize(("known", "kept"), [(3, False), (4, True)])
    def test_body_axes_are_left_out_where_the_others_predict_a_third_of_the_dwells(
        self, monkeypatch: pytest.MonkeyPatch, known: int, kept: bool
    ) -> None:
        monkeypatch.setattr(validation, "determined", lambda data, masks: np.arange(12) < known)
        poses = in_space(np.random.default_rng(83).normal(size=(12, 3)))
        assert ("body axes" in folds(poses)) == kept

    def test_of_gyros_dwells_that_were_turned_say_nothing_about_poses(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(validation, "determined", lambda data, *_: np.arange(24) < 16)
        turned = np.arange(24) % 2 == 0
        data = gyros()
        rate = np.outer(turned, [0.0, 0.0, 50.0])
        data = replace(data, conditions=replace(data.conditions, rate_dps=rate))
        designs = {"whole dwells": [turned], "body axes": [turned]}
        counts = predicted_dwells(data, designs, [])
        assert counts["whole dwells"].all()
        np.testing.assert_array_equal(counts["body axes"], ~turned & (np.arange(24) < 16))

    @pytest.mark.parametrize(("known", "kept"), [(3, False), (4, True)])
    def test_a_design_counts_where_a_third_of_its_dwells_are_predicted(
        self, monkeypatch: pytest.MonkeyPatch, known: int, kept: bool
    ) -> None:
        data = noisy(turn(12), 83)
        asked: list[int] = []

        def determined(data: Readings, masks: Any, beside: Sequence[Any]) -> np.ndarray:
            asked.append(len(beside))
            return np.arange(12) < known

        monkeypatch.setattr(validation, "determined", determined)
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        designs = {name: [np.arange(12) < 6] for name in ("whole dwells", "blocks of time", "body axes")}
        counts = predicted_dwells(data, designs, labelled(data, "bias[xy]"))
        # Blocks of time are asked about for functions without a name alone.
        assert counts["whole dwells"].all()
        assert counts["blocks of time"].all()
        assert asked == [0]
        counts = predicted_dwells(data, designs, [wave, *labelled(data, "bias[xy]")])
        assert asked == [0, 1, 1]
        assert counts["whole dwells"].all()
        assert ("blocks of time" in counts) == kept
        if kept:
            assert counts["blocks of time"].sum() == known


class TestLeavingOut:
    @pytest.mark.parametrize("where", ["bias", "angle"])
    def test_errors_are_of_what_the_model_says_of_dwells_that_were_left_out(self, where: str) -> None:
        # A line that rose from 0 to 1 over the fit goes down to −1 before it, in the readings or the angle.
        data = read(turn(41), ideal_mg(turn(41)))
        before = np.arange(41) < 20
        line = function("line", lambda c: c.time_s / 1200.0 - 1.0, where=where)

        def fit(rows: Readings) -> Fit:
            return Fit.begin(rows).with_terms([line], [np.array([10.0])])  # mg or mrad

        told = cross_validate(data, {"before": [before]}, fit)["before"].rows(before)
        held = np.arange(20) / 20 - 1
        psi = np.radians(3.0) - np.asarray(data.conditions.angle_rad)[before]
        if where == "bias":
            np.testing.assert_allclose(told.residual, np.outer(-10.0 * held, [1.0, 0.0]), atol=1e-6)
        else:
            turned = psi + 0.01 * held
            moved = np.column_stack([np.cos(psi) - np.cos(turned), np.sin(psi) - np.sin(turned)])
            np.testing.assert_allclose(told.residual, G * moved, atol=1e-6)
            np.testing.assert_allclose(told.angle_rad, 0.01 * held, atol=1e-6)

    def test_each_design_has_its_own_errors_of_all_dwells_and_progress_goes_on_over_all(self) -> None:
        data = noisy(turn(12), 85)
        half = np.arange(12) < 6
        third = np.arange(12) % 3 == 0
        rest = np.arange(12) % 3 == 1
        shares: list[float] = []

        def fit(rows: Readings) -> Fit:
            return Fit.begin(rows).refit()

        with within(Budget(share=shares.append)):
            told = cross_validate(
                data, {"halves": [half, ~half], "others": [third, ~third], "one": [rest]}, fit
            )
        assert shares == pytest.approx([0.0, 0.2, 0.4, 0.4, 0.6, 0.8, 0.8, 1.0])
        for name, mask in (("halves", half), ("others", third)):
            for own in (mask, ~mask):
                again = Fit.begin(data.rows(~own)).refit()
                start, scale_x, scale_y, lean = again.values.base
                assert data.conditions.angle_rad is not None
                psi = start - data.conditions.angle_rad[own]
                away = data.mean[own] - G * np.column_stack(
                    [scale_x * np.cos(psi), scale_y * np.sin(psi + lean)]
                )
                np.testing.assert_allclose(told[name].residual[own], away, atol=1e-6)
                turned = told[name].angle_rad
                assert turned is not None
                ahead = np.angle(np.exp(1j * turned[own]))
                tangent = np.column_stack([-np.sin(psi), np.cos(psi)])
                np.testing.assert_allclose(
                    np.abs(ahead), np.abs((away * tangent).sum(axis=1)) / G, rtol=0.05, atol=2e-6
                )

    def test_what_is_not_foreseen_without_a_fold_is_not_predicted(self) -> None:
        # Without every dwell but three there are six equations for the base model and a bias of two.
        data = noisy(turn(12), 85)
        few = np.arange(12) >= 3

        def fit(rows: Readings) -> Fit:
            biases = labelled(data, "bias[xy]")
            return Fit.begin(rows).with_terms(biases, [np.zeros(2)]).refit()

        told = cross_validate(data, {"all but three": [few, ~few]}, fit)["all but three"]
        assert not told.predicted[few].all()
        assert told.predicted[~few].all()

    def test_angles_are_said_where_all_of_the_dwells_have_one(self) -> None:
        left = HeldOut(np.zeros((3, 2)), np.array([0.1, np.nan, 0.3]), np.ones(3, dtype=bool))
        with_one = left.rows(np.array([True, True, False]))
        assert with_one.angle_rad is None
        assert len(with_one.residual) == 2
        turned = left.rows(np.array([True, False, True])).angle_rad
        assert turned is not None
        assert turned.tolist() == [0.1, 0.3]


class TestFolds:
    """What is done anew where dwells are left out."""

    data = noisy(turn(24), 86)

    @pytest.mark.parametrize("again", [True, False])
    def test_an_average_is_made_anew_and_where_it_is_not_called_for_the_choice_stands(
        self, monkeypatch: pytest.MonkeyPatch, again: bool
    ) -> None:
        asked: list[Any] = []

        def average(selection: Any, candidates: Any) -> Any:
            asked.append(candidates)
            return "average" if again else None

        monkeypatch.setattr(validation, "select", lambda *_, **__: SimpleNamespace(fit="choice"))
        monkeypatch.setattr(validation, "average", average)
        averaged: Any = SimpleNamespace(promising="promising")
        told: Any = Fold([], averaged, 2).choose_in_fold(self.data)
        assert told == ("average" if again else "choice")
        assert asked == ["promising"]
        alone: Any = Fold([], None, 2).choose_in_fold(self.data)
        assert alone == "choice"
        assert asked == ["promising"]


class Answering:
    """A fold whose errors on left-out dwells are by the number of terms that are kept, or 9 anew.

    A model of `knowing` terms pretends to know all of the dwells.
    """

    def __init__(
        self, data: Readings, averaged: object = None, unknown: Sequence[int] = (), knowing: int = -1
    ) -> None:
        self.data, self.averaged, self.knowing = data, averaged, knowing
        self.unknown = np.isin(np.arange(len(data)), unknown)
        self.asked: list[int | None] = []

    def left_out(
        self, data: Readings, designs: Mapping[str, Any], fit: Fit | None = None
    ) -> dict[str, HeldOut]:
        self.asked.append(None if fit is None else len(fit.terms))
        size = 9.0 if fit is None else 1.0 + len(fit.terms)
        # What is not known errs by far more, and must not count.
        residual = np.where(self.unknown, 1e3, size)[:, None] * np.ones(2)
        unknown = self.unknown & (fit is None or len(fit.terms) != self.knowing)
        return {name: HeldOut(residual, None, ~unknown) for name in designs}


class TestErrors:
    data = biased()
    selection = chosen(data, labelled(data, "bias[xy]", "quadratic[x]"), ((0, 1), 1.0))
    fits, _ = nest_fits(selection, None)

    @pytest.mark.parametrize("averaged", [None, "an average"])
    def test_the_final_model_is_judged_with_its_effects_kept_but_an_average_anew(
        self, averaged: Any
    ) -> None:
        fold: Any = Answering(self.data, averaged, unknown=(2, 5))
        told = guard_errors(self.selection, self.fits, fold)
        assert fold.asked == [0, 1, 2 if averaged is None else None]
        assert told == pytest.approx([1.0, 2.0, 3.0 if averaged is None else 9.0])

    def test_models_are_judged_on_the_dwells_that_the_final_one_knows(self) -> None:
        fold: Any = Answering(self.data, unknown=(2, 5), knowing=0)
        assert guard_errors(self.selection, self.fits, fold) == pytest.approx([1.0, 2.0, 3.0])

    def test_a_model_of_more_parameters_than_readings_beside_one_dwell_is_not_tried_in_folds(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        base = Fit.begin(noisy(turn(9), 87))
        wide = replace(base, values=replace(base.values, terms=(np.zeros(13),)))
        selection: Any = SimpleNamespace(base=base, fit=wide, data=base.data, terms=())
        fold: Any = Answering(base.data)
        assert guard_errors(selection, [base, wide], fold) == []
        figures = ErrorFigures(1.0, None, None, None)
        monkeypatch.setattr(validation, "leave_each_out", lambda fits: ([[] for _ in fits], "one by one"))
        monkeypatch.setattr(validation, "figures_of_fit", lambda *_: figures)
        assert error_figures(selection, base.data, None, [base, wide], fold)[1] == "one by one"
        assert not fold.asked

    def test_with_check_dwells_none_of_the_others_is_left_out(self) -> None:
        every = replace(self.data, check=np.arange(24) % 4 == 3)
        fits = [fit.again(every.training) for fit in self.fits]
        fold: Any = Answering(every)
        figures, design = error_figures(self.selection, fits[0].data, every.checking, fits, fold)
        assert design == "6 check dwells"
        assert not fold.asked
        assert all(figure.heldout_rms is not None for figure in figures)

    def test_of_gyros_without_a_dwell_that_was_left_out_no_axis_has_an_error(self) -> None:
        data = gyros()
        ((figure,), _) = without_folds([Fit.begin(data).refit()], data, None)
        assert (figure.heldout_rms, figure.heldout_by_axis) == (None, None)

    def test_a_base_model_alone_has_nothing_to_be_judged_against(self) -> None:
        fold: Any = Answering(self.data)
        assert guard_errors(self.selection, self.fits[:1], fold) == []
        assert not fold.asked

    @pytest.mark.parametrize("averaged", [None, "an average"])
    def test_the_final_error_is_of_effects_chosen_anew_and_with_them_kept_it_stands_beside(
        self, averaged: Any
    ) -> None:
        fold: Any = Answering(self.data, averaged, unknown=(2, 5))
        figures, design = error_figures(self.selection, self.data, None, self.fits, fold)
        assert [one.heldout_rms for one in figures] == pytest.approx([1.0, 2.0, 9.0])
        assert [one.heldout_kept for one in figures] == [None, None, 3.0 if averaged is None else None]
        said = ", 3 mg with those found kept" if averaged is None else ""
        assert design == (
            f"whole dwells (5 folds, {len(self.data) - 2} of {len(self.data)} dwells); effects chosen again"
            f" in each fold{said}; a dwell counts if every model predicts it: the base model's error"
            " depends on the others"
        )

    def test_without_effects_nothing_is_chosen_anew(self) -> None:
        fold: Any = Answering(self.data, unknown=(2, 5))
        (figure,), design = error_figures(self.selection, self.data, None, self.fits[:1], fold)
        assert fold.asked == [0]
        assert design == "whole dwells (5 folds)"
        assert figure.heldout_kept is None

    @pytest.mark.parametrize(("values", "few"), [(12, False), (13, True)])
    def test_dwells_are_few_where_all_but_one_have_less_readings_than_there_are_parameters(
        self, values: int, few: bool
    ) -> None:
        # Eight dwells of two readings, and four base parameters.
        fit = Fit.begin(noisy(turn(9), 87))
        fit = replace(fit, values=replace(fit.values, terms=(np.zeros(values - 2), np.zeros(2))))
        assert validation.leaves_too_few(fit) == few
        # A base parameter that the dwells do not show takes none.
        hidden = replace(fit.data, fitted=np.array([True, True, False, True]))
        assert not validation.leaves_too_few(replace(fit, data=hidden))

    def test_an_average_is_a_step_beside_the_names_or_takes_the_place_of_a_formula(self) -> None:
        bias, curve = self.selection.terms
        smooth = function("smooth", lambda c: c.time_s, approximates=True)
        beside: Any = SimpleNamespace(terms=(bias, curve, smooth))
        fits, steps = nest_fits(self.selection, beside)
        assert steps == ["bias", "quadratic", "unnamed: bias of x follows smooth"]
        assert [len(one.terms) for one in fits] == [0, 1, 2, 3]
        assert fits[-1] is beside
        instead: Any = SimpleNamespace(terms=(bias, smooth, smooth))
        fits, steps = nest_fits(self.selection, instead)
        assert steps == ["bias", "quadratic"]
        assert [len(one.terms) for one in fits] == [0, 1, 3]
        assert fits[-1] is instead

    def test_chi2_is_said_against_the_noise_that_was_measured(self) -> None:
        louder = replace(self.data, own_covariance=4 * self.data.own_covariance)
        fit = replace(self.fits[-1], data=louder).refit()
        ((told,), _) = without_folds([fit], self.data, None)
        ((own,), _) = without_folds([fit], louder, None)
        assert own.chi2_per_dof == pytest.approx(fit.chi2 / (48 - 7))
        assert told.chi2_per_dof == pytest.approx(4 * fit.chi2 / (48 - 7), rel=1e-3)
        unknown = replace(self.data, noise_known=False)
        ((silent,), _) = without_folds([replace(fit, data=unknown)], unknown, None)
        assert silent.chi2_per_dof is None

    def test_without_freedom_chi2_is_not_said(self) -> None:
        fit = Fit.begin(noisy(turn(angles_deg=[0, 70]), 88)).refit()
        ((told,), _) = without_folds([fit], fit.data, None)
        assert told.chi2_per_dof is None

    def test_angles_are_compared_round_the_turn(self) -> None:
        turned = [np.array([2 * np.pi - 0.03, 0.01]), np.array([-2 * np.pi + 0.01])]
        expected = math.degrees(math.sqrt((9 + 1 + 1) / 3) * 0.01)
        assert validation.rms_deg(turned) == pytest.approx(expected)
        assert validation.rms_deg([]) is None
