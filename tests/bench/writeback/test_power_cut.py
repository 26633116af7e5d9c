"""A power cut at each frame of write and undo leaves the old or the new offsets; the next start says which.

`test_after_each_frame…` runs the procedure once. At each frame it asks for the content of a part without
power from then on, and for the report and action of the next start. `test_a_cut…` really cuts, before and
after each frame that writes, at every fifth of the others outside the dwells and at some within, while the
host goes on against a dead line or against a part that has restarted.
"""

import shutil
from collections import Counter

import pytest

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.writeback import OffsetWriter, WriteSettings, offset_checks
from adis_gonio.device.sensor import Adis16354
from adis_gonio.fitting import fit
from adis_gonio.record.archive import Archive
from adis_gonio.record.provenance import digest_of
from bench.writeback.rig import flash, new_bus, numbers

SAVE = WriteSettings(save=True, dwell_s=0.05)
OLD, NEW = (0, 0, 0), (-32, -34, 0)
SAVE_FRAME = 0xBE08
DWELL_FRAMES = 100
"""Batches of at least so many frames are a dwell's."""


@pytest.fixture(autouse=True, scope="module")
def _one_fit():
    """Fit the session once: its copies have the same dwells, which no cut and no write changes."""
    fits = {}

    def remembered(session, *args, **options):
        key = (digest_of(session), args, tuple(options.items()))
        if key not in fits:
            fits[key] = fit(session, *args, **options)
        return fits[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(offset_checks, "fit", remembered)
        yield


def writer(bus, path, settings=SAVE):
    return OffsetWriter(Adis16354(bus), path, settings)


def wrote(bus, path):
    made = writer(bus, path)
    made.plan()
    return made.write()


def state(bus):
    return flash(bus), bus.chip.memory["ENDURANCE"]


class EachFrame:
    """Notes after each frame what the flash holds and how long the journal is, and keeps its states."""

    def __init__(self, bus, path, folder, monkeypatch):
        self.seen, self.files, self.path, self.folder = Counter(), {}, path, folder
        self.at_frame: list[tuple] = []
        exchange, add = bus._exchange, Archive.add_record

        def one_by_one(frames):
            replies = frames.copy()
            for k in range(len(frames)):
                replies[k] = exchange(frames[k : k + 1])[0]
                self.seen[(*state(bus), len(self.files))] += 1
            return replies

        def noted(archive, *args):
            add(archive, *args)
            self.keep()

        bus._exchange = one_by_one
        monkeypatch.setattr(Archive, "add_record", noted)
        self.keep()

    def keep(self):
        # Between two commits an SQLite file with a rollback journal is whole.
        count = len(self.files) + 1
        self.files[count] = shutil.copy(self.path, self.folder / f"{count}.session")


def next_start(tmp_path, file, held, endurance):
    """A new process finds a part that was switched on with this in its flash."""
    names = dict(zip(("XACCL_OFF", "YACCL_OFF", "ZACCL_OFF"), held, strict=True))
    bus = new_bus(3, flash=names, endurance=endurance)
    copy = shutil.copy(file, tmp_path / "next.session")
    return bus, copy


@pytest.mark.parametrize("what", ["write", "undo"])
def test_after_each_frame_a_part_without_power_is_old_or_new_and_the_next_start_says_and_ends_it(
    path, tmp_path, monkeypatch, what
):
    bus = new_bus(3)
    if what == "undo":
        wrote(bus, path)
    made = writer(bus, path)
    with monkeypatch.context() as patched:
        each = EachFrame(bus, path, tmp_path, patched)
        if what == "write":
            made.plan()
        outcome = getattr(made, what)()
    first, last = (OLD, NEW) if what == "write" else (NEW, OLD)
    start = 0 if what == "write" else 1
    assert outcome.endurance_after == start + 1
    assert sum(each.seen.values()) > (10_000 if what == "write" else 20)
    assert {held for held, _, _ in each.seen} == {first, last}
    for (held, endurance, length), frames in each.seen.items():
        where = f"{what}, {frames} frames with flash {held}, ENDURANCE {endurance}, journal {length}"
        bus, copy = next_start(tmp_path, each.files[length], held, endurance)
        standing = writer(bus, copy).standing()
        assert standing.registers in ("untouched", "old", "new"), where
        assert numbers(bus) == (NEW if standing.registers == "new" else OLD), where
        assert standing.registers in standing.text or standing.registers == "untouched"
        again = wrote(bus, copy)
        assert numbers(bus) == flash(bus) == NEW, where
        assert again.standing.registers == "new"
        assert again.standing.saved
        assert not again.standing.open
        # Never twice: what is in flash already is not saved again.
        assert bus.chip.memory["ENDURANCE"] == endurance + (held != NEW), where
        bus, copy = next_start(tmp_path, each.files[length], held, endurance)
        taken_back = writer(bus, copy)
        if taken_back.known and taken_back.known[-1].open:
            taken_back.undo()
        if what == "write" and held == NEW:
            assert taken_back.known, where
        if taken_back.known and (taken_back.known[-1].op, held) != ("write", NEW):
            assert numbers(bus) == OLD, where


def frames_to_cut(tmp_path, recorded):
    """Frames of an undisturbed write after which to cut: around each that writes, every fifth of the others
    that are no dwell's (every fifteenth before the first write), one in the middle of some dwells."""
    bus = new_bus(3)
    made = OffsetWriter(Adis16354(bus), shutil.copy(recorded, tmp_path / "count.session"), SAVE)
    bus.arm()
    exchange, cuts, within = bus._exchange, [], []

    def noted(frames):
        mine = range(bus.frames, bus.frames + len(frames))
        if len(frames) < DWELL_FRAMES:
            writing = [number for number, frame in zip(mine, frames, strict=True) if frame & 0x8000]
            cuts.extend([*writing, *(number + 1 for number in writing), *mine[:: 5 if wrote else 15]])
        else:
            within.append(mine[len(mine) // 2])
            assert not (frames & 0x8000).any(), "a dwell only reads"
        return exchange(frames)

    bus._exchange, wrote = noted, False
    made.plan()
    wrote = True
    made.write()
    return sorted({*cuts, *within[:: max(1, len(within) // 6)]})


def ends_new(bus, path):
    """Writing again brings everything to its end."""
    again = wrote(bus, path)
    assert (numbers(bus), flash(bus)) == (NEW, NEW)
    assert (again.standing.registers, again.standing.saved, again.standing.open) == ("new", True, False)


@pytest.mark.parametrize("back", [False, True], ids=["off", "dip"])
def test_a_cut_with_the_host_going_on_ends_old_or_new_and_writing_again_ends_new(recorded, tmp_path, back):
    told, ended = Counter(), set()
    for cut in frames_to_cut(tmp_path, recorded):
        bus = new_bus(3, cut_after=cut, back=back)
        path = shutil.copy(recorded, tmp_path / "cut.session")
        made = writer(bus, path)
        bus.arm()
        try:
            made.plan()
            assert made.write().standing.registers == "new", cut
            assert numbers(bus) == NEW, cut
        except AdisGonioError as error:
            told[str(error)] += 1
        bus.armed = False
        commands = bus.log.count(SAVE_FRAME)
        bus.power_on()
        again = writer(bus, path)
        standing = again.standing()
        assert standing.registers in ("untouched", "old", "new"), (cut, standing)
        assert numbers(bus) == flash(bus) == (NEW if standing.registers == "new" else OLD), (cut, standing)
        assert bus.chip.memory["ENDURANCE"] <= commands, cut
        if not back:
            assert bus.chip.memory["ENDURANCE"] == (flash(bus) == NEW), cut
        steps = again.known[-1].steps if again.known else ()
        kind = (standing.registers, standing.saved, steps, bus.chip.memory["ENDURANCE"])
        if kind not in ended:
            ended.add(kind)
            ends_new(bus, path)
            assert bus.chip.memory["ENDURANCE"] == kind[-1] + (standing.registers != "new"), cut
    assert sum(told.values()) > 30, told
    assert len(ended) > (4 if back else 5), ended
    assert all("\n" not in line for line in told)
