"""Sources of uncertainty by themselves: what each is, and what it moves the parameters by."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import fit
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.determination import covariance, natural_units
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.fitting.uncertainty import FIXTURE, LINKS, MODEL, REPEATABILITY, TEMPERATURE, Source
from adis_gonio.model.records import Session
from fitting.gyros.test_links import linked_part
from fitting.test_uncertainty import FOUR, NINE, turn


def source(result: FitResult, name: str) -> Source:
    return next(one for one in result.sources.each if one.name == name)


def with_temperatures(session: Session, degrees: list[float]) -> Session:
    dwells = tuple(
        replace(dwell, temperature_c=np.full(len(dwell), one))
        for dwell, one in zip(session.dwells, degrees, strict=True)
    )
    return replace(session, dwells=dwells, sensor="adis16354")


def test_an_estimated_noise_is_what_a_reading_repeats_to() -> None:
    result = fit(turn(NINE, noise=3.0, stated=None, sigma=0.0), "ml")
    made = result.origin
    assert made.noise.scale > 1.5
    own = source(result, REPEATABILITY)
    assert own.u == pytest.approx(made.noise.scale)
    assert (own.kind, own.distribution) == ("A", "Student")
    np.testing.assert_allclose(own.dof, result.dof)
    # Information of readings with that noise says the same of every parameter.
    stated = covariance(made.determination.fisher, made.determination.free, made.determination.null)
    np.testing.assert_allclose(result.sources.covariance, stated, rtol=1e-6, atol=1e-18)


def test_an_estimated_stage_is_of_type_a_and_a_stated_one_of_type_b() -> None:
    rough = turn(tuple(range(0, 360, 30)), sigma=0.5, noise=0.1)
    estimated = source(fit(replace(rough, fixture_sigma_deg=None), "ml"), FIXTURE)
    assert (estimated.kind, estimated.distribution) == ("A", "Student")
    assert estimated.u == pytest.approx(0.5, rel=0.5)
    assert estimated.note == "estimated from the residual"
    # The angles cannot show more than one deviation each.
    assert 3 < estimated.dof[0] < 12
    stated = source(fit(rough, "ml"), FIXTURE)
    assert (stated.kind, stated.distribution, stated.note) == ("B", "normal", "")
    assert stated.u == pytest.approx(0.5)
    free = source(fit(replace(rough, fixture_sigma_deg=math.inf), "ml"), FIXTURE)
    assert free.u is None
    assert not free.moves.any()
    exact = source(fit(turn(FOUR, sigma=0.0, stated=None), "four-position"), FIXTURE)
    assert exact.note == ""


def test_the_source_of_a_model_that_lacks_something_holds_scatter_and_the_catalogue() -> None:
    sound = source(fit(turn(NINE), "ml"), MODEL)
    assert (sound.kind, sound.distribution) == ("B", "normal")
    assert sound.note == "the residual shows no more than the noise"
    assert sound.u == 0
    scattered = fit(turn(NINE, noise=5.0, stated=0.1), "ml")
    lacking = source(scattered, MODEL)
    assert (lacking.kind, lacking.distribution) == ("B", "normal")
    assert lacking.u > scattered.extra_mg
    assert lacking.acts_mg.shape[:2] == (9, 2)
    np.testing.assert_allclose(lacking.reading_mg2, scattered.extra_mg**2 * np.eye(2))
    blind = source(fit(replace(turn((0, 90)), sensor="adis16354"), "two-position"), MODEL)
    assert (blind.kind, blind.distribution) == ("B", "normal")
    assert blind.u == pytest.approx(VARIANTS["adis16354"].performance.initial_bias_mg)


def test_a_coefficient_of_temperature_is_as_large_as_the_sheet_and_the_session_allow() -> None:
    degrees = [20.0, 23.0, 26.0, 22.0, 30.0, 21.0, 25.0, 28.0, 24.0]
    result = fit(with_temperatures(turn(NINE), degrees), "ml")
    own, made = source(result, TEMPERATURE), result.origin
    figure = VARIANTS["adis16354"].performance.bias_tempco_mg_per_c
    away = np.array(degrees) - np.mean(degrees)
    spread = []
    for axis in range(2):
        columns = np.zeros((9, 2, 1))
        columns[:, axis, 0] = away
        rows = np.concatenate([made.fit.jacobian, made.fit.white(columns)], axis=1)
        size = np.linalg.norm(rows, axis=0)
        information = (rows / size).T @ (rows / size)
        information[-1, -1] += 1 / (figure * size[-1]) ** 2
        shown = np.linalg.solve(information, (rows / size).T @ made.fit.residual.ravel())[-1]
        spread.append(math.hypot(math.sqrt(np.linalg.inv(information)[-1, -1]), shown) / size[-1])
        np.testing.assert_allclose(own.acts_mg[:, axis, axis], spread[axis] * away, rtol=1e-6)
        # What one standard uncertainty of it moves parameters by is what a fit of such readings moves by.
        moved = replace(made.fit.data, mean=made.fit.data.mean + own.acts_mg[:, :, axis] * 1e-3)
        change = made.determination.refitted(moved).values.parameters - made.fit.values.parameters
        natural = change / natural_units(made.fit.data) / 1e-3
        np.testing.assert_allclose(
            own.moves[:, axis], natural, rtol=0.02, atol=0.01 * np.abs(natural).max()
        )
    assert own.u == pytest.approx(math.sqrt(np.mean(np.square(spread))))
    assert own.u < figure
    assert own.note == "dwells at 20.0 to 30.0\u00a0°C"
    without = source(fit(replace(turn(NINE), sensor="adis16354"), "ml"), TEMPERATURE)
    assert without.note == "temperature not recorded"
    assert without.u == pytest.approx(figure)
    generic = fit(replace(with_temperatures(turn(NINE), degrees), sensor="generic"), "ml")
    assert source(generic, TEMPERATURE).u is None
    assert not source(generic, TEMPERATURE).moves.any()


def test_turns_between_poses_are_a_source_and_all_together_are_the_inverse_information() -> None:
    data, links = linked_part(6, np.random.default_rng(6))
    result = fit_readings(replace(data, links=links))
    made = result.origin
    own = source(result, LINKS)
    spread = links.own_rad2 + np.einsum("mak,mbk->mab", links.modes_rad, links.modes_rad)
    variance = np.mean([np.trace(one) / 3 for one in spread])
    assert own.u == pytest.approx(math.degrees(math.sqrt(variance)))
    stated = covariance(made.determination.fisher, made.determination.free, made.determination.null)
    np.testing.assert_allclose(np.diagonal(result.sources.covariance), np.diagonal(stated), rtol=1e-4)
