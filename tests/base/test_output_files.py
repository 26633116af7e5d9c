"""Files that are made replace the old one whole or not at all."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from adis_gonio.base.errors import OutputError, UsageError
from adis_gonio.base.output import check_output, replacing


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def test_the_file_takes_its_place_when_the_block_ends(tmp_path):
    old = tmp_path / "a.csv.gz"
    old.write_text("old")
    with replacing(old) as beside:
        assert beside.parent == tmp_path
        assert beside.name.endswith("a.csv.gz")
        beside.write_text("new")
        assert old.read_text() == "old"
    assert content(tmp_path) == {"a.csv.gz": "new"}


def write_half(path: Path, error: BaseException) -> None:
    with replacing(path) as beside:
        beside.write_text("half")
        raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("x"), OSError(errno.EIO, "x", "other")])
@pytest.mark.parametrize("before", [{}, {"a.h": "old"}])
def test_any_failure_leaves_what_was_there(tmp_path, error, before):
    for name, text in before.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(type(error)) as raised:
        write_half(tmp_path / "a.h", error)
    assert raised.value is error
    assert content(tmp_path) == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_leaves_the_old_file_and_says_which(tmp_path):
    old = tmp_path / "a.html"
    old.write_text("old")
    with pytest.raises(OutputError, match=r"a\.html: cannot be written: No space left"):
        write_half(old, full_disk())
    assert content(tmp_path) == {"a.html": "old"}


def full_disk() -> OSError:
    """What write(2) says of a full disk: no file name is in it."""
    with pytest.raises(OSError, match="No space left") as raised, Path("/dev/full").open("wb", 0) as full:
        full.write(b"x")
    return raised.value


def test_a_folder_that_is_not_there_is_named_before_and_in_the_work(tmp_path):
    path = tmp_path / "none" / "a.h"
    with pytest.raises(OutputError, match="there is no folder"):
        check_output(path)
    with pytest.raises(OutputError, match=r"a\.h: cannot be written: No such file"), replacing(path):
        pass


def test_what_is_there_is_refused_unless_forced_and_a_folder_always(tmp_path):
    path = tmp_path / "a.h"
    path.write_text("old")
    with pytest.raises(UsageError, match=r"exists already.*--force"):
        check_output(path)
    assert check_output(path, force=True) == path
    with pytest.raises(UsageError, match="is a folder"):
        check_output(tmp_path, force=True)


def test_permissions_are_those_of_the_old_file_or_of_any_new_one(tmp_path):
    (tmp_path / "plain").write_text("")
    (tmp_path / "old").write_text("old")
    (tmp_path / "old").chmod(0o640)
    for name in ("new", "old"):
        with replacing(tmp_path / name) as beside:
            beside.write_text(name)
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert (tmp_path / "old").stat().st_mode & 0o777 == 0o640


def test_a_link_stays_and_a_pipe_is_written_to(tmp_path):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    with replacing(tmp_path / "link") as beside:
        beside.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"
    with replacing("/dev/null") as beside:
        beside.write_text("gone")
    assert Path("/dev/null").is_char_device()
