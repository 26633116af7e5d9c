"""Every example of docs/files.md does what the page says; its tables are those of the code."""

import re
import shlex
from pathlib import Path

import pytest

from adis_gonio.faces.cli import main
from adis_gonio.record.samples_columns import COLUMNS, KEYS, recognise_column

PAGE = Path(__file__).parents[2] / "docs" / "files.md"
TEXT = PAGE.read_text(encoding="utf-8")
FORMAT = TEXT.partition("\n## Samples CSV\n")[2].partition("\n## ")[0]
BLOCKS = re.findall(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def calls():
    """(command line, words that it prints) of the page, in order."""
    listed = []
    for language, _, text in BLOCKS:
        for line in text.splitlines() if language in ("console", "sh") else ():
            if line.startswith(("$ ", "adis-gonio ")):
                listed.append((line.removeprefix("$ "), []))
            else:
                listed[-1][1].append(line)
    return listed


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("page")
    for language, name, text in BLOCKS:
        if language == "text" and name:
            (where / name).write_text(text, encoding="utf-8")
    return where


def squeezed(text):
    return " ".join(text.split())


def test_the_page_has_its_examples():
    assert len(calls()) >= 12
    assert sum(language == "python" for language, _, _ in BLOCKS) == 1


def test_every_command_prints_what_the_page_shows(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    for line, words in calls():
        status = main(shlex.split(line)[1:])
        printed = capsys.readouterr()
        shown = squeezed(printed.out + printed.err)
        for part in words:
            assert squeezed(part) in shown, (line, shown)
        refused = any(squeezed(part) in squeezed(printed.err) for part in words)
        assert (status != 0) == refused, (line, status)


def test_the_python_example_runs(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    (code,) = (text for language, _, text in BLOCKS if language == "python")
    exec(compile(code, str(PAGE), "exec"), {})
    assert "'reverse'" in capsys.readouterr().out


def test_every_column_and_key_of_the_code_is_in_the_format():
    rows = re.findall(r"^\| (`.*?) \|", FORMAT, re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == {*COLUMNS, *KEYS, "note"}


def test_every_option_of_the_page_is_one_of_the_command():
    from adis_gonio.faces.cli.fit_commands import fit_command

    rows = re.findall(r"^\| (`--.*?) \|", TEXT, re.MULTILINE)
    options = {option for row in rows for option in re.findall(r"`(--\w+)", row)}
    known = {name for option in fit_command.params for name in option.opts}
    assert (
        options
        == {"--angles", "--reverse", "--unit", "--gravity", "--fixture", "--sensor", "--columns"} & known
    )


def test_every_spelling_that_the_format_accepts_is_recognised():
    for row in ("header", "units in the header"):
        (cell,) = re.findall(rf"^\| {row} \| (.*?) \|$", FORMAT, re.MULTILINE)
        for name in re.findall(r"`([^`]+)`", cell):
            assert name in ("#", "numpy.savetxt") or recognise_column(name), name
