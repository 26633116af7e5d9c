"""Many sessions → the causes that they have in common, though too weak in each.

>>> from adis_gonio.fleet.population import evidence_of, trace_population
>>> result = trace_population([evidence_of(session) for session in sessions])  # doctest: +SKIP
>>> [common.effects for common in result.found]  # doctest: +SKIP
[('hysteresis',)]
"""

from adis_gonio.fleet.population.evidence import SessionEvidence, evidence_of
from adis_gonio.fleet.population.hierarchy import GROUPINGS, trace_population
from adis_gonio.fleet.population.result import Affected, Common, PopulationResult, Reach

__all__ = [
    "GROUPINGS",
    "Affected",
    "Common",
    "PopulationResult",
    "Reach",
    "SessionEvidence",
    "evidence_of",
    "trace_population",
]
