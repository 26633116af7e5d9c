"""Which angle may have been meant where another one is declared: what hands do to numbers."""

from __future__ import annotations

from collections.abc import Iterable

DIGITS = "0123456789"
LARGEST_DEG = 360.0


def may_have_been_meant(declared_deg: float, others_deg: Iterable[float] = ()) -> tuple[float, ...]:
    """Angles that become `declared_deg` by one mistake, without itself.

    A sign, a quarter or half turn (90 for 270), two digits exchanged, one digit wrong, dropped or doubled,
    a decimal point misplaced; or the angle of another position of the session.
    """
    text = f"{abs(declared_deg):g}"
    sign = -1.0 if declared_deg < 0 else 1.0
    written = {text[:k] + text[k + 1] + text[k] + text[k + 2 :] for k in range(len(text) - 1)}
    written |= {text[:k] + text[k + 1 :] for k in range(len(text))}
    written |= {text[:k] + digit + text[k:] for k in range(len(text) + 1) for digit in DIGITS}
    written |= {
        text[:k] + digit + text[k + 1 :] for k in range(len(text)) if text[k] != "." for digit in DIGITS
    }
    found = {sign * value for value in map(_number, written) if value is not None}
    found |= {-declared_deg, 10 * declared_deg, declared_deg / 10}
    found |= {declared_deg + turn for turn in (-180.0, -90.0, 90.0, 180.0)}
    found |= set(others_deg)
    return tuple(sorted(v + 0.0 for v in found if abs(v) <= LARGEST_DEG and v != declared_deg))


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
