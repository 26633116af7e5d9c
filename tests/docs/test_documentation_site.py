"""The documentation: it builds without a warning, holds every page and package, and loads nothing."""

import html.parser
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import adis_gonio

ROOT = Path(__file__).resolve().parents[2]
FRONT_ENDS = {"adis_gonio.faces"}
"""Packages with commands and screens, not with functions to call."""


class Loads(html.parser.HTMLParser):
    """Addresses that a browser would fetch to show a page."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        if tag != "a":
            self.addresses += [value for key, value in attrs if key in ("src", "href", "srcset", "data")]


def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path):
    pytest.importorskip("furo", reason="extra docs")
    # Sphinx calls a page that no navigation holds, and a link that leads nowhere, a warning.
    command = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--conf-dir", "docs"]
    done = subprocess.run(
        [*command, "--doctree-dir", str(tmp_path / "trees"), ".", str(tmp_path / "site")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    pages = list((tmp_path / "site").rglob("*.html"))
    written = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("firmware_proto/*.md")]
    for source in written:
        assert tmp_path / "site" / source.relative_to(ROOT).with_suffix(".html") in pages
    loads = Loads()
    for page in pages:
        loads.feed(page.read_text("utf-8"))
    assert loads.addresses
    assert not [address for address in loads.addresses if re.match(r"(https?:)?//", address)]
    for sheet in (tmp_path / "site").rglob("*.css"):
        assert not re.search(r"(@import|url\()[\s'\"]*(https?:)?//", sheet.read_text("utf-8")), sheet
    theory = (tmp_path / "site" / "docs" / "theory.html").read_text("utf-8")
    assert theory.count("<math") > 20
    assert "$" not in re.sub(r"<(script|style).*?</\1>", "", theory, flags=re.S)


def test_every_public_package_is_in_the_reference():
    listed = set(
        re.findall(r"^   (adis_gonio\.[\w.]+)$", (ROOT / "docs/python.md").read_text("utf-8"), re.M)
    )
    packages = {
        f"adis_gonio.{module.name}" for module in pkgutil.iter_modules(adis_gonio.__path__) if module.ispkg
    }
    assert packages - FRONT_ENDS - listed == set()


def test_every_name_of_the_public_interface_has_a_docstring():
    for name in adis_gonio.__all__:
        if not name.startswith("__"):
            assert getattr(adis_gonio, name).__doc__, name
