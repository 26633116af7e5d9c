"""The folder of measured recordings: checksums, licences, size, and the conversions of its README."""

import gzip
import hashlib
import importlib.util
import re

import pytest

from recordings import LARGER, MEASURED

README = (MEASURED / "README.md").read_text(encoding="utf-8")
FILES = sorted(MEASURED.glob("*.csv.gz"))
LARGEST_BYTES = 6_000_000


def test_every_recording_has_its_checksum_in_the_readme():
    stated = dict(re.findall(r"^\| `(\S+\.csv\.gz)` \| `([0-9a-f]{64})` \|", README, re.MULTILINE))
    assert stated == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in FILES}


def test_every_licence_that_the_readme_names_is_there_and_no_other():
    linked = set(re.findall(r"\(LICENSES/(\S+)\)", README))
    assert linked == {path.name for path in (MEASURED / "LICENSES").iterdir()}


def test_the_folder_stays_small():
    assert sum(path.stat().st_size for path in MEASURED.rglob("*") if path.is_file()) <= LARGEST_BYTES


@pytest.mark.parametrize("name", ["adis16350_14_poses", "adis16350_xy_turn"])
def test_the_block_averages_are_those_of_the_source(name):
    """A missing source is no failure: its licence keeps it out of the clone."""
    spec = importlib.util.spec_from_file_location("average_blocks", MEASURED / "average_blocks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    here = gzip.decompress((MEASURED / f"{name}.csv.gz").read_bytes()).decode()
    source = LARGER / f"{name}.csv.gz"
    if not source.exists():
        assert "; each row is the mean of 20 samples" in here
        return
    assert module.average_blocks(gzip.decompress(source.read_bytes()).decode(), 20) == here
