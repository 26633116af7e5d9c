"""One session's result as a row: what is remembered of it, and what a fleet's summary consists of.

The numbers are those of the one answer (`adis_gonio.tracing.answer`), as `fit` and the report show them.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.jsonable import Record
from adis_gonio.base.values import Value, finite_or_none

if TYPE_CHECKING:
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.model.records import Session
    from adis_gonio.tracing import TraceResult

QUANTITIES = ("delta_k", "delta_phi", "bias_x", "bias_y", "bias_z", "scale_x", "scale_y", "scale_z")
"""Parameters that are remembered, named as in the document of `fit`, where a session determines them."""
SKEWS = ("skew_xy", "skew_xz", "skew_yz")
"""What stands in the place of `delta_phi` in space."""
ANGLE = "angle"
"""Error of the angle, rms; its u and U are those of an angle that is shown."""
COLUMNS = (*QUANTITIES, *SKEWS, ANGLE)
"""Every quantity of a flat row."""

Status = Literal["ok", "failed"]


@dataclass(frozen=True)
class FoundEffect(Record):
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
class SessionRecord(Record):
    """What is remembered of one session's file; text that nobody gave, and what is not known, is None.

    Attributes
    ----------
    path : str
        Where the file was read.
    sha256 : str or None
        Of the file; None where it could not be read.
    data_sha256 : str or None
        Of the dwells' data: the same for an archive and for the CSV exported from it.
    serial, operator, stage : str or None
        What the operator wrote down.
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
        Recommended method, whose numbers these are.
    model_effects : tuple of str
        Effects of the traced model, where that is the answer.
    values : mapping of str to Value
        `QUANTITIES` that the session determines (in space `SKEWS` too), and `angle`.
    angle_max_deg : float or None
        Largest error of the angle over the dwells, each left out of the fit.
    traced : bool
        True where a trace ran; else nothing is known of effects.
    effects : tuple of FoundEffect
    adequate : bool or None
        Whether the traced model explains the readings; None without a trace.
    doubts : tuple of str
        Why the result cannot be right: what was kept against a guard.
    status : {"ok", "failed"}
    reason : str
        Why it failed, one line.
    software : str
        Program that computed it.
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

    def row(self) -> dict[str, str | float | int | bool | None]:
        """One flat row, the same columns for every record: a table's (SQLite, Parquet).

        Each of `COLUMNS` takes five: `delta_k`, `delta_k_u`, `delta_k_u95` (U: names of columns do not
        tell capitals apart), `delta_k_k`, `delta_k_dof`. `effects` are names, separated by a space.
        """
        facts = {k: v for k, v in vars(self).items() if not isinstance(v, tuple | dict)}
        facts["model_effects"] = " ".join(self.model_effects)
        facts["effects"] = " ".join(dict.fromkeys(found.effect for found in self.effects))
        facts["doubts"] = "; ".join(self.doubts)
        for name in COLUMNS:
            told = self.values[name].as_dict() if name in self.values else {}
            facts[name] = told.get("value")
            facts |= {
                f"{name}_{short}": told.get(key)
                for short, key in (("u", "u"), ("u95", "U"), ("k", "k"), ("dof", "dof"))
            }
        return facts


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


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal.

    Raises
    ------
    OSError
        It cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def record_of(path: str | Path, *, trace: bool = False) -> SessionRecord:
    """What is remembered of a session's file; a broken one is a record with its reason, never an exception.

    Parameters
    ----------
    trace : bool
        Look for effects too, which takes seconds to half a minute a session.
    """
    return record_and_session(path, trace=trace)[0]


def record_and_session(path: str | Path, *, trace: bool = False) -> tuple[SessionRecord, Session | None]:
    """The same with the session, for who asks more of it; None where it could not be read."""
    from adis_gonio.base.version import __version__
    from adis_gonio.record.loading import load_session
    from adis_gonio.record.overrides import as_it_is

    path = Path(path)
    session: Session | None = None
    known: dict[str, Any] = {"path": str(path), "software": f"adis-gonio {__version__}"}
    try:
        # Before it is read: a file that changes meanwhile has another digest next time.
        known["sha256"] = file_digest(path) if path.is_file() else None
        session = load_session(path)
        known |= _facts(session)
        return SessionRecord(**known, **_results(session, trace=trace)), session
    except (AdisGonioError, OSError) as error:
        reason = as_it_is(str(error))
    except Exception as error:  # among thousands of files one may find what nobody thought of
        reason = f"{path}: {type(error).__name__}: {error}"
    return SessionRecord(**known, status="failed", reason=" ".join(reason.split())), session


def _facts(session: Session) -> dict[str, Any]:
    """What the file says, whatever a fit makes of it."""
    from adis_gonio.record.provenance import provenance_of

    origin = provenance_of(session)
    return {
        "data_sha256": origin.sha256,
        "serial": origin.serial.strip() or None,
        "operator": origin.operator.strip() or None,
        "stage": origin.stage.strip() or None,
        "sensor": origin.sensor,
        "plan": (session.facts.get("plan") or {}).get("name"),
        "when": _utc(origin.recorded_utc),
        "simulated": session.facts.get("simulated"),
        "dwells": len(session.dwells),
        "measuring_s": math.fsum(float(d.time_s[-1] - d.time_s[0]) for d in session.dwells if len(d)),
        "temperature_c": None if origin.temperature_c is None else origin.temperature_c.mean,
        "gravity_mps2": origin.gravity_mps2,
        "doubts": tuple(str(doubt["message"]) for doubt in session.facts.get("doubts", ())),
    }


def _utc(text: str) -> str | None:
    """The same moment in UTC, to the second; a time without a zone is UTC already."""
    if not text:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    return moment.isoformat(timespec="seconds")


def _results(session: Session, *, trace: bool) -> dict[str, Any]:
    from adis_gonio.fitting import fit
    from adis_gonio.tracing.answer import answer_with_trace
    from adis_gonio.tracing.trace import trace as traced_by

    found = traced_by(session) if trace else None
    answer = answer_with_trace(fit(session), found, own=False)
    score = answer.scores.get(answer.scored_as)
    return {
        "method": answer.recommended.method,
        "model_effects": answer.recommended.effects,
        "values": _values(answer),
        "angle_max_deg": None if score is None else finite_or_none(score.angle_max_deg),
        **_of_trace(found),
    }


def _values(answer: Answer) -> dict[str, Value]:
    known = {**answer.parameters, **answer.values}
    return {name: known[name] for name in COLUMNS if name in known}


def _of_trace(found: TraceResult | None) -> dict[str, Any]:
    if found is None:
        return {}
    effects = tuple(FoundEffect(f.effect, f.axes, f.p_value, f.parameters) for f in found.found)
    return {"traced": True, "effects": effects, "adequate": found.adequate}
