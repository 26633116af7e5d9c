"""Everything that a page names exists: commands with their options, modules, files."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import click
import pytest

from adis_gonio.faces.cli import app

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (".", "docs", "docs/results", "firmware_proto", "examples/*", "benchmarks/*")
PAGES = sorted(path for folder in FOLDERS for path in ROOT.glob(f"{folder}/*.md"))


def text_of(page):
    return page.read_text("utf-8")


def commands_of(page):
    """Lines `adis-gonio …` in the blocks of a page."""
    for block in re.findall(r"^```(?:sh|text|console)\b.*?\n(.*?)^```$", text_of(page), re.M | re.S):
        for line in block.splitlines():
            if found := re.match(r"(?:\$ )?(?:\.venv/bin/)?adis-gonio (.*)", line):
                yield found[1]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_the_page_takes_its_options(page):
    for line in commands_of(page):
        name, *words = shlex.split(re.sub(r"\$\(.*?\)", "", line), comments=True)
        command = app.get_command(click.Context(app), name)
        assert command is not None, line
        known = {
            option for parameter in command.params for option in parameter.opts + parameter.secondary_opts
        }
        used = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert used <= known | {"--help"}, line


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_module_of_the_page_can_be_imported(page):
    for name in set(re.findall(r"\badis_gonio(?:\.\w+)+", text_of(page))):
        parts = name.split(".")
        if name in ("adis_gonio.bus", "adis_gonio.session") and page.name == "CHANGELOG.md":
            continue  # names of the past
        if parts[1] in ("bus", "devices", "effects", "source"):
            continue  # groups of entry points
        found = import_module("adis_gonio")
        for k, part in enumerate(parts[1:], 2):
            if not hasattr(found, part):
                import_module(".".join(parts[:k]))
            found = getattr(found, part)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_of_the_page_exists(page):
    text = re.sub(r"^```python\n.*?^```$", "", text_of(page), flags=re.M | re.S)
    for name in set(re.findall(r"\b(?:scripts|src|tests)/[\w./]+\.\w+", text)):
        assert (ROOT / name).exists() or (page.parent / name).exists(), name
    for link in set(re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", text)):
        assert (page.parent / link).exists(), link


def test_every_page_that_the_source_names_exists():
    sources = [path for folder in ("src", "scripts", "examples") for path in ROOT.glob(f"{folder}/**/*.py")]
    for path in sources:
        for name in re.findall(r"\bdocs/[\w/]+\.md\b", path.read_text("utf-8")):
            assert (ROOT / name).exists(), (path, name)
