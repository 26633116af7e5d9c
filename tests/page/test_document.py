"""Pages: what is empty is left out, and no text breaks the page or a number."""

import pytest

from adis_gonio.page.document import KeyFigure, Section, Table, render


def page(*sections, **options):
    return render("Report", "part A7", shape="4 dwells", sections=sections, closing="End.", **options)


def test_a_row_has_a_cell_for_each_head():
    assert Table(["a", "b"], [["1", "2"]]).rows == [["1", "2"]]
    for row in (["1"], ["1", "2", "3"]):
        with pytest.raises(ValueError, match="2 heads"):
            Table(["a", "b"], [row])


def test_sections_and_parts_without_contents_are_left_out():
    text = page(
        Section("No words"),
        Section("No rows", tables=[Table(["head"], [])]),
        Section("No part", parts=[Section("Nothing")]),
        Section("Outer", parts=[Section("Nothing"), Section("Inner", words=["inside"])]),
        *(Section(f"With {k}", **one) for k, one in enumerate(({"points": ["x"]}, {"notes": ["x"]}))),
        Section("With key", key=[KeyFigure("ΔK", "0.01")]),
    )
    shown = ("Outer", "Inner", "inside", "With 0", "With 1", "With key", "ΔK")
    assert [title for title in shown if title not in text] == []
    hidden = ("No words", "No rows", "No part", "Nothing")
    assert [title for title in hidden if title in text] == []


def test_texts_are_escaped_and_cannot_turn_the_direction_of_writing():
    bad = "\x00\x07\x0e\x1b\x7f\x9b\u202a\u202e\u2066\u2069"
    text = page(Section("<b>", words=["-".join(bad), "tab\tand\nline"]))
    assert "&lt;b&gt;" in text
    assert "-".join("?" * len(bad)) in text
    assert "tab\tand\nline" in text


def test_a_number_breaks_only_before_its_uncertainty():
    text = page(Section("s", tables=[Table(["q / mg", "v"], [["bias", "1 234 ± 5 mg"]], numeric=(1,))]))
    assert "1\u00a0234 ±\u00a05\u00a0mg" in text
    assert "q /\u00a0mg" in text


def test_the_line_below_the_title_has_the_time_and_a_mark_for_a_simulation():
    section = Section("s", words=["w"])
    text = page(section, simulated=True, begun="2024-03-01T09:00:59+00:00")
    assert "2024-03-01 09:00 UTC" in text
    assert "simulated sensor" in text
    assert "simulated sensor" not in page(section)
