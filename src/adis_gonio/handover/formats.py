"""The formats of `adis-gonio export`, one row of a table each.

A new format is a function in this package and a row of `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, Literal

from adis_gonio.base.errors import UsageError


@dataclass(frozen=True)
class Format:
    """A format in which `adis-gonio export` writes a file.

    Attributes
    ----------
    name : str
        Value of the option `--format` that selects this format.
    endings : tuple of str
        Endings of a file's name that select this format.
    holds : {"coefficients", "samples", "document"}
        Content of the file: a calibration, the samples of a session, or the JSON document.
    writer : str
        Function as `module:function`. For coefficients it takes a `Calibration` and returns a text; for
        samples it takes a `Session` and a path and writes the file. Empty for the JSON document.
    options : tuple of str
        Options of the command that apply to this format alone; the function of coefficients takes them by
        name.
    meaning : str
        Content in a few words, for the help.
    """

    name: str
    endings: tuple[str, ...]
    holds: Literal["coefficients", "samples", "document"]
    writer: str = ""
    options: tuple[str, ...] = ()
    meaning: str = ""

    def function(self) -> Callable[..., Any]:
        """Import the function that writes this format."""
        function: Callable[..., Any] = resolve_name(f"adis_gonio.{self.writer}")
        return function


FORMATS = (
    Format(
        "c-header",
        (".h", ".hpp"),
        "coefficients",
        "handover.c_header:c_header",
        options=("name",),
        meaning="gravity and angle in C, fixed point and float",
    ),
    Format("json", (".json",), "document", meaning="calibration, fit or trace, facts of the session"),
    Format(
        "csv",
        (".csv", ".csv.gz"),
        "samples",
        "record.samples_writer:write_samples_csv",
        meaning="samples, which adis-gonio fit reads back",
    ),
    Format(
        "parquet",
        (".parquet",),
        "samples",
        "handover.session_export:write_parquet",
        meaning="samples (extra: parquet)",
    ),
    Format(
        "dcc",
        (".xml",),
        "coefficients",
        "handover.certificate:certificate_text",
        options=("tolerance",),
        meaning="digital calibration certificate",
    ),
    Format(
        "registers",
        (".txt",),
        "coefficients",
        "handover.register_offsets:registers_text",
        meaning="offsets, which adis-gonio registers takes",
    ),
)
BY_NAME = {one.name: one for one in FORMATS}


def format_of(name: str) -> str:
    """Return the name of the export format for the ending of a file name, else raise `UsageError`."""
    for one in FORMATS:
        if name.lower().endswith(one.endings):
            return one.name
    endings = ", ".join(ending for one in FORMATS for ending in one.endings)
    raise UsageError(f"{name}: no format has this ending; use {endings}, or --format")
