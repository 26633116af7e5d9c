"""Many sessions: fitted and traced by many processes or machines, kept in one store, and summarised.

Public names are imported when they are first used.
"""

from adis_gonio.base import lazily

_HOMES = {
    "calibration_due": "Rules due_of",
    "fleet_run": "Fleet run_fleet scan session_files",
    "fleet_summary": "summarise",
    "population_trace": "trace_population",
    "sensor_history": "history_of",
    "session_evidence": "SessionEvidence evidence_of",
    "session_record": "Options SessionRecord record_of write_parquet",
    "store": "Store",
    "workers": "Cluster LocalPool",
}
__getattr__ = lazily(__name__, _HOMES)
