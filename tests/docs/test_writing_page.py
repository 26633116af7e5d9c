"""The example of docs/handover.md, command by command, with the outputs that it shows."""

import re
import shlex
from pathlib import Path

import pytest

from adis_gonio.faces.cli import main

PAGE = (Path(__file__).parents[2] / "docs" / "handover.md").read_text("utf-8")
CONSOLE = re.search(r"```console\n(.*?)```", PAGE, re.S)[1]
PYTHON = next(text for text in re.findall(r"```python\n(.*?)```", PAGE, re.S) if "offsets_lsb" in text)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


def alike(shown: str, got: str) -> None:
    """The same words, and numbers that differ by the last digit at most (another BLAS rounds otherwise)."""
    assert NUMBER.sub("#", shown).split() == NUMBER.sub("#", got).split()
    for a, b in zip(NUMBER.findall(shown), NUMBER.findall(got), strict=True):
        digits = len(a.partition(".")[2])
        assert float(b) == pytest.approx(float(a), abs=1.01 * 10**-digits if digits else 0), (shown, got)


def test_the_commands_give_what_the_page_shows_and_the_code_runs_on_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.split(r"^\$ adis-gonio ", CONSOLE, flags=re.M)[1:]
    assert len(blocks) == 3
    for block in blocks:
        line, _, shown = block.partition("\n")
        assert main(shlex.split(line)) == 0
        out = capsys.readouterr().out
        if shown:
            assert len(shown.splitlines()) == len(out.splitlines())
            for a, b in zip(shown.splitlines(), out.splitlines(), strict=True):
                alike(a, b)
    names: dict = {}
    exec(PYTHON, names)
    result, calibration = names["result"], names["calibration"]
    assert result["bias_x"].value == pytest.approx(15.2, abs=0.05)
    assert calibration["bias_x"].value == pytest.approx(-0.2, abs=0.05)
    assert calibration.provenance.offsets_lsb[0] == -33
