"""A session that the tests of this folder share, each with a copy of its own."""

import shutil

import pytest

from bench.writeback.rig import new_bus, record


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """Four positions of part 3, whose hidden biases are some 15 mg on X and Y."""
    return record(tmp_path_factory.mktemp("write") / "part3.session", new_bus(3))


@pytest.fixture
def path(recorded, tmp_path):
    """A copy of it."""
    return shutil.copy(recorded, tmp_path / "part3.session")
