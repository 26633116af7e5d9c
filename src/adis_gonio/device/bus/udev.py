"""The udev rules that let a user open the bridges on Linux."""

from __future__ import annotations

from importlib.resources import files

RULES_FILE = "70-adis-gonio.rules"
"""Name of the rules, here and in /etc/udev/rules.d; below 73, where uaccess tags are acted upon."""


def udev_rules() -> str:
    """The rules file as text."""
    return files("adis_gonio.device.bus").joinpath(RULES_FILE).read_text(encoding="utf-8")


def udev_rule(words: str) -> str:
    """First rule that holds every one of some words, such as `hidraw 04d8`.

    Raises
    ------
    LookupError
        No rule does.
    """
    for line in udev_rules().splitlines():
        if not line.startswith("#") and line and all(word in line for word in words.split()):
            return line
    raise LookupError(f"no udev rule holds '{words}'")
