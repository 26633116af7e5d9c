"""Plots: what is drawn, where, and that nothing in a label or a setting can break a page."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ET

import matplotlib as mpl
import numpy as np
import pytest

from adis_gonio.base.errors import NotInstalledError
from adis_gonio.page.document import Series, plot

SVG = "{http://www.w3.org/2000/svg}"


def drawn(*series, **options):
    text = plot(series, "x / s", "y / mg", **{"title": "a title", **options})
    return ET.fromstring(text)


def markers(root):
    """Places of all markers; those of the legend among them where series have labels."""
    return [(float(c.get("x")), float(c.get("y"))) for c in root.iter(f"{SVG}use")]


def texts(root):
    return [t.text for t in root.iter(f"{SVG}text")]


def line_of(root, role):
    """The path that is drawn in a role's colour without being a marker."""
    (path,) = (
        p
        for p in root.iter(f"{SVG}path")
        if f"stroke:var(--{role}," in p.get("style", "") and not p.get("id")
    )
    return path


def corners(path):
    """Lists of points (n, 2), one list for each piece of a path."""
    pieces = re.findall(r"M([^M]*)", path.get("d"))
    return [np.array(re.findall(r"-?[\d.]+", piece), float).reshape(-1, 2) for piece in pieces]


def test_points_lie_in_proportion_to_their_values():
    (x0, y0), (x1, y1), (x3, y3) = markers(drawn(Series([0, 1, 3], [0, 10, 30])))
    assert (x3 - x0) / (x1 - x0) == pytest.approx(3, rel=0.01)
    assert (y3 - y0) / (y1 - y0) == pytest.approx(3, rel=0.01)
    assert y3 < y0, "larger values are higher up"


def test_logarithmic_axes_place_decades_evenly():
    at = markers(drawn(Series([0.1, 1, 10], [1e-3, 1, 1e3]), x_log=True, y_log=True))
    steps = np.diff(np.array(at), axis=0)
    assert steps[0] == pytest.approx(steps[1], abs=0.2)


def test_values_that_an_axis_cannot_hold_are_left_out():
    assert len(markers(drawn(Series([0.0, 1, 10], [1, 1, np.nan]), x_log=True))) == 1
    assert len(markers(drawn(Series([1.0, 2, 3], [0, -1, 10]), y_log=True))) == 1
    assert len(markers(drawn(Series([-2.0, -1, 1, 2], [1, 1, 1, 1]), x_range=(-1, 1)))) == 2


def test_error_bars_are_as_long_as_the_error():
    root = drawn(Series([0, 1], [0, 10], error=[5, 2.5]))
    (_, y0), (_, y1) = markers(root)
    lengths = [abs(np.diff(bar[:, 1])[0]) for bar in corners(line_of(root, "before"))]
    assert lengths == pytest.approx([abs(y0 - y1), abs(y0 - y1) / 2], abs=0.3)


def test_a_line_has_a_band_as_wide_as_the_error_on_both_sides():
    root = drawn(Series([0, 1], [0, 10], error=[5, 2.5], style="line"))
    (line,) = corners(line_of(root, "before"))
    (band,) = (corners(p)[0] for p in root.iter(f"{SVG}path") if "opacity:0.22" in p.get("style"))
    (x0, y0), (x1, y1) = line
    half = (y0 - y1) / 2
    around = [[x0, y0 + half], [x1, y1 + half / 2], [x1, y1 - half / 2], [x0, y0 - half]]
    assert band[:4] == pytest.approx(np.array(around), abs=0.2)


def test_the_band_closes_at_a_point_whose_error_is_unknown():
    root = drawn(Series([0, 1, 2], [0, 10, 5], error=[5, np.nan, 5], style="line"))
    (line,) = corners(line_of(root, "before"))
    (band,) = (corners(p)[0] for p in root.iter(f"{SVG}path") if "opacity:0.22" in p.get("style"))
    assert band[[1, 4]] == pytest.approx(line[[1, 1]], abs=0.2)


def test_the_legend_has_the_series_with_a_label_and_ticks_their_texts():
    root = drawn(Series([0, 1], [0, 1], "named"), Series([0, 1], [1, 0]), x_ticks={0: "below", 1: "above"})
    assert len(markers(root)) == 4 + 1
    assert {"named", "below", "above"} < set(texts(root))


def test_an_error_bar_that_a_logarithmic_axis_cannot_hold_keeps_its_upper_end():
    root = drawn(Series([0, 1], [1, 10], error=[5, 0]), y_log=True)
    (_, y0), (_, y1) = markers(root)
    (bar,) = corners(line_of(root, "before"))
    assert y0 - bar[:, 1].min() == pytest.approx(np.log10(6) * (y0 - y1), abs=0.3)
    assert bar[:, 1].max() - y0 == pytest.approx(y0 - y1, abs=0.3), "down to a tenth of the value"


def test_steps_keep_each_value_up_to_the_next_point():
    root = drawn(Series([0, 1, 2], [0, 10, 30], style="steps"))
    (path,) = corners(line_of(root, "before"))
    assert path[0][1] == path[1][1] > path[2][1]
    assert path[1][0] == path[2][0] == pytest.approx((path[0][0] + path[-1][0]) / 2, abs=0.2)


def test_the_zero_line_is_in_the_axis_even_where_the_data_are_far_from_it():
    assert "0" in texts(drawn(Series([0, 1], [100, 110]), zero=True))


def test_small_spans_have_ticks_that_differ():
    numbers = [t for t in texts(drawn(Series([4.9999, 5.0001], [0, 1]))) if re.fullmatch(r"[45]\.?\d*", t)]
    assert len(numbers) > 1
    assert len(set(numbers)) == len(numbers)


def test_labels_of_a_logarithmic_axis_are_numbers_that_a_person_reads():
    seen = texts(drawn(Series([1e-9, 1], [1, 1]), x_log=True))
    assert {"1·10⁻⁹", "1"} & set(seen)
    assert not [text for text in seen if "$" in text or "e-" in text]


def test_a_logarithmic_axis_of_nearly_equal_values_has_a_decade_about_them():
    seen = texts(drawn(Series([30, 40], [5.0, 5.5]), y_log=True))
    assert [text for text in seen if text in ("1", "2", "5", "10", "20")] == ["2", "5", "10"]


def test_points_over_less_than_two_decades_lie_on_the_drawing():
    root = drawn(Series([0, 1, 2], [1.0, 5.0, 30.0]), y_log=True)
    assert all(0 < y < 265 for _, y in markers(root))


@pytest.mark.parametrize("values", [[20_000, 30_000], [0.0002, 0.0004]])
def test_ticks_show_five_digits_without_a_power_of_ten(values):
    root = drawn(Series([0, 1], values), x_ticks={0: "below"})
    numbers = [float(text) for text in texts(root) if text[0].isdigit()]
    assert min(values) <= max(numbers) <= max(values)


def test_a_plot_has_a_line_on_the_left_and_below_and_no_frame():
    paths = [p for p in drawn(Series([0], [0])).iter(f"{SVG}path") if "currentColor" in p.get("style", "")]
    # The other lines are the grid, which has the opacity 0.14.
    assert [p.get("style").count("opacity:0.7") for p in paths if "0.14" not in p.get("style")] == [1, 1]


def test_the_drawing_has_the_size_that_was_asked_for():
    assert drawn(Series([0], [0]), width=500, height=100).get("viewBox") == "0 0 500 100"


@pytest.mark.parametrize(
    "options", [{"x_ticks": {0: "from the left hand side", 1: "from the right hand side"}}, {"y_log": True}]
)
def test_labels_lie_on_the_drawing_however_long_the_ticks_are(options):
    root = drawn(Series([0, 1], [1e-9, 1e-8]), **options)
    for text in root.iter(f"{SVG}text"):
        upright = "rotate(-90" in text.get("transform")
        behind = {"start": 0, "middle": 0.5, "end": 1}[re.search(r"anchor:(\w+)", text.get("style"))[1]]
        width = 12 if upright else 6.5 * len(text.text)
        assert 0 <= float(text.get("x")) - (1 if upright else behind) * width <= 400 - width, text.text
        assert 9 <= float(text.get("y")) <= 262, text.text


@pytest.mark.parametrize(("letters", "per_row"), [(1, 3), (20, 2), (80, 1)])
def test_as_many_labels_as_fit_stand_side_by_side_above_the_axes(letters, per_row):
    names = [mark * letters for mark in "uvw"]
    root = drawn(*(Series([0, 1], [0, 1], name) for name in names))
    labels = [text for text in root.iter(f"{SVG}text") if text.text in names]
    heights = [float(text.get("y")) for text in labels]
    assert heights.count(min(heights)) == per_row
    left, _ = (corners(p)[0] for p in root.iter(f"{SVG}path") if "opacity:0.7" in p.get("style", ""))
    assert max(heights) < left[:, 1].min()


def test_series_take_four_looks_in_turn():
    root = drawn(*(Series([k], [k], role=None) for k in range(5)))
    looks = [(mark.get("href"), mark.get("style")) for mark in root.iter(f"{SVG}use")]
    assert len(set(looks)) == 4
    assert looks[4] == looks[0]


def test_a_model_is_a_thinner_line_than_the_data():
    root = drawn(*(Series([0, 1], [0, 1], role=role, style="line") for role in ("after", "model")))
    widths = [
        float(re.search(r"stroke-width:([\d.]+)", line_of(root, role).get("style"))[1])
        for role in ("after", "model")
    ]
    assert widths[0] > widths[1]


def test_before_and_after_differ_by_shape_and_not_by_colour_alone():
    root = drawn(Series([0], [0], "before"), Series([0], [1], "after"))
    styles = {marker.get("style") for marker in root.iter(f"{SVG}use")}
    hollow = {style for style in styles if "fill:var(--ground, none)" in style}
    full = {style for style in styles if "fill:var(--after," in style}
    assert len(hollow) == len(full) == 1
    dashes = [line_of(drawn(Series([0, 1], [0, 1], role=r, style="line")), r) for r in ("before", "after")]
    assert ["stroke-dasharray" in path.get("style") for path in dashes] == [True, False]


def test_every_colour_can_be_set_by_the_page():
    root = drawn(
        *(Series([0, 1], [k, k], "s", [1, 1], role) for k, role in enumerate(("before", "after"))),
        zero=True,
    )
    given = re.findall(r"(?:fill|stroke):([^;\"]+)", ET.tostring(root, encoding="unicode"))
    assert {value for value in given if not value.startswith("var(--")} <= {"none", "currentColor"}
    assert not re.search(r'(?:fill|stroke)="#', ET.tostring(root, encoding="unicode"))


def test_text_stays_text_in_the_pages_own_type():
    root = drawn(Series([0, 1], [0, 1], "a label"))
    assert {"x / s", "y / mg", "a label"} <= set(texts(root))
    assert "font-family:" not in ET.tostring(root, encoding="unicode")


def test_nothing_is_said_to_the_rest_of_the_page():
    root = drawn(Series([0, 1], [0, 1], "a label"))
    assert not list(root.iter(f"{SVG}style"))
    assert root.get("width") is None


def test_many_points_stay_a_small_drawing():
    x = np.arange(100_000.0)
    assert len(plot([Series(x, np.sin(x))], "x", "y", title="t")) < 60_000


def test_dots_are_as_many_as_points_and_the_legend_shows_their_marker():
    root = drawn(Series(np.arange(500.0), np.arange(500.0), "many"))
    assert line_of(root, "before").get("d").count("h0") == 500
    assert len(markers(root)) == 1


def test_four_hundred_points_have_markers_and_error_bars():
    root = drawn(Series(np.arange(400.0), np.arange(400.0), error=np.ones(400)))
    assert len(markers(root)) == len(corners(line_of(root, "before"))) == 400


@pytest.mark.parametrize("count", [2000, 5000])
def test_a_line_is_drawn_from_its_first_to_its_last_point_through_at_most_2000(count):
    x = np.linspace(0, 1, count)
    root = drawn(Series(x, x**2, style="line"), Series([0, 1], [0, 1]))
    (line,) = corners(line_of(root, "before"))
    assert len(line) == 2000
    assert line[[0, -1]] == pytest.approx(np.array(markers(root)), abs=0.1)


def test_coordinates_are_rounded_to_a_tenth():
    root = drawn(Series([0, 1 / 3, 1], [0, 1 / 7, 1], "s", [1 / 9] * 3))
    given = [element.get(key, "") for element in root.iter() for key in ("d", "x", "y", "transform")]
    assert not re.search(r"\.\d\d", " ".join(given))


def test_labels_are_escaped():
    bad = "<script>alert(1)</script> -->"
    text = plot([Series([0], [0], bad)], "<b>", "a & b", title="</title><i>")
    assert not re.search("<script|<b>|<i>|<!--", text)
    assert {bad, "<b>", "a & b"} <= set(texts(ET.fromstring(text)))


@pytest.mark.parametrize("label", ["$a_b$", "a $ b", r"$\frac$", "_hidden"])
def test_a_label_is_shown_as_it_is_written(label):
    assert label in texts(drawn(Series([0], [0], label)))


@pytest.mark.parametrize("description", ["", "what is seen"])
def test_screen_readers_get_title_and_description(description):
    root = drawn(Series([0], [0]), description=description)
    ids = {e.get("id"): e.text for e in root.iter() if e.get("id")}
    read = [ids[name] for name in root.get("aria-labelledby").split()]
    assert read == ["a title", description][: 2 if description else 1]
    assert root[0].tag == f"{SVG}title", "SVG wants the title first"


def test_no_two_plots_of_a_page_share_an_id_and_every_reference_is_met():
    plots = [
        drawn(Series([0, 1], [0, y], "s"), Series([1], [1], "t"), description=text)
        for y, text in ((1, ""), (2, ""), (2, "another session"))
    ]
    ids = [e.get("id") for root in plots for e in root.iter() if e.get("id")]
    assert len(set(ids)) == len(ids) >= 6
    for root in plots:
        own = {f"#{e.get('id')}" for e in root.iter() if e.get("id")}
        assert {e.get("href") for e in root.iter(f"{SVG}use")} <= own


def test_the_same_data_give_the_same_bytes_whatever_the_user_has_set():
    series = [Series([0, 1, 2], [0, 1, 4], "a", [1, 1, 1]), Series([0, 2], [0, 4], "b", style="line")]
    first = plot(series, "x", "y", title="t", zero=True)
    assert plot(series, "x", "y", title="t", zero=True) == first
    with mpl.rc_context(
        {"font.size": 30, "svg.fonttype": "path", "axes.labelcolor": "red", "ytick.right": True}
    ):
        assert plot(series, "x", "y", title="t", zero=True) == first
        assert mpl.rcParams["font.size"] == 30, "the user's settings are put back"


def test_an_empty_plot_is_still_a_plot():
    assert markers(drawn(Series([], []))) == []
    assert "x / s" in texts(drawn(Series([], [], "none"), x_log=True, y_log=True))


def test_figures_are_drawn_without_a_window_system_and_only_when_asked_for():
    code = (
        "import sys, adis_gonio.handover.calibration_report\n"
        "assert 'matplotlib' not in sys.modules\n"
        "from adis_gonio.page.document import Series, plot\n"
        "plot([Series([0], [0])], 'x', 'y', title='t')\n"
        "assert 'matplotlib' in sys.modules and 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


def test_without_matplotlib_one_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(NotInstalledError, match=r"pip install '\.\[report\]'"):
        plot([Series([0], [0])], "x", "y", title="t")
