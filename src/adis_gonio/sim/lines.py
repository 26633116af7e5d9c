"""The DIO lines: what drives them, in the order data-ready, alarm, general output (CHIP.md, A)."""

from __future__ import annotations

from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.sim.memory import Memory
from adis_gonio.sim.sampling import ALARM_BITS

_MISC = BY_NAME["MSC_CTRL"]
_ALARM = BY_NAME["ALM_CTRL"]
_GPIO = BY_NAME["GPIO_CTRL"]
_ANY_ALARM = ALARM_BITS[0] | ALARM_BITS[1]


def data_ready_enabled(memory: Memory) -> bool:
    """True where data-ready is on a line."""
    return bool(_MISC.field("data_ready").of(memory["MSC_CTRL"]))


def levels(memory: Memory, *, pulse: bool, status: int) -> tuple[int | None, int | None]:
    """Levels that the chip drives on DIO1 and DIO2; None where a line is an input.

    Parameters
    ----------
    pulse : bool
        True during the data-ready pulse.
    status : int
        STATUS; an alarm output follows its alarm bits (D: until STATUS is read).
    """
    gpio, alarm, misc = memory["GPIO_CTRL"], memory["ALM_CTRL"], memory["MSC_CTRL"]
    result: list[int | None] = [
        _GPIO.field(f"level{k}").of(gpio) if _GPIO.field(f"output{k}").of(gpio) else None for k in (1, 2)
    ]
    if _ALARM.field("output").of(alarm):
        active = bool(status & _ANY_ALARM)
        result[_ALARM.field("line").of(alarm)] = int(active == bool(_ALARM.field("polarity").of(alarm)))
    if data_ready_enabled(memory):
        result[_MISC.field("line").of(misc)] = int(pulse == bool(_MISC.field("polarity").of(misc)))
    return result[0], result[1]


def gpio_word(memory: Memory, external: tuple[int, int]) -> int:
    """GPIO_CTRL as read: the level of an input is what stands on the line."""
    word = memory["GPIO_CTRL"]
    for k, level in enumerate(external, 1):
        if not _GPIO.field(f"output{k}").of(word):
            mask = _GPIO.field(f"level{k}").mask
            word = word | mask if level else word & ~mask
    return word
