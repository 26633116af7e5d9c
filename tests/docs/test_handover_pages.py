"""Pages with worked examples: what stands there is run, in order, as it stands there."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import adis_gonio
from adis_gonio.faces.cli import main

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (DOCS / page).read_text("utf-8"), re.M | re.S)


def shell(line: str) -> int:
    """Run a line of a page; of the shell's own language it may use $(grep -v '^#' FILE)."""

    def lines_without_comments(match: re.Match[str]) -> str:
        lines = Path(match[1]).read_text("utf-8").splitlines()
        return " ".join(one for one in lines if not one.startswith("#"))

    words = shlex.split(re.sub(r"\$\(grep -v '\^#' (\S+)\)", lines_without_comments, line))
    assert words[0] == "adis-gonio"
    return main(words[1:])


@pytest.fixture(scope="module")
def handed_over(tmp_path_factory):
    folder = tmp_path_factory.mktemp("handover")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in blocks("handover.md", "sh"):
            for line in block.splitlines():
                assert shell(line) == 0, line
        for block in blocks("handover.md", "python"):
            if "written.session" not in block:  # tests/docs/test_writing_page.py runs this one
                exec(compile(block, "handover.md", "exec"), {})
    return folder


def test_the_example_in_c_compiles_and_shows_the_calibration_s_angle(handed_over):
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed (scripts/install_rigs.sh)")
    (code,) = blocks("handover.md", "c")
    (handed_over / "main.c").write_text(code)
    options = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run(["gcc", *options, "main.c", "-o", "main"], cwd=handed_over, check=True, timeout=300)
    done = subprocess.run([handed_over / "main"], capture_output=True, text=True, check=True, timeout=300)
    gravity, udeg, deg = (float(word) for word in done.stdout.split())
    words = [int(word, 16) & 0x3FFF for word in re.search(r"words\[5\] = \{ (.*?) \}", code)[1].split(", ")]
    numbers = [word - 0x4000 if word & 0x2000 else word for word in words[:3]]
    calibration = adis_gonio.Calibration.load(handed_over / "goniometer.json")
    accel = np.array(numbers) * 0.4672
    assert gravity / 536870912 == pytest.approx(calibration.apply(accel)[0], abs=1e-7)
    assert udeg * 1e-6 == pytest.approx(float(calibration.angle(accel).angle_deg), abs=12e-6)
    assert deg == pytest.approx(udeg * 1e-6, abs=2e-4)


def test_offsets_of_the_page_take_their_part_out_of_the_bias(handed_over):
    before = adis_gonio.Calibration.load(handed_over / "goniometer.json")
    (line,) = re.findall(r"`(Calibration.*?with_offsets.*?)`", (DOCS / "handover.md").read_text("utf-8"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(handed_over)
        eval(line, {"Calibration": adis_gonio.Calibration})
    after = adis_gonio.Calibration.load(handed_over / "new.json")
    assert after["bias_x"].value == pytest.approx(before["bias_x"].value - 24 * 0.4672)
    text = (handed_over / "offsets.txt").read_text()
    assert "XACCL_OFF=-24" in text
    assert "YACCL_OFF=58" in text


def test_every_format_of_the_page_is_one_of_the_command():
    from adis_gonio.handover.formats import FORMATS

    rows = re.findall(r"^\| (`\..*?) \| `([a-z-]+)` \|", (DOCS / "handover.md").read_text("utf-8"), re.M)
    said = {ending: kind for endings, kind in rows for ending in re.findall(r"`(\.[a-z.]+)`", endings)}
    known = {ending: one.name for one in FORMATS for ending in one.endings if ending != ".hpp"}
    assert said == known


def test_the_page_on_python_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    for block in blocks("python.md", "python"):
        exec(compile(block, "python.md", "exec"), space)
    out = capsys.readouterr().out
    assert "9 of 9 positions" in out
    assert "ΔK" in out
    assert "give mg" in out
    shown = space["shown"]
    assert abs(float(shown.angle_deg) - 30.0) < max(0.2, 4 * float(shown.u_deg))
    smoothed = space["smoothed"]
    assert abs(float(smoothed.angle_deg) - 46.0) < 4 * float(smoothed.u_deg)
    assert space["gravity"].shape == (500, 2)
