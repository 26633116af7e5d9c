"""Many sessions: fitted and traced by many processes or machines, kept in one store, and summarised.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "Cluster": "cluster",
    "Fleet": "run",
    "FoundEffect": "record",
    "LocalPool": "pool",
    "Options": "work",
    "SessionRecord": "record",
    "Store": "store",
    "Summary": "summary",
    "files_of": "files",
    "read_parquet": "parquet",
    "record_of": "work",
    "run_fleet": "run",
    "scan": "run",
    "summarise": "summary",
    "survey": "run",
    "write_parquet": "parquet",
}

__all__ = [
    "Cluster",
    "Fleet",
    "FoundEffect",
    "LocalPool",
    "Options",
    "SessionRecord",
    "Store",
    "Summary",
    "files_of",
    "read_parquet",
    "record_of",
    "run_fleet",
    "scan",
    "summarise",
    "survey",
    "write_parquet",
]

if TYPE_CHECKING:
    from adis_gonio.fleet.cluster import Cluster as Cluster
    from adis_gonio.fleet.files import files_of as files_of
    from adis_gonio.fleet.parquet import read_parquet as read_parquet
    from adis_gonio.fleet.parquet import write_parquet as write_parquet
    from adis_gonio.fleet.pool import LocalPool as LocalPool
    from adis_gonio.fleet.record import FoundEffect as FoundEffect
    from adis_gonio.fleet.record import SessionRecord as SessionRecord
    from adis_gonio.fleet.run import Fleet as Fleet
    from adis_gonio.fleet.run import run_fleet as run_fleet
    from adis_gonio.fleet.run import scan as scan
    from adis_gonio.fleet.run import survey as survey
    from adis_gonio.fleet.store import Store as Store
    from adis_gonio.fleet.summary import Summary as Summary
    from adis_gonio.fleet.summary import summarise as summarise
    from adis_gonio.fleet.work import Options as Options
    from adis_gonio.fleet.work import record_of as record_of


__getattr__ = lazily(__name__, _HOMES)
