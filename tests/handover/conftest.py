from collections.abc import Iterator

import pytest

from handover.browser import Browser, browser


@pytest.fixture(scope="module")
def chrome() -> Iterator[Browser]:
    """One Chromium for all pages of a module; while it runs, its event loop runs in this thread."""
    with browser() as started:
        yield started
