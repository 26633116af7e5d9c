"""A fleet's outcome as files: the page, JSON, Parquet; the ending says which."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.base.jsonable import finite, json_object
from adis_gonio.base.output import check_output, replacing, write_utf8
from adis_gonio.fleet.run import Fleet
from adis_gonio.fleet.summary import Summary, summarise
from adis_gonio.fleet.work import Options

if TYPE_CHECKING:
    from adis_gonio.fleet.population import PopulationResult

ENDINGS = (".parquet", ".json", ".html")


@dataclass(frozen=True)
class FleetResult:
    """A fleet with its summary: the same whoever worked on it, and in whatever order."""

    fleet: Fleet
    options: Options

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """One row a session (`adis_gonio.fleet.columns.COLUMNS`)."""
        return [record.row() for record in self.fleet.records]

    @cached_property
    def summary(self) -> Summary:
        """Of these rows."""
        return summarise(self.rows)

    @cached_property
    def population(self) -> PopulationResult | str | None:
        """What the sessions have in common; why nothing can be said of it; None where it was not asked."""
        if not self.options.evidence:
            return None
        from adis_gonio.fleet.population import SessionEvidence, trace_population

        known = [record.evidence for record in self.fleet.records if record.evidence is not None]
        try:
            return trace_population([SessionEvidence.from_dict(evidence) for evidence in known])
        except AdisGonioError as error:
            return str(error)

    @property
    def population_lines(self) -> tuple[str, ...]:
        """The same in words."""
        found = self.population
        if found is None:
            return ()
        return (f"No population trace: {found}.",) if isinstance(found, str) else found.summary()

    def as_dict(self) -> dict[str, Any]:
        """The JSON document: the summary, what was asked, and files that do not count."""
        found = self.population
        population = {"reason": found} if isinstance(found, str) else found
        return self.summary.as_dict() | json_object(
            options=self.options,
            repeated=self.fleet.repeated,
            **{} if found is None else {"population": population},
        )

    def write(self, path: Path) -> None:
        """Write to a file by its ending; a file that is there is replaced.

        Raises
        ------
        OutputError
            It cannot be written; what was there stays.
        """
        with replacing(path) as beside:
            if path.suffix.lower() == ".parquet":
                from adis_gonio.fleet.parquet import write_parquet

                about = {"software": f"adis-gonio {__version__}", "options": self.options.as_dict()}
                write_parquet(self.rows, beside, about)
            elif path.suffix.lower() == ".html":
                from adis_gonio.fleet.page import build_page

                write_utf8(beside, build_page(self.summary, self.fleet.repeated, self.population_lines))
            else:
                text = json.dumps(finite(self.as_dict()), ensure_ascii=False, indent=2, allow_nan=False)
                write_utf8(beside, text + "\n")


def check_outputs(paths: Sequence[Path], files: Sequence[str]) -> None:
    """Refuse before the work what could only fail after it.

    Raises
    ------
    UsageError
        An ending that is not known, or a file that is one of the sessions.
    OutputError, NotInstalledError
        It could not be written.
    """
    for path in paths:
        if path.suffix.lower() not in ENDINGS:
            raise UsageError(f"{path}: the ending of the file says what it is: {', '.join(ENDINGS)}")
        if str(path) in files:
            raise UsageError(f"{path}: is one of the sessions; name another file")
        check_output(path, force=True)
        if path.suffix.lower() == ".parquet":
            from adis_gonio.fleet.parquet import require_pyarrow

            require_pyarrow()
        elif path.suffix.lower() == ".html":
            from adis_gonio.page.svg import require_matplotlib

            require_matplotlib()
