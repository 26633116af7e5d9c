"""The seed paper reproduced: its table, its figure, and where its method overtakes MMPM.

`reproduce` does the work on simulated sessions, `page.build_page` shows it.
"""

from __future__ import annotations

from adis_gonio.handover.paper.study import Study, reproduce
from adis_gonio.handover.paper.truth import TABLE, Truth, truth_of

__all__ = ["TABLE", "Study", "Truth", "reproduce", "truth_of"]
