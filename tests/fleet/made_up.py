"""Records that no file stands behind, for statistics whose truth is known."""

from __future__ import annotations

import hashlib

from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet.session_record import SessionRecord

UNITS = {"delta_k": "1", "delta_phi": "deg", "bias_x": "mg", "bias_y": "mg", "angle": "deg"}


def made_up(when: str, serial: str = "A7", u: float = 0.1, **values: float) -> SessionRecord:
    """A record of one day with these values, all of the same u; what is left out is 0."""
    held = {
        name: Value(values.get(name, 0.0), u * (1e-3 if name == "delta_k" else 1.0), unit)
        for name, unit in UNITS.items()
    }
    digest = hashlib.sha256(f"{when} {serial} {values}".encode()).hexdigest()
    return SessionRecord(
        path=f"/none/{serial} {when}.session",
        sha256=digest,
        data_sha256=digest,
        serial=serial,
        when=f"{when}T00:00:00+00:00",
        gravity_mps2=9.80665,
        method="ml",
        values=held,
    )
