"""The seed paper reproduced: its table, its figure, and where its method overtakes MMPM.

`study` does the work on simulated sessions, `build_page` shows it.
"""

from __future__ import annotations

from adis_gonio.paper.study import Study, study
from adis_gonio.paper.truth import TABLE, Truth, truth_of

__all__ = ["TABLE", "Study", "Truth", "build_page", "study", "truth_of"]
