"""Plots: what is drawn, where, and that nothing in a label can break a page."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from adis_gonio.report import Series, plot

SVG = "{http://www.w3.org/2000/svg}"


def drawn(*series, **options):
    text = plot(series, "x / s", "y / mg", **{"title": "a title", **options})
    return ET.fromstring(text)


def circles(root):
    return [(float(c.get("cx")), float(c.get("cy"))) for c in root.iter(f"{SVG}circle")]


def test_points_lie_in_proportion_to_their_values():
    at = circles(drawn(Series([0, 1, 3], [0, 10, 30])))
    (x0, y0), (x1, y1), (x3, y3) = at
    assert (x3 - x0) / (x1 - x0) == pytest.approx(3, rel=0.01)
    assert (y3 - y0) / (y1 - y0) == pytest.approx(3, rel=0.01)
    assert y3 < y0, "larger values are higher up"


def test_logarithmic_axes_place_decades_evenly():
    at = circles(drawn(Series([0.1, 1, 10], [1e-3, 1, 1e3]), x_log=True, y_log=True))
    steps = np.diff(np.array(at), axis=0)
    assert steps[0] == pytest.approx(steps[1], abs=0.2)


def test_values_that_an_axis_cannot_hold_are_left_out():
    assert len(circles(drawn(Series([0.0, 1, 10], [1, 1, np.nan]), x_log=True))) == 1


def test_error_bars_are_as_long_as_the_error():
    root = drawn(Series([0, 1], [0, 10], error=[5, 5]))
    (_, y0), (_, y1) = circles(root)
    bars = next(p.get("d") for p in root.iter(f"{SVG}path") if p.get("d").count("V") == 2)
    low, high = re.search(r"M[\d.]+ ([\d.]+)V([\d.]+)", bars).groups()
    assert abs(float(low) - float(high)) == pytest.approx(abs(y0 - y1), abs=0.3)


def test_the_zero_line_is_in_the_axis_even_where_the_data_are_far_from_it():
    texts = [t.text for t in drawn(Series([0, 1], [100, 110]), zero=True).iter(f"{SVG}text")]
    assert "0" in texts


def test_small_spans_have_ticks_that_differ():
    texts = [t.text for t in drawn(Series([4.9999, 5.0001], [0, 1])).iter(f"{SVG}text")]
    numbers = [t for t in texts if re.fullmatch(r"[45]\.?\d*", t)]
    assert len(numbers) > 1
    assert len(set(numbers)) == len(numbers)


def test_before_and_after_differ_by_shape_and_not_by_colour_alone():
    root = drawn(Series([0], [0], "before"), Series([0], [1], "after"))
    hollow, full = list(root.iter(f"{SVG}circle"))[-2:]
    assert "stroke:" in hollow.get("style")
    assert "stroke" not in full.get("style")


def test_many_points_stay_a_small_drawing():
    x = np.arange(100_000.0)
    assert len(plot([Series(x, np.sin(x))], "x", "y", title="t")) < 60_000


def test_labels_are_escaped():
    text = plot([Series([0], [0], "<script>alert(1)</script>")], "<b>", "a & b", title="</title><i>")
    assert "<script" not in text
    assert "<b>" not in text
    assert "<i>" not in text
    ET.fromstring(text)


def test_screen_readers_get_title_and_description():
    root = drawn(Series([0], [0]), description="what is seen")
    ids = {e.get("id"): e.text for e in root.iter() if e.get("id")}
    assert [ids[name] for name in root.get("aria-labelledby").split()] == ["a title", "what is seen"]


def test_ids_of_two_plots_in_a_page_differ():
    names = {drawn(Series([0, 1], [0, y])).get("aria-labelledby") for y in (1, 2)}
    assert len(names) == 2


def test_an_empty_plot_is_still_a_plot():
    assert circles(drawn(Series([], []))) == []
