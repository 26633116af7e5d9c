"""The twin is like what was measured, and the comparison tells when it is not."""

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import fit, load_session, trace
from adis_gonio.base.errors import DataError
from adis_gonio.faces.cli import main
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import in_mg, readings_of
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm
from adis_gonio.handover.digital_twin import LikeWorld, compare, noise_of, period_of, simulate_like
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.samples_writer import write_samples_csv
from adis_gonio.tracing.named_candidates import named_terms
from recordings import recording


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A session with a strong quadratic term, seen only as a file."""
    path = tmp_path_factory.mktemp("twin") / "measured.csv"
    arguments = ["--plan", "tumble", "--dwell", "0.5", "--seed", "4", "--effect", "quadratic:k2_x=3"]
    assert main(["simulate", *arguments, "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Nine dwells of a second, for commands."""
    path = tmp_path_factory.mktemp("twin") / "short.csv"
    assert main(["simulate", "--plan", "mmpm", "--dwell", "1", "--seed", "4", "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def session(measured):
    return load_session(measured)


@pytest.fixture(scope="module")
def final(session):
    """The model that a trace of the session finds: the biases and the quadratic term."""
    data = readings_of(session)
    terms = {term.label: term for term in named_terms(data)[0]}
    kept = [terms["bias[xy]"], terms["quadratic[x]"]]
    return Fit.begin(data).refit().with_terms(kept, [np.zeros(2), np.zeros(1)]).refit()


@pytest.fixture(scope="module")
def twin(session, final):
    return simulate_like(session, final, seed=1)


@pytest.mark.filterwarnings("error")
def test_an_axis_without_noise_does_not_decide_on_the_filter(session):
    still = tuple(
        replace(dwell, accel=np.where([True, False, False], dwell.accel, dwell.accel[0]))
        for dwell in session.dwells
    )
    noise = noise_of(replace(session, dwells=still), in_mg(2))
    assert noise.filter_m == noise_of(session, in_mg(2)).filter_m
    assert noise.white_mg[1] < 1e-9


def test_a_session_agrees_with_itself_entirely(session, final):
    found = compare(session, session, final)
    assert (found.p_residual, found.p_variance, found.allan_ratio) == pytest.approx((1, 1, 1))


def test_the_twin_of_a_simulated_session_agrees_with_it_and_has_its_effects(session, final, twin):
    assert [dwell.angle_deg for dwell in twin.dwells] == [dwell.angle_deg for dwell in session.dwells]
    found = compare(session, twin, final)
    assert found.agrees, found
    assert found.allan_ratio == pytest.approx(1, abs=0.1)
    again = trace(twin)
    quadratic = next(finding for finding in again.found if finding.effect == "quadratic")
    value = quadratic.parameters["k2_x"]
    assert value.value == pytest.approx(3.0, abs=5 * value.u + 0.3)


def test_the_world_of_a_twin_states_the_values_of_the_fit_as_its_truth(session, final):
    basis = Basis("time", ("time",), common=lambda conditions: conditions.time_s[:, None])
    unnamed = NamelessTerm("drift of x", ("time",), 0.0, "bias", (0,), basis)
    fit = final.with_terms([*final.terms, unnamed], [*final.values.terms, np.zeros(1)])
    noise = noise_of(session, final.data.unit)
    truth = LikeWorld(fit, noise, sensor=session.sensor, seed=1).truth()
    (quadratic,) = (k for k, term in enumerate(final.terms) if term.name == "quadratic")
    assert truth["traced.k2_x"] == final.values.terms[quadratic][0] == pytest.approx(3.0, abs=0.5)
    assert truth["delta_k"] == pytest.approx(final.values.base[1] / final.values.base[2] - 1)


def test_a_model_that_lacks_the_effect_makes_a_twin_that_does_not_agree(session, final):
    kept = [k for k, term in enumerate(final.terms) if term.name == "bias"]
    lacking = final.with_terms([final.terms[k] for k in kept], [final.values.terms[k] for k in kept])
    twin = simulate_like(session, lacking, seed=1)
    assert not compare(session, twin, lacking).agrees


def test_a_twin_is_measured_at_the_times_temperatures_and_voltages_of_the_session(session, final):
    dwells = []
    for dwell in session.dwells:
        time_s = dwell.time_s
        dwells.append(
            replace(dwell, time_s=time_s, temperature_c=20 + 0.1 * time_s, supply_v=4.9 + 2e-3 * time_s)
        )
    twin = simulate_like(replace(session, dwells=tuple(dwells)), final, seed=1)
    for dwell, simulated in zip(dwells, twin.dwells, strict=True):
        assert simulated.time_s == pytest.approx(dwell.time_s, abs=0.3)
        assert simulated.temperature_c.mean() == pytest.approx(dwell.temperature_c.mean(), abs=0.05)
        assert simulated.supply_v.mean() == pytest.approx(dwell.supply_v.mean(), abs=1e-3)


def test_twins_have_the_slow_noise_that_the_fit_of_the_session_assumes(tmp_path):
    path = tmp_path / "slow.csv"
    assert main(["simulate", "--plan", "mmpm", "--dwell", "3", "--seed", "13", "-o", str(path)]) == 0
    session = load_session(path)
    data = readings_of(session)
    bias = [term for term in named_terms(data)[0] if term.label == "bias[xy]"]
    final = Fit.begin(data).refit().with_terms(bias, [np.zeros(2)]).refit()
    noise = noise_of(session, data.unit)
    # The dwells are too short to show 1/f noise: the fit takes the figure of the part, 0.1 mg.
    assert noise.floor_mg == pytest.approx([0.1, 0.1])
    result = fit(session, method="ml")
    fits = [fit(simulate_like(session, final, seed=seed), method="ml") for seed in range(12)]
    assert 0.75 < np.mean([one.chi2 / one.dof for one in fits]) < 1.3
    # Biases of the session contain its slowest noise, so the biases of its twins agree with them.
    off = [(one[n].value - result[n].value) / one[n].u for one in fits for n in ("bias_x", "bias_y")]
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_position_without_an_angle_has_the_attitude_of_its_reading(session, final):
    undeclared = replace(session.dwells[3], angle_deg=None)
    dwells = (*session.dwells[:3], undeclared, *session.dwells[4:])
    twin = simulate_like(replace(session, dwells=dwells), final, seed=1)
    assert twin.dwells[3].accel.mean(axis=0)[:2] == pytest.approx(undeclared.accel.mean(axis=0)[:2], abs=3)


def test_as_many_readings_as_parameters_leave_nothing_to_compare(session, final):
    two = replace(session, dwells=session.dwells[:2])
    with pytest.raises(DataError, match="no residual to compare"):
        compare(two, two, final)


def test_a_session_with_other_noise_does_not_agree(session, final, twin):
    rng = np.random.default_rng(3)
    louder = tuple(
        replace(dwell, accel=dwell.accel + rng.normal(0, 12, dwell.accel.shape)) for dwell in session.dwells
    )
    assert not compare(replace(session, dwells=louder), twin, final).agrees


def test_a_term_of_the_vibration_has_the_variance_of_the_measured_dwells(short):
    session = load_session(short)
    shaken = session.dwells[3]
    noise = np.random.default_rng(6).normal(0, 200, shaken.accel.shape)
    dwells = [replace(dwell, accel=dwell.accel + noise * (dwell is shaken)) for dwell in session.dwells]
    session = replace(session, dwells=tuple(dwells))
    data = readings_of(session)
    (term,) = (one for one in named_terms(data)[0] if one.label == "vibration_rectification[xy]")
    plain = Fit.begin(data).refit()
    fits = plain, plain.with_terms([term], [np.array([3000.0, -2000.0])])
    off, on = (
        [dwell.accel[:, :2].mean(axis=0) for dwell in simulate_like(session, fit, seed=1).dwells]
        for fit in fits
    )
    shift_lsb = data.conditions.variance_mg2 / 1e6 * [3000.0, -2000.0] / 0.4672
    assert np.array(on) - off == pytest.approx(shift_lsb, abs=0.2)


def test_the_twin_of_a_real_recording_has_its_noise():
    session = load_session(recording("adis16350_xy_turn"))
    result = trace(session)
    twin = simulate_like(session, result.fits[-1], seed=2)
    assert twin.sensor == "adis16350"
    found = compare(session, twin, result.fits[-1])
    assert found.allan_ratio == pytest.approx(1, abs=0.25)


@pytest.fixture
def precise():
    """Ten positions of a generic sensor with a noise of a tenth of a step of an ADIS16354."""
    rng = np.random.default_rng(1)
    angle_deg = np.arange(0.0, 360.0, 36.0)
    gravity_mg = 1000 * np.stack([np.cos(np.radians(angle_deg)), -np.sin(np.radians(angle_deg))], axis=1)
    dwells = tuple(
        Dwell(
            k,
            5.0 * k + np.arange(200) * 0.01,
            reading + [60.0, -90.0] + 0.05 * rng.standard_normal((200, 2)),
            angle_deg=float(angle),
        )
        for k, (angle, reading) in enumerate(zip(angle_deg, gravity_mg, strict=True))
    )
    return Session(dwells=dwells, sensor="generic", accel_unit="mg", fixture_sigma_deg=0.001)


def test_the_twin_of_a_generic_sensor_has_no_steps_of_another_part(precise, tmp_path):
    result = trace(precise)
    twin = simulate_like(precise, result.fits[-1], seed=2)
    assert (twin.sensor, twin.accel_unit) == ("generic", "mg")
    assert twin.dwells[3].accel.std(axis=0) == pytest.approx([0.05, 0.05], rel=0.2)
    assert twin.dwells[3].accel.mean(axis=0) == pytest.approx(precise.dwells[3].accel.mean(axis=0), abs=0.3)
    assert trace(twin).within == ()
    found = compare(precise, twin, result.fits[-1])
    assert found.allan_ratio == pytest.approx(1, abs=0.05)
    assert found.agrees
    # As a file, too.
    write_samples_csv(twin, tmp_path / "twin.csv")
    assert load_session(tmp_path / "twin.csv").dwells[3].accel.std(axis=0)[0] == pytest.approx(
        0.05, rel=0.2
    )


def test_the_twin_of_a_generic_sensor_follows_errors_beyond_its_noise(precise):
    # The model without a bias misses the readings by more than 1000 times their noise.
    fit = Fit.begin(readings_of(precise)).refit()
    twin = simulate_like(precise, fit, seed=2)
    means = np.array([dwell.accel.mean(axis=0) for dwell in twin.dwells])
    assert np.abs(fit.declared_misfit).max() > 80
    # Predicted at the declared angles, to first order in the deviation of the angle.
    assert means == pytest.approx(fit.data.mean - fit.declared_misfit, abs=5.5)


def test_the_twin_of_a_generic_sensor_without_declared_angles_has_its_noise(precise):
    free = replace(
        precise,
        dwells=tuple(replace(dwell, angle_deg=None) for dwell in precise.dwells),
        fixture_sigma_deg=math.inf,
    )
    twin = simulate_like(free, Fit.begin(readings_of(free)).refit(), seed=2)
    assert twin.dwells[3].accel.std(axis=0) == pytest.approx([0.05, 0.05], rel=0.2)


def test_simulate_like_writes_the_twin_as_a_samples_csv(capsys, short, tmp_path):
    out = tmp_path / "twin.csv.gz"
    assert main(["simulate", "--like", str(short), "--seed", "5", "-o", str(out)]) == 0
    assert len(load_session(out).dwells) == 9
    assert main(["simulate", "--like", str(short), "-o", str(tmp_path / "twin.session")]) == 2
    assert "name it .csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("times", "period_s"),
    [
        ([[0.0, 0.25, 0.5], [7.0, 7.25]], 0.25),
        ([[0.0, 0.0, 0.01, 0.01, 0.02], [3.0]], 0.005),  # a coarse clock, and a dwell of one sample
        ([[1.0, 1.0, 1.0], [2.0, 2.0]], None),
        ([[1.0], [2.0]], None),
    ],
)
def test_the_period_of_the_samples_follows_from_the_lengths_of_the_dwells(times, period_s):
    dwells = [Dwell(k, np.array(time_s), np.ones((len(time_s), 2))) for k, time_s in enumerate(times)]
    if period_s is None:
        with pytest.raises(DataError, match="a twin needs sample times"):
            period_of(dwells)
    else:
        assert period_of(dwells) == pytest.approx(period_s)


def test_readings_that_somebody_averaged_have_no_noise_to_copy(session, final):
    single = tuple(
        replace(
            dwell,
            time_s=dwell.time_s[:1],
            accel=dwell.accel[:1],
            gyro=None,
            temperature_c=None,
            supply_v=None,
        )
        for dwell in session.dwells
    )
    with pytest.raises(DataError, match="no noise to copy"):
        simulate_like(replace(session, dwells=single, reading_u_mg=0.1), final)


def test_the_report_holds_the_comparison(short, tmp_path):
    out = tmp_path / "page.html"
    assert main(["report", str(short), "-o", str(out)]) == 0
    page = out.read_text()
    assert "The digital twin against the measured data" in page
    assert "Allan deviation of x" in page
