"""Many sessions: fitted and traced by many processes or machines, kept in one store, and summarised.

Public names are imported when they are first used.
"""

from adis_gonio.base import lazily

_HOMES = {
    "Cluster": "workers",
    "LocalPool": "workers",
    "Options": "session_record",
    "Rules": "calibration_due",
    "SessionEvidence": "session_evidence",
    "SessionRecord": "session_record",
    "Store": "store",
    "due_of": "calibration_due",
    "evidence_of": "session_evidence",
    "files_of": "fleet_run",
    "history_of": "sensor_history",
    "read_parquet": "session_table",
    "record_of": "session_record",
    "run_fleet": "fleet_run",
    "scan": "fleet_run",
    "summarise": "fleet_summary",
    "survey": "fleet_run",
    "trace_population": "population_trace",
    "write_parquet": "session_table",
}
__all__ = list(_HOMES)
__getattr__ = lazily(__name__, _HOMES)
