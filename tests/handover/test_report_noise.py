"""The noise at rest in the report: the numbers of `allan`, and only where rests say something."""

import json
import re
from xml.etree import ElementTree

import pytest

from adis_gonio.faces.cli import main
from adis_gonio.handover.gyro_report import noise_section
from allan_statistics import Case
from handover.rests import rests, rests_csv


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return rests_csv(tmp_path_factory.mktemp("noise") / "rests.csv")


def test_the_report_shows_what_allan_says_and_nothing_else(recording, tmp_path, capsys):
    assert main(["allan", str(recording), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert main(["allan", str(recording), "-o", str(tmp_path / "noise.html")]) == 0
    assert main(["report", str(recording), "-o", str(tmp_path / "report.html")]) == 0
    alone, page = ((tmp_path / name).read_text("utf-8") for name in ("noise.html", "report.html"))
    assert "Noise of the gyros at rest" in page
    present = 0
    for axis in told["axes"].values():
        for name, found in axis["parameters"].items():
            if found["present"]:
                rows = [row for row in rows_of(page) if row[0] == name.replace("_", " ")]
                assert any(agrees(row[1], found["value"]) and agrees(row[2], found["u"]) for row in rows)
                present += 1
    assert present >= 4
    of_noise = [row for row in rows_of(alone) if row in rows_of(page)]
    assert of_noise == rows_of(alone)


def rows_of(page):
    """Cells of the tables' rows."""
    rows = re.findall(r"<tr>(.*?)</tr>", page, re.DOTALL)
    return [
        [re.sub(r"<[^>]+>", "", cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row)] for row in rows
    ]


def agrees(shown, exact):
    digits = len(re.sub(r"^0\.0*|\.|·.*", "", shown))
    return "·" not in shown and float(shown) == pytest.approx(exact, rel=0.51 * 10.0 ** (1 - digits))


def test_each_axis_has_its_plot_with_title_and_description():
    section = noise_section(rests(2, 40))
    assert [part.title for part in section.parts] == ["X", "Y", "Z"]
    for axis, part in zip("XYZ", section.parts, strict=True):
        (figure,) = part.figures
        root = ElementTree.fromstring(figure.svg)
        title, described = (root.find(f"{{*}}{tag}").text for tag in ("title", "desc"))
        assert title == f"Allan deviation of {axis.lower()}"
        assert re.match(
            rf"{axis}: from 0\.\d+ °/s at 0\.0100 s to .*, least 0\.\d+ °/s at \S+ s\.", described
        )
        assert root.get("role") == "img"
        ticks = [t for t in root.iter() if t.tag.endswith("}text") and t.text in {"0.1", "1", "10"}]
        places = {t.text: float(t.get("x")) for t in ticks if t.get("style") == "text-anchor:middle"}
        assert places["10"] - places["1"] == pytest.approx(places["1"] - places["0.1"], abs=0.2)
        names = {root.find(f"{{*}}{tag}").get("id") for tag in ("title", "desc")}
        assert set(root.get("aria-labelledby").split()) == names


def test_short_rests_without_slow_noise_and_sensors_without_gyros_say_nothing():
    quiet = Case({"white": 0.05}, 1 << 11, 2)
    assert noise_section(rests(2, 10, noisy=quiet)) is None
    assert noise_section(rests(2, 40, gyros=False)) is None


def test_a_long_rest_without_slow_noise_says_how_little_there_can_be():
    quiet = Case({"white": 0.05}, 1 << 12, 2)
    section = noise_section(rests(1, 40, noisy=quiet))
    assert all(
        any("not separately detected, at most" in point for point in part.points) for part in section.parts
    )


def test_short_rests_that_show_slow_noise_are_shown():
    loud = Case({"white": 0.02, "flicker": 0.1}, 1 << 11, 2)
    section = noise_section(rests(3, 10, noisy=loud))
    assert any(row[0] == "bias instability" for part in section.parts for row in part.tables[0].rows)
