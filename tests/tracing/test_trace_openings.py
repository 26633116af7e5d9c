"""Names that could explain what an inadequate model leaves."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from adis_gonio.tracing.credible_sets import undecided
from tracing.small_problems import single


def left_by(target: np.ndarray, columns=(), names=(), best=()) -> SimpleNamespace:
    """A selection whose candidates are single columns, and whose model leaves `target`."""
    blocks = [np.asarray(column) / np.linalg.norm(column) for column in columns]
    terms = [
        name if isinstance(name, SimpleNamespace) else SimpleNamespace(name=name, dwell=None, cost=0.0)
        for name in names
    ]
    problem = single(target, np.reshape(blocks, (-1, len(target))), terms)
    return SimpleNamespace(problem=problem, verdict=SimpleNamespace(best=best))


class TestNamesThatCouldExplainIt:
    rows = 40

    def draw(self, seed: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        return rng.normal(size=self.rows), np.linalg.qr(rng.normal(size=(self.rows, columns)))[0].T

    def test_the_one_that_does_is_said_and_those_that_do_not_are_not(self) -> None:
        noise, columns = self.draw(1, 3)
        target = noise + 12 * columns[1]
        assert undecided(left_by(target, columns, ("bias", "cubic", "warm_up"))) == ("cubic",)

    def test_names_of_one_column_are_both_said_and_a_far_less_likely_one_is_not(self) -> None:
        noise, columns = self.draw(2, 2)
        target = 0.3 * noise + 6 * columns[0] + 3 * columns[1]
        chosen = [columns[1], columns[0], columns[0]]
        p_of_the_worse = stats.pearsonr(columns[1], target).pvalue
        assert p_of_the_worse < 0.05, "alone it would be said"
        assert set(undecided(left_by(target, chosen, ("worse", "one", "other")))) == {"one", "other"}

    def test_a_name_up_to_ten_times_less_likely_is_as_good(self) -> None:
        # Orthogonal columns of χ² s² of 40 leave 40 − s²; a likelihood ratio is the ratio of what is left
        # to the power of half the degrees of freedom.
        columns = np.eye(self.rows)
        for ratio, said in ((8.0, ("first", "second")), (12.5, ("first",))):
            left = 24.0 * ratio ** (2 / self.rows)
            target = np.full(self.rows, 0.0)
            target[0], target[1] = np.sqrt(40 - 24.0), np.sqrt(40 - left)
            rest = 40 - target @ target
            target[2:] = np.sqrt(rest / (self.rows - 2))
            assert undecided(left_by(target, columns[:2], ("first", "second"))) == said
            assert undecided(left_by(target, columns[1::-1], ("second", "first"))) == said

    def test_the_best_variant_of_a_name_counts_and_no_name_comes_twice(self) -> None:
        noise, columns = self.draw(3, 3)
        target = noise + 10 * columns[0]
        variants = (columns[2], columns[0], columns[1])
        assert undecided(left_by(target, variants, ("lag", "lag", "lag"))) == ("lag",)

    def test_what_the_model_holds_what_has_no_name_and_single_dwells_are_not_said(self) -> None:
        noise, columns = self.draw(4, 2)
        target = noise + 12 * columns[0]
        held = replace_model(left_by(target, [columns[1], columns[0]], ("quadratic", "quadratic")), (0,))
        assert undecided(held) == ()
        assert undecided(left_by(target, [columns[0]], (None,))) == ()
        dwell = SimpleNamespace(name="outlier_dwell", dwell=3, cost=0.0)
        assert undecided(left_by(target, [columns[0]], (dwell,))) == ()

    def test_no_more_names_than_asked_for_and_the_most_likely_first(self) -> None:
        noise, columns = self.draw(5, 1)
        target = noise + 12 * columns[0]
        tilted = [columns[0] + 0.002 * k * noise / np.linalg.norm(noise) for k in (3, 1, 4, 0, 2, 6, 5)]
        names = ("n3", "n1", "n4", "n0", "n2", "n6", "n5")
        selection = left_by(target, tilted, names)
        by_fit = sorted(
            names, key=lambda name: -abs(target @ selection.problem.columns[:, names.index(name)])
        )
        assert undecided(selection) == tuple(by_fit[:5])
        assert undecided(selection, 2) == tuple(by_fit[:2])

    def test_in_noise_of_any_size_a_name_is_said_once_in_ten(self) -> None:
        rng = np.random.default_rng(6)
        column = np.zeros(8)
        column[0] = 1.0
        said = [
            bool(undecided(left_by(10.0 ** rng.uniform(-3, 3) * rng.normal(size=8), [column], ("bias",))))
            for _ in range(2000)
        ]
        assert np.mean(said) == pytest.approx(0.1, abs=3 * np.sqrt(0.09 / 2000))

    def test_without_a_degree_of_freedom_to_judge_by_nothing_is_said(self) -> None:
        assert undecided(left_by(np.array([5.0]), [np.ones(1)], ("bias",))) == ()
        assert undecided(left_by(np.ones(4))) == ()

    def test_one_degree_of_freedom_is_enough_to_judge_by(self) -> None:
        # F of 1 and 1 degrees of freedom is t² of one: 6.3 and more in one of ten.
        assert undecided(left_by(np.array([7.0, 1.0]), [[1, 0]], ("bias",))) == ("bias",)
        assert undecided(left_by(np.array([6.0, 1.0]), [[1, 0]], ("bias",))) == ()


def replace_model(selection: SimpleNamespace, best: tuple[int, ...]) -> SimpleNamespace:
    return SimpleNamespace(problem=selection.problem, verdict=SimpleNamespace(best=best))
