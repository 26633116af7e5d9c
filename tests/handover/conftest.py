import pytest

from adis_gonio.handover.paper_study import reproduce


@pytest.fixture(scope="package")
def small():
    """A study of two parts of each kind, in this process."""
    return reproduce(7, 2, jobs=1, draws=150)
