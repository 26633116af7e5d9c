"""Smooth remainders and their average: kernels, evidence, priors in the refit, what the average adds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamelessTerm
from adis_gonio.tracing.averaging import AMPLITUDES, AveragedTerm, average, evidence, processes
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.trace import trace_readings
from tracing.small_problems import observations


def wavy_zero(amplitude_mg: float = 1.0):
    """A zero of x that no formula of one line gives: two oscillations of unlike period in temperature."""

    def added(c, ideal):
        u = (c.temperature_c - 24) / 12
        wave = np.sin(5.1 * u + 0.3) * np.exp(-u) + 0.6 * np.cos(9.7 * u**2)
        return np.column_stack([amplitude_mg * wave, np.zeros(len(u))])

    return added


def process(data, where: str, axes: tuple[int, ...], covariate: str, amplitude: float) -> NamelessTerm:
    """First process of this kind."""
    return next(
        p
        for p in processes(data)
        if (p.where, p.axes, p.covariates) == (where, axes, (covariate,))
        and p.label.endswith(f"({amplitude:g} u)")
    )


def test_features_of_a_time_process_give_its_kernel() -> None:
    data = observations(n=30)
    term = process(data, "bias", (0,), "time", AMPLITUDES[0])
    features = term.columns(data.mean, data.conditions)[:, 0, :]
    u = (data.conditions.time_s - data.conditions.time_s[0]) / np.ptp(data.conditions.time_s)
    apart = u[:, None] - u
    v = 2 * u - 1
    wanted = 1 + v[:, None] * v + np.exp(-0.5 * (apart / 0.1) ** 2)  # the first length is 0.1
    np.testing.assert_allclose(features @ features.T, wanted, atol=0.02)


def test_features_of_an_angle_process_give_the_periodic_kernel() -> None:
    data = observations(n=30)
    term = process(data, "angle", (), "angle", AMPLITUDES[0])
    features = 1000 * term.columns(data.mean, data.conditions)
    apart = data.conditions.angle_rad[:, None] - data.conditions.angle_rad
    wanted = np.exp(-2 * np.sin(apart / 2) ** 2 / 0.25**2)  # the first width is 0.25
    np.testing.assert_allclose(features @ features.T, wanted, atol=0.02)


@pytest.mark.parametrize("inflation", [1.0, 2.5])
def test_evidence_is_the_ratio_of_gaussian_densities(inflation: float) -> None:
    data = observations(added=wavy_zero())
    base = Fit.begin(data).refit()
    columns, _, target = base.linear()
    beside = np.linalg.qr(columns)[0]
    left = target - beside @ (beside.T @ target)
    some = processes(data)[::211]
    scores = evidence(base, beside, left, some, inflation)
    free = np.linalg.svd(beside, full_matrices=True)[0][:, beside.shape[1] :]  # past the base model
    noise = inflation * np.eye(free.shape[1])
    nothing = stats.multivariate_normal(cov=noise).logpdf(free.T @ target)
    for term, score in zip(some, scores, strict=True):
        white = free.T @ base.white(base.candidate(term))
        cover = noise + term.prior_sd**2 * white @ white.T
        something = stats.multivariate_normal(cov=cover).logpdf(free.T @ target)
        assert score == pytest.approx(something - nothing - term.cost, abs=1e-6)


def test_refit_with_a_prior_is_ridge_regression_and_counts_the_freedom_it_uses() -> None:
    data = observations(added=wavy_zero())
    term = process(data, "bias", (0,), "temperature", 4.0)
    base = Fit.begin(data).refit()
    width = term.columns(data.mean, data.conditions).shape[-1]
    fit = base.with_terms((term,), (np.zeros(width),)).refit()
    columns, blocks, target = fit.linear()
    design = np.concatenate([columns, blocks[0]], axis=1)
    precision = np.diag([0.0] * columns.shape[1] + [term.prior_sd**-2] * width)
    normal = design.T @ design + precision
    solved = np.linalg.solve(normal, design.T @ target)
    np.testing.assert_allclose(fit.values.terms[0], solved[columns.shape[1] :], atol=2e-3)
    used = np.trace(np.linalg.solve(normal, design.T @ design))
    assert target.size - fit.dof == pytest.approx(used, abs=0.01)
    assert used < design.shape[1] - 2


def test_the_average_adds_what_its_members_add_weighted() -> None:
    data = observations(added=wavy_zero(), n=36)
    selection = select(data, [*named_terms(data)[0], *nameless_terms(data)], 3)
    averaged = average(selection)
    assert averaged is not None
    (term,) = [t for t in averaged.terms if isinstance(t, AveragedTerm)]
    assert sum(weight for weight, _, _ in term.members) >= 1 - 1e-9  # models of two terms count twice
    total = sum(w * t.added(v, data.mean, data.conditions) for w, t, v in term.members)
    np.testing.assert_allclose(term.added(np.zeros(0), data.mean, data.conditions), total)
    assert averaged.dof < data.mean.size - 4


def test_the_averaged_base_is_the_average_of_the_members_bases() -> None:
    """Base parameters are linear in what the nameless part adds, so that one refit beside it serves all."""
    data = observations(added=wavy_zero(), n=36)
    selection = select(data, [*named_terms(data)[0], *nameless_terms(data)], 1)
    averaged = average(selection)
    assert averaged is not None
    if any(term.name for term in averaged.terms):
        pytest.fail("the session holds nothing that has a name")
    (term,) = averaged.terms
    bases = []
    for weight, member, values in term.members:
        alone = AveragedTerm(
            "alone", member.covariates, 0.0, member.where, member.axes, member.basis,
            members=((1.0, member, values),),
        )  # fmt: skip
        fit = selection.fit.with_terms((alone,), (np.zeros(0),)).refit()
        bases.append(weight * fit.values.base)
    np.testing.assert_allclose(averaged.values.base, np.sum(bases, axis=0), atol=2e-6)


def test_a_smooth_function_does_not_run_off_beyond_what_was_measured() -> None:
    data = observations(added=wavy_zero(3.0), n=36)
    warm = data.conditions.temperature_c
    inner = data.rows(warm < np.quantile(warm, 0.7))
    for amplitude in AMPLITUDES:
        term = process(inner, "bias", (0,), "temperature", amplitude)
        width = term.columns(inner.mean, inner.conditions).shape[-1]
        fit = Fit.begin(inner).with_terms((term,), (np.zeros(width),)).refit()
        inside, beyond = (
            np.abs(term.added(fit.values.terms[0], d.mean, d.conditions)[:, 0]).max() for d in (inner, data)
        )
        assert beyond < 2 * inside


@pytest.mark.parametrize("seed", range(2))
def test_a_wavy_zero_is_unnamed_and_its_held_out_error_falls_towards_the_noise(seed: int) -> None:
    data = observations(added=wavy_zero(), n=48, seed=seed)
    result = trace_readings(data)
    assert not result.found
    assert result.unnamed is not None
    assert "temperature" in result.unnamed.covariates
    # The noise alone is a fifth of what it was before.
    assert result.after.heldout_rms < 0.3 * result.before.heldout_rms


def test_a_lean_that_follows_temperature_by_no_line_is_said_to_be_one() -> None:
    def lean(c, ideal):
        # A line would be `misalignment_temperature`.
        return np.column_stack([np.zeros(len(ideal)), 0.5 * np.sin(c.temperature_c - 25) * ideal[:, 0]])

    result = trace_readings(observations(added=lean, n=36))
    assert not result.found
    assert result.unnamed is not None
    assert result.unnamed.covariates == ("temperature",)
    assert result.unnamed.form.startswith("misalignment of y follows")
