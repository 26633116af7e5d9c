"""Structures and requests of the GPIO lines, compared with the kernel's own header by a C compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

from adis_gonio.device.bus import spidev

HEADER = Path("/usr/include/linux/gpio.h")
STRUCTURES = {
    "gpiochip_info": (spidev.ChipInfo, {"name": "name", "label": "label", "lines": "lines"}),
    "gpio_v2_line_info": (
        spidev.LineInfo,
        {"name": "name", "consumer": "consumer", "offset": "offset", "flags": "flags"},
    ),
    "gpio_v2_line_request": (
        spidev.LineRequest,
        {
            **{"offsets": "offsets", "consumer": "consumer", "flags": "config.flags"},
            **{"num_attrs": "config.num_attrs", "attrs": "config.attrs", "num_lines": "num_lines"},
            **{"event_buffer_size": "event_buffer_size", "fd": "fd"},
        },
    ),
    "gpio_v2_line_values": (spidev.LineValues, {"bits": "bits", "mask": "mask"}),
    "gpio_v2_line_config_attribute": (
        spidev._LineAttribute,
        {"id": "attr.id", "value": "attr.values", "mask": "mask"},
    ),
}
"""By the kernel's name: our structure, and the kernel's name of each of its fields."""
NUMBERS = {
    "GPIO_GET_CHIPINFO_IOCTL": spidev.GET_CHIP_INFO,
    "GPIO_V2_GET_LINEINFO_IOCTL": spidev.GET_LINE_INFO,
    "GPIO_V2_GET_LINE_IOCTL": spidev.GET_LINE,
    "GPIO_V2_LINE_SET_VALUES_IOCTL": spidev.SET_VALUES,
    "GPIO_V2_LINE_FLAG_OUTPUT": spidev.LINE_OUTPUT,
    "GPIO_V2_LINE_FLAG_OPEN_DRAIN": spidev.LINE_OPEN_DRAIN,
    "GPIO_V2_LINE_ATTR_ID_OUTPUT_VALUES": spidev.ATTRIBUTE_VALUES,
}


@pytest.fixture(scope="module")
def of_kernel(tmp_path_factory):
    """Numbers, sizes and offsets by their C expression."""
    if not HEADER.exists() or shutil.which("cc") is None:
        pytest.skip("needs cc and linux/gpio.h (Debian: gcc linux-libc-dev)")
    expressions = list(NUMBERS)
    for name, (_, fields) in STRUCTURES.items():
        expressions.append(f"sizeof(struct {name})")
        expressions += [f"offsetof(struct {name}, {theirs})" for theirs in fields.values()]
    lines = "".join(f'printf("%llu\\n", (unsigned long long)({one}));' for one in expressions)
    folder = tmp_path_factory.mktemp("gpio")
    source = folder / "numbers.c"
    source.write_text(
        "#include <linux/gpio.h>\n#include <stddef.h>\n#include <stdio.h>\n"
        f"int main(void) {{ {lines} return 0; }}\n"
    )
    subprocess.run(["cc", "-o", folder / "numbers", source], check=True, timeout=60)
    text = subprocess.run(
        [folder / "numbers"], check=True, capture_output=True, text=True, timeout=60
    ).stdout
    return dict(zip(expressions, map(int, text.split()), strict=True))


@pytest.mark.parametrize("name", NUMBERS)
def test_a_request_or_flag_has_the_number_of_the_header(name, of_kernel):
    assert NUMBERS[name] == of_kernel[name]


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_structure_has_the_size_and_the_offsets_of_the_header(name, of_kernel):
    ours, fields = STRUCTURES[name]
    assert ctypes.sizeof(ours) == of_kernel[f"sizeof(struct {name})"]
    for field, theirs in fields.items():
        assert getattr(ours, field).offset == of_kernel[f"offsetof(struct {name}, {theirs})"], field
