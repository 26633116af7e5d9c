"""Calibration files: a JSON document, read with a limit on its size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, one_line
from adis_gonio.base.jsonable import json_value
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.document import calibration_from

LARGEST_BYTES = 10_000_000
"""Of a calibration file; it has some ten thousand."""


def calibration_in(path: str | Path) -> Calibration | None:
    """Calibration of a JSON file; None where the file begins as no JSON does.

    Raises
    ------
    DataError
        It is JSON, but no calibration, or damaged.
    """
    document = json_document(Path(path))
    return None if document is None else calibration_from(document, str(path))


def json_document(path: Path) -> Any:
    """Document of a file that begins as JSON does; None for others, which `load_session` judges.

    Its texts are printable lines, since they end in messages, comments and pages.
    """
    try:
        with path.open("rb") as file:
            content = file.read(64)
            if content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] not in (b"{", b"["):
                return None
            content += file.read(LARGEST_BYTES)
    except OSError:
        return None
    if len(content) > LARGEST_BYTES:
        raise DataError(f"{path}: is no calibration: it has more than {LARGEST_BYTES // 1_000_000} MB")
    try:
        return _printable(json_value(content.decode("utf-8-sig"), parse_constant=float))
    except ValueError as error:
        raise DataError(f"{path}: is no JSON: {error}") from None


def _printable(value: Any) -> Any:
    """A JSON value with each of its texts as one printable line."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, list):
        return [_printable(entry) for entry in value]
    if isinstance(value, dict):
        return {one_line(key): _printable(entry) for key, entry in value.items()}
    return value
