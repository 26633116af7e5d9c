"""A page in headless Chromium, and what is wrong with it: layout (tests/rig_browser/audit.js), axe-core's
rules, console messages, requests. Playwright drives the system's Chromium.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

RIG = Path(__file__).parents[1] / "rig_browser"
AXE = RIG / "node_modules" / "axe-core" / "axe.min.js"
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
COLOURS = ["color-contrast"]
"""The rule that the colours of the dark scheme can break."""
A4_PX = 688
"""Width of A4 (210 mm) at 96 px an inch without the page's own margins of 14 mm."""


def chromium() -> str | None:
    """Where the browser is."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def missing() -> str:
    """What is missing to run the rig; empty where nothing is."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        return "playwright is not installed (pip install '.[rigs]')"
    if chromium() is None:
        return "Chromium is not installed (Debian: chromium)"
    if shutil.which("pdftotext") is None:
        return "pdftotext is not installed (Debian: poppler-utils)"
    if not AXE.is_file():
        return "axe-core is not installed (npm ci in tests/rig_browser)"
    return ""


_VIOLATIONS = """rules => axe.run(document, {runOnly: rules, resultTypes: ['violations']}).then(
    result => result.violations.map(({id, nodes: [first, ...more]}) =>
        `${id}: ${first.html.slice(0, 160)} and ${more.length} more: ${first.failureSummary}`))"""


class Tab:
    """One page, laid out; notes every console message, error and request from its start on."""

    def __init__(self, tab: Any, path: Path) -> None:
        self.tab = tab
        self.noise: list[str] = []
        tab.on("console", lambda message: self.noise.append(f"console: {message.text}"))
        tab.on("pageerror", lambda error: self.noise.append(f"error: {error}"))
        tab.on("dialog", lambda dialog: (self.noise.append(f"dialog: {dialog.message}"), dialog.dismiss()))
        tab.on("request", lambda request: self._asked(request.url, path))
        tab.goto(path.as_uri())

    def _asked(self, url: str, path: Path) -> None:
        if url != path.as_uri():
            self.noise.append(f"request: {url}")

    def audit(self, *, width: int | None = None, paper: bool = False) -> list[str]:
        """What a reader would stumble over at this width in px, or on paper."""
        self.tab.emulate_media(media="print" if paper else "screen")
        self.tab.set_viewport_size({"width": A4_PX if paper else width, "height": 900})
        found: list[str] = self.tab.evaluate(
            f"({(RIG / 'audit.js').read_text(encoding='utf-8')})({str(paper).lower()})"
        )
        return found

    def open_folds(self) -> None:
        """Show what is folded."""
        self.tab.evaluate("document.querySelectorAll('details').forEach(fold => { fold.open = true })")

    def axe(self, rules: Sequence[str] = RULES) -> list[str]:
        """Violations of axe-core's rules, with the first element of each; `rules` are tags or one rule."""
        self.tab.evaluate(AXE.read_text(encoding="utf-8"))
        return list(self.tab.evaluate(_VIOLATIONS, list(rules)))

    def faults(self) -> list[str]:
        """Violations on a narrow page with all folds open, those of colours in the dark, and all noise."""
        self.open_folds()
        self.tab.set_viewport_size({"width": 360, "height": 900})
        found = self.axe()
        self.tab.emulate_media(color_scheme="dark")
        return [*found, *self.axe(COLOURS), *self.noise]

    def pdf(self, path: Path) -> None:
        """Print to A4."""
        self.tab.emulate_media(media="print")
        self.tab.pdf(path=str(path), format="A4", prefer_css_page_size=True)


class Browser:
    """Headless Chromium."""

    def __init__(self, browser: Any) -> None:
        self._browser = browser

    @contextmanager
    def tab(self, path: Path) -> Iterator[Tab]:
        """Open a file in the light scheme."""
        context = self._browser.new_context(viewport={"width": 1000, "height": 900}, color_scheme="light")
        try:
            yield Tab(context.new_page(), path)
        finally:
            context.close()


@contextmanager
def browser() -> Iterator[Browser]:
    """Start Chromium; without its sandbox, which a container's root has not."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        chrome = driver.chromium.launch(
            executable_path=chromium(), args=["--no-sandbox", "--disable-dev-shm-usage"]
        )
        try:
            yield Browser(chrome)
        finally:
            chrome.close()
