"""A history says what moved and since when, of sessions that can be placed and trusted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet import fleet_pages
from adis_gonio.fleet.calibration_due import due_of
from adis_gonio.fleet.fleet_pages import history_sections
from adis_gonio.fleet.sensor_history import headline, history_of, known_serial
from fleet.made_up import made_up


def years(count):
    return [f"{2010 + n}-06-01" for n in range(count)]


def series(rng, count, **moves):
    return [
        made_up(
            when,
            u=0.1,
            **{name: float(rng.normal(0, 0.1) + moves.get(name, 0.0) * n) for name in ("bias_x", "bias_y")},
            delta_phi=float(rng.normal(0, 0.1)),
            delta_k=float(rng.normal(0, 1e-4)),
        )
        for n, when in enumerate(years(count))
    ]


def test_a_planted_drift_is_the_one_that_is_found():
    history = history_of("A7", series(np.random.default_rng(1), 10, bias_y=0.2))
    assert [name for name, track in history.tracks.items() if track.drifts] == ["bias_y"]
    slope = history.tracks["bias_y"].drift.slope
    assert abs(slope.value - 0.2) <= slope.U
    assert "drift in bias_y" in headline(history)


def test_a_step_among_five_sessions_is_in_the_headline_as_scatter():
    """The charts cannot tell it from scatter between sessions, but the stated u cannot explain it."""
    step = [made_up(when, u=0.1, bias_x=3.0 * (n > 2)) for n, when in enumerate(years(5))]
    assert "scatter beyond u in bias_x;" in headline(history_of("A7", step))
    still = [made_up(when, u=0.1) for when in years(5)]
    assert "scatter" not in headline(history_of("A7", still))
    small = [made_up(when, u=0.1, bias_x=0.56 * (n > 2)) for n, when in enumerate(years(5))]
    history = history_of("A7", small)
    # One of four quantities has a p-value below 5 % by chance more often than stated.
    assert 0.05 / 4 < history.tracks["bias_x"].drift.birge_p < 0.05
    assert "scatter" not in headline(history)


def test_without_a_drift_one_is_called_in_no_more_than_five_percent_of_sensors():
    rng = np.random.default_rng(2)
    called = [
        any(track.drifts for track in history_of("A7", series(rng, 7)).tracks.values()) for _ in range(150)
    ]
    assert np.mean(called) <= 0.08  # 5 % and two standard errors


@pytest.mark.parametrize(("t", "drifts"), [(3.499, True), (2.998, False)])
def test_the_probability_of_a_drift_is_taken_times_the_number_of_quantities(t, drifts):
    """Student's t of seven degrees of freedom: p = 1 % and 2 %, of four quantities."""
    rate = t * 0.1 / math.sqrt(60)  # Σ(n − 4)² = 60
    sessions = [made_up(when, u=0.1, bias_y=rate * n) for n, when in enumerate(years(9))]
    track = history_of("A7", sessions).tracks["bias_y"]
    assert track.drift.p_value == pytest.approx(0.01 if drifts else 0.02, rel=0.01)
    assert track.drifts == drifts


def test_a_u_of_few_degrees_of_freedom_does_not_raise_the_rate_of_false_alarms():
    """Sessions of an unchanged sensor whose u was estimated with four degrees of freedom."""
    rng = np.random.default_rng(8)
    outside, signals, slopes = [], [], []
    for _ in range(300):
        sessions = []
        for when in years(16):
            held = {
                name: Value(0.1 * rng.normal(), 0.1 * math.sqrt(rng.chisquare(4) / 4), unit, dof=4)
                for name, unit in (("delta_phi", "deg"), ("bias_x", "mg"), ("bias_y", "mg"))
            }
            sessions.append(replace(made_up(when), values=held))
        for track in history_of("A7", sessions).tracks.values():
            outside.append(len(track.chart.outside) / 15)
            signals.append(track.chart.signal is not None)
            slopes.append(abs(track.drift.slope.value) <= track.drift.slope.U)
    assert np.mean(outside) < 0.012  # 0.018 if these u were exact
    assert np.mean(signals) < 0.07  # 0.10
    assert np.mean(slopes) > 0.915  # 0.89


def test_effects_of_a_session_without_a_trace_are_unknown_and_not_none_found():
    one, other = (made_up(when) for when in years(2))
    shown = history_of("A7", [one, replace(other, traced=True)]).as_dict()["sessions"]
    assert [session["effects"] for session in shown] == [None, []]


def test_sessions_are_in_the_order_of_time_whatever_the_order_of_files():
    records = series(np.random.default_rng(3), 6)
    there = history_of("A7", records).as_dict()
    back = history_of("A7", records[::-1]).as_dict()
    assert there == back


def test_what_has_no_date_failed_or_is_doubtful_is_left_out_with_its_reason():
    good = series(np.random.default_rng(4), 3)
    bad = [
        replace(good[0], when=None),
        replace(good[1], status="failed", reason="is damaged"),
        replace(good[2], doubts=("the stage turned the other way",)),
    ]
    history = history_of("A7", [*good, *bad])
    assert len(history.sessions) == 3
    reasons = [reason for _, reason in history.left_out]
    assert "no date" in reasons[0]
    assert reasons[1] == "is damaged"
    assert "the other way" in reasons[2]


def test_a_session_blind_to_the_biases_is_compared_only_with_its_like():
    """A bias of 10 mg moves the Δφ of two positions by 0.6°, while the sensor has not changed."""
    whole = [made_up(when, u=0.01, bias_x=10.0) for when in years(4)]
    blind = [made_up(when, u=0.01, delta_phi=-0.6) for when in years(6)]
    blind = [replace(one, values={n: v for n, v in one.values.items() if "bias" not in n}) for one in blind]
    history = history_of("A7", [*whole, blind[4]])
    assert history.sessions == tuple(whole)
    assert [record for record, _ in history.left_out] == [blind[4]]
    assert [stair.verdict for stair in due_of(history).stairs] == ["pass"] * 3
    assert history_of("A7", blind).sessions == tuple(blind)
    undated = replace(whole[0], when=None)
    assert history_of("A7", [undated, *blind]).sessions == tuple(blind)


def test_sessions_in_another_unit_than_the_latest_are_not_compared_with_it():
    old, *mg = series(np.random.default_rng(6), 4)
    values = old.values | {"bias_x": replace(old.values["bias_x"], value=650.0, unit="counts")}
    tracks = history_of("A7", [replace(old, values=values), *mg]).tracks
    assert (tracks["bias_x"].unit, tracks["bias_x"].sessions) == ("mg", (1, 2, 3))
    assert tracks["bias_y"].sessions == (0, 1, 2, 3)


def test_one_session_has_values_and_neither_drift_nor_chart():
    history = history_of("A7", series(np.random.default_rng(5), 1))
    track = history.tracks["delta_phi"]
    assert (track.drift, track.chart) == (None, None)
    (table,) = history_sections(history, figures=False)[0].tables
    assert table.rows[0][1:] != ["–"] * 5


def test_the_rms_error_of_the_angle_has_no_interval(monkeypatch):
    """It is positive; its U is that of a displayed angle."""
    drawn, draw = {}, fleet_pages.plot

    def plot(series, x, y, **more):
        drawn.setdefault(y, series[0])
        return draw(series, x, y, **more)

    monkeypatch.setattr(fleet_pages, "plot", plot)
    history = history_of("A7", [made_up(when, u=0.04, angle=0.026) for when in years(2)])
    overview = history_sections(history)[0]
    (table,) = overview.tables
    assert "±" in table.rows[0][2]
    assert table.rows[0][-1].replace("\u00a0", " ") == "0.026 (U 0.078)"
    assert drawn["Δφ / °"].error == pytest.approx(1.96 * 0.04, rel=1e-3)
    assert drawn["angle error, rms / °"].error is None


def test_an_unknown_serial_number_names_the_one_most_like_it_in_one_line():
    with pytest.raises(UsageError, match=r"'A1O7'.* did you mean 'A107'") as caught:
        known_serial("A1O7", ["A107", "B-33", "C9"])
    assert "\n" not in str(caught.value)
    with pytest.raises(UsageError, match=r"A107, B-33"):
        known_serial("zzz", ["A107", "B-33"])
    with pytest.raises(UsageError, match="no session in these folders has a serial number"):
        known_serial("A7", [])
