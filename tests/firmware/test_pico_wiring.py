"""The Pico's wiring: page and picture say what the firmware does."""

from __future__ import annotations

import re

import pytest

from firmware.pico_build import PORT

# Signal of the sensor, name of its pin in main.c, physical pin by the Pico's pin-out (GP16 to GP21).
SIGNALS = {
    "DOUT": ("MISO", 21),
    "CS": ("CS", 22),
    "SCLK": ("SCK", 24),
    "DIN": ("MOSI", 25),
    "DIO1": ("DATA_READY", 26),
    "RST": ("RST", 27),
}
PAGE = PORT.parents[1] / "docs" / "hardware.md"
GPIO_OF_PIN = {21: 16, 22: 17, 24: 18, 25: 19, 26: 20, 27: 21}


def gpio(name: str) -> int:
    found = re.search(rf"^#define {name} (\d+)u$", (PORT / "main.c").read_text(), re.MULTILINE)
    assert found
    return int(found[1])


@pytest.mark.parametrize("signal", SIGNALS)
def test_page_picture_and_firmware_name_the_same_pin(signal):
    name, pin = SIGNALS[signal]
    number = gpio(name)
    assert GPIO_OF_PIN[pin] == number
    assert re.search(rf"^\| {signal} \| GP{number}\b[^|]*\| {pin} \|", PAGE.read_text(), re.MULTILINE)
    drawn = re.findall(r'<text x="\d+" y="(\d+)"[^>]*>([^<]+)</text>', (PORT / "wiring.svg").read_text())
    heights = {text.split()[0]: int(y) for y, text in drawn}
    assert abs(heights[f"GP{number}"] - heights[signal]) <= 2
    assert abs(heights[str(pin)] - heights[signal]) <= 10
