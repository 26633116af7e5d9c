"""From dwells to a fitted model: readings and their noise, terms, and `Fit`. No files, no devices."""

from adis_gonio.fitting.estimation.fit import Fit, Values
from adis_gonio.fitting.estimation.readings import Readings, from_means, readings_of
from adis_gonio.fitting.estimation.terms import Basis, NamedTerm, NamelessTerm, Term

__all__ = [
    "Basis",
    "Fit",
    "NamedTerm",
    "NamelessTerm",
    "Readings",
    "Term",
    "Values",
    "from_means",
    "readings_of",
]
