"""What commands share in showing: JSON, tables, numbers with their uncertainty."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, TypeVar

import click
import numpy as np
from rich.console import Console

F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="One JSON document on standard output.")
variant_option = click.option(
    "--variant", default="adis16354", show_default=True, help="adis16354, adis16350 or adis16355."
)
poll_option = click.option(
    "--poll", is_flag=True, help="Poll the scans: leave the data-ready line alone, whatever is on it."
)
no_check_option = click.option(
    "--no-check", is_flag=True, help="Open without proving that |a| is 1 g for this variant."
)


def console(*, stderr: bool = False) -> Console:
    """Console without automatic colours; wide where a program reads it, so that no row is folded."""
    screen = Console(stderr=stderr, highlight=False)
    return screen if screen.is_terminal else Console(stderr=stderr, highlight=False, width=200)


def counted(number: int, name: str) -> str:
    """Number and name with its plural, such as `1 dwell` and `2 dwells`."""
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def json_text(document: Any) -> str:
    """One JSON document as text; what is not finite becomes null."""
    return json.dumps(_plain(document), ensure_ascii=False, indent=2, allow_nan=False)


def print_json(document: Any) -> None:
    """Write one JSON document to standard output."""
    click.echo(json_text(document))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def with_uncertainty(value: float, u: float | None) -> str:
    """Value rounded to two digits of its standard uncertainty, such as `0.00108 ± 0.00013`."""
    if u is None or not math.isfinite(u) or u <= 0:
        return f"{value:.6g}"
    digits = max(0, 1 - math.floor(math.log10(u)))
    return f"{value:.{digits}f} ± {u:.{digits}f}"
