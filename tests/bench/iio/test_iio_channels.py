"""Formats of IIO samples, and what a session takes of a device."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from adis_gonio.base.errors import CannotOpenError
from adis_gonio.bench.iio_devices import BufferLayout, IioChannel, SampleFormat, choose_channels


@pytest.mark.parametrize(
    ("text", "stored", "number"),
    [
        ("le:s14/16>>0", b"\xff\x3f", -1),
        ("le:s14/16>>0", b"\xff\xdf", 0x1FFF),  # what stands above the number is not of it
        ("le:s12/16>>4", b"\xf0\xff", -1),
        ("be:s13/16>>3", b"\xff\xf8", -1),
        ("be:u12/16>>0", b"\xff\xff", 4095),
        ("le:S16/16>>0", b"\x00\x80", -32768),
        ("le:u8/8>>0", b"\xff", 255),
        ("le:s24/32>>8", b"\x00\x00\x00\x80", -(1 << 23)),
        ("le:s64/64>>0", b"\xff" * 8, -1),
        ("le:s16/16X1>>0", b"\x01\x00", 1),
    ],
)
def test_a_sample_is_shifted_masked_and_sign_extended(text, stored, number):
    form = SampleFormat.parse(text)
    assert form.numbers(np.frombuffer(stored, form.dtype)).tolist() == [number]


@given(st.integers(1, 31), st.integers(0, 31), st.booleans(), st.booleans(), st.integers())
def test_every_number_comes_back(bits, shift, signed, big, value):
    if bits + shift > 32:
        shift = 32 - bits
    form = SampleFormat(big, signed, bits, 32, shift)
    low = -(1 << bits - 1) if signed else 0
    number = low + value % (1 << bits)
    word = (number & (1 << bits) - 1) << shift
    stored = word.to_bytes(4, "big" if big else "little")
    assert form.numbers(np.frombuffer(stored, form.dtype)).tolist() == [number]


@pytest.mark.parametrize(
    "text", ["", "s14/16", "le:s14/16", "le:s14/12>>0", "le:s16/16X3>>0", "le:s9/8>>0"]
)
def test_what_cannot_be_read_is_refused(text):
    with pytest.raises(CannotOpenError, match="format"):
        SampleFormat.parse(text)


def test_scans_are_laid_out_by_index_and_aligned():
    small, time = SampleFormat.parse("le:s16/16>>0"), SampleFormat.parse("le:s64/64>>0")
    layout = BufferLayout([IioChannel("timestamp", 5, time), IioChannel("accel_x", 2, small)])
    assert layout.size == 16
    scan = b"\x07\x00" + b"\xee" * 6 + (99).to_bytes(8, "little")
    numbers = layout.numbers(scan * 2)
    assert numbers["accel_x"].tolist() == [7, 7]
    assert numbers["timestamp"].tolist() == [99, 99]


def test_units_are_those_of_a_session():
    x = IioChannel("accel_x", scale=0.0098, offset=10)
    assert x.values(np.array([90])) == pytest.approx([100 * 0.0098 / 9.80665 * 1000])
    assert IioChannel("anglvel_z", scale=np.pi / 180).values(np.array([3])) == pytest.approx([3])
    assert IioChannel("temp", scale=100, offset=20).values(np.array([230])) == pytest.approx([25])


def test_a_session_takes_three_axes_and_one_column_of_each_kind():
    accel = [IioChannel(f"accel_{axis}") for axis in "xyz"]
    names = [
        c.id
        for c in choose_channels(
            [*accel, IioChannel("temp_x"), IioChannel("temp0"), IioChannel("light")], ""
        )
    ]
    assert names == ["accel_x", "accel_y", "accel_z", "temp0"]
    assert [c.id for c in choose_channels([*accel, IioChannel("anglvel_x")], "")] == names[
        :3
    ]  # one gyro is no use
    with pytest.raises(CannotOpenError, match=r"accel_y, accel_z missing"):
        choose_channels(accel[:1], "iio:device0")
