from collections.abc import Iterator

import pytest

from adis_gonio.handover.paper_study import reproduce
from handover.browser import Browser, browser


@pytest.fixture(scope="package")
def small():
    """A study of two parts of each kind."""
    return reproduce(7, 2)


@pytest.fixture(scope="module")
def chrome() -> Iterator[Browser]:
    """One Chromium for all pages of a module; while it runs, its event loop runs in this thread."""
    with browser() as started:
        yield started
