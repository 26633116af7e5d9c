"""Export of a calibration as C header, table, register offsets, certificate or report.

Public names are imported when they are first used.
"""

from adis_gonio.base import lazily

_HOMES = {
    "certificate": "certificate_text",
    "digital_twin": "TwinComparison compare simulate_like",
    "paper_study": "reproduce",
    "register_offsets": "offset_words registers_text",
    "session_export": "ExportSource",
}
__getattr__ = lazily(__name__, _HOMES)
