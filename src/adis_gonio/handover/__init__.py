"""Export of a calibration: as C header, table, register offsets, certificate or report.

Public names are imported when they are first used.
"""

from adis_gonio.base import lazily

_HOMES = {
    "ExportSource": "session_export",
    "TwinComparison": "twin_comparison",
    "certificate_text": "certificate",
    "compare": "twin_comparison",
    "offset_words": "register_offsets",
    "registers_text": "register_offsets",
    "reproduce": "paper_study",
    "simulate_like": "digital_twin",
}
__all__ = list(_HOMES)
__getattr__ = lazily(__name__, _HOMES)
