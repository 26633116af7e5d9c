"""One session's result: the record that the store keeps, and its flat row.

The numbers are those of the answer (`adis_gonio.tracing.traced_answer`), as in `fit` and the report.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import Value

ANGLE = "angle"
"""Error of the angle, rms; its u and U are those of an angle that is shown."""
QUANTITIES = {
    "delta_k": "1",
    "delta_phi": "deg",
    **{f"bias_{axis}": "mg" for axis in "xyz"},
    **{f"scale_{axis}": "1" for axis in "xyz"},
    **{f"skew_{axes}": "deg" for axes in ("xy", "xz", "yz")},
    ANGLE: "deg",
}
"""Unit of each quantity that a record can hold, named as in the document of `fit`; in space the
skews replace `delta_phi`."""
PARTS = {"": "value", "_u": "u", "_u95": "U", "_k": "k", "_dof": "dof"}
"""Columns of a quantity in a row, by ending, with their keys in the document of a value."""

Status = Literal["ok", "failed"]


@dataclass(frozen=True)
class FoundEffect(JsonRecord):
    """An effect that a trace found, as `found` in the document of `trace`."""

    effect: str
    axes: tuple[str, ...]
    p_value: float
    parameters: dict[str, Value]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FoundEffect:
        """The inverse of `as_dict`."""
        values = {name: value_from(entry) for name, entry in data["parameters"].items()}
        return cls(data["effect"], tuple(data["axes"]), data["p_value"], values)


@dataclass(frozen=True)
class SessionRecord(JsonRecord):
    """Facts and results of one session's file; text that is not stated and unknown values are None.

    Attributes
    ----------
    path : str
        Path of the file as it was read.
    sha256 : str or None
        Digest of the file; None if it could not be read.
    data_sha256 : str or None
        Of the dwells' data: the same for an archive and for the CSV exported from it.
    serial, operator, stage : str or None
        Text of the operator.
    sensor : str or None
        Variant.
    plan : str or None
        Name of the plan; None for a CSV.
    when : str or None
        When the session began (UTC, ISO 8601); None for a CSV.
    simulated : bool or None
    dwells : int or None
    measuring_s : float or None
        Time in the dwells, s.
    temperature_c : float or None
        Mean over all samples.
    gravity_mps2 : float or None
    method : str or None
        Recommended method, which gave these numbers.
    model_effects : tuple of str
        Effects of the traced model, if that is the answer.
    values : mapping of str to Value
        `QUANTITIES` that the session determines.
    angle_max_deg : float or None
        Largest error of the angle over the dwells, each left out of the fit.
    traced : bool
        True if a trace ran; otherwise nothing is known of effects.
    effects : tuple of FoundEffect
    adequate : bool or None
        Whether the traced model explains the readings; None without a trace.
    doubts : tuple of str
        Reasons why the result cannot be right: readings that were kept against a guard.
    status : {"ok", "failed"}
    reason : str
        Why it failed, one line.
    software : str
        Program that computed it.
    evidence : mapping or None
        Of `SessionEvidence.as_dict`, if it was asked for and the session has any.
    """

    path: str
    sha256: str | None = None
    data_sha256: str | None = None
    serial: str | None = None
    operator: str | None = None
    stage: str | None = None
    sensor: str | None = None
    plan: str | None = None
    when: str | None = None
    simulated: bool | None = None
    dwells: int | None = None
    measuring_s: float | None = None
    temperature_c: float | None = None
    gravity_mps2: float | None = None
    method: str | None = None
    model_effects: tuple[str, ...] = ()
    values: dict[str, Value] = field(default_factory=dict)
    angle_max_deg: float | None = None
    traced: bool = False
    effects: tuple[FoundEffect, ...] = ()
    adequate: bool | None = None
    doubts: tuple[str, ...] = ()
    status: Status = "ok"
    reason: str = ""
    software: str = ""
    evidence: dict[str, Any] | None = None

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> SessionRecord:
        """The inverse of `as_dict`."""
        return cls(
            **{
                **data,
                "model_effects": tuple(data["model_effects"]),
                "values": {name: value_from(entry) for name, entry in data["values"].items()},
                "effects": tuple(FoundEffect.from_dict(entry) for entry in data["effects"]),
                "doubts": tuple(data["doubts"]),
            }
        )

    def row(self) -> dict[str, Any]:
        """One row with the columns of `adis_gonio.fleet.columns.COLUMNS`; unknown values are None.

        Each of `QUANTITIES` takes five columns (`PARTS`): `delta_k`, `delta_k_u`, `delta_k_u95` (U, since
        names of columns do not tell capitals apart), `delta_k_k`, `delta_k_dof`. A value in another unit
        than that of its column (counts of unknown scale) is left out. `effects` and `model_effects` are
        lists of names.
        """
        row = {name: value for name, value in vars(self).items() if name not in ("values", "evidence")}
        row["model_effects"] = list(self.model_effects)
        row["effects"] = list(dict.fromkeys(found.effect for found in self.effects))
        row["doubts"] = "; ".join(self.doubts)
        for name, unit in QUANTITIES.items():
            known = name in self.values and self.values[name].unit == unit
            value = self.values[name].as_dict() if known else {}
            row |= {f"{name}{end}": value.get(key) for end, key in PARTS.items()}
        return row


def once(records: Iterable[SessionRecord]) -> tuple[list[SessionRecord], dict[str, str]]:
    """Records by path, each data once, and the paths left out with the path of the same data.

    Of an archive and the CSV exported from it that one is kept that states more.
    """
    kept, copies, names = [], {}, dict[str, str]()
    for record in sorted(records, key=_unstated):
        data = record.data_sha256 if record.status == "ok" else None
        if data in names:
            copies[record.path] = names[data]
            continue
        if data:
            names[data] = record.path
        kept.append(record)
    return sorted(kept, key=lambda record: record.path), copies


def _unstated(record: SessionRecord) -> tuple[int, str]:
    """Number of facts that a file does not state, then its path."""
    names = ("when", "serial", "operator", "stage", "plan")
    return sum(getattr(record, name) is None for name in names), record.path


def value_from(entry: Mapping[str, Any]) -> Value:
    """A `Value` from its JSON form."""
    value, dof = entry["value"], entry["dof"]
    return Value(
        math.nan if value is None else value,
        entry["u"],
        entry["unit"],
        math.inf if dof is None else dof,
        entry["k"],
    )
