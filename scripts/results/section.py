"""A section of the results: its numbers and figures, and the amount of work that it may take."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Effort:
    """Amount of work.

    Attributes
    ----------
    fast : bool
        If true, a few sessions only: a test that the section runs.
    seed : int
        Everything that is drawn comes from here.
    jobs : int
        Processes at most.
    """

    fast: bool
    seed: int
    jobs: int = 1

    def generator(self) -> np.random.Generator:
        """Make a generator that repeats its draws for this seed."""
        return np.random.default_rng(self.seed)

    def sessions(self, full: int, fast: int) -> int:
        """Number of sessions to draw."""
        return fast if self.fast else full


@dataclass(frozen=True)
class Section:
    """One section, written to `docs/results/NAME.json` and `NAME-FIGURE.svg`.

    Attributes
    ----------
    document : mapping
        Numbers as JSON; `page.py` writes the text of docs/results/index.md from them.
    figures : mapping
        SVG texts by the figure's name.
    """

    document: Mapping[str, Any]
    figures: Mapping[str, str] = field(default_factory=dict)


def svg(figure: Figure) -> str:
    """SVG text of a figure, without a date."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()
