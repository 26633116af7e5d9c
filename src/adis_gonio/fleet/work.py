"""One session of many: the job, and the record that a worker makes of it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.values import Value, finite_or_none
from adis_gonio.base.version import __version__
from adis_gonio.fleet.record import QUANTITIES, FoundEffect, SessionRecord
from adis_gonio.record.provenance import digest_of_file, provenance_of

if TYPE_CHECKING:
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.model.records import Session
    from adis_gonio.tracing.trace_result import TraceResult


@dataclass(frozen=True)
class Options(JsonRecord):
    """Computations that every session gets.

    Attributes
    ----------
    trace : bool
        Trace the residual too: seconds to half a minute a session; a fit takes tenths.
    evidence : bool
        Compute the session's evidence for `adis_gonio.fleet.population`.
    """

    trace: bool = True
    evidence: bool = False

    @property
    def key(self) -> str:
        """Options and version: if this text changes, a file may give another result."""
        return json.dumps([self.as_dict(), __version__])


@dataclass(frozen=True)
class Job:
    """One session: its file, and the SHA-256 of the file's bytes."""

    path: str
    digest: str


def lost(path: str, reason: str) -> SessionRecord:
    """Record of a session that was not computed; without a digest, so that the next run tries again."""
    return SessionRecord(path, status="failed", reason=f"{path}: {reason}")


def work(path: str, digest: str, options: dict[str, bool], version: str) -> SessionRecord:
    """Compute the record of a job, perhaps on another machine.

    Parameters
    ----------
    path, digest : str
        As in `Job`; a file that is not that one is not worked on.
    options : mapping
        `Options.as_dict()`.
    version : str
        Version of adis-gonio that runs the fleet.
    """
    if version != __version__:
        return lost(path, f"the worker has adis-gonio {__version__}, the fleet is run by {version}")
    try:
        own = digest_of_file(path)
    except OSError as error:
        return lost(path, f"cannot be read where the worker is: {error.strerror or error}")
    if own != digest:
        return lost(path, "is not the same file where the worker is, or was changed meanwhile")
    return record_of(path, **options)


def record_of(path: str | Path, *, trace: bool = False, evidence: bool = False) -> SessionRecord:
    """Fit one session; a broken file gives a record with its reason, never an exception.

    Parameters
    ----------
    trace, evidence : bool
        As in `Options`.
    """
    from adis_gonio.record.loading import explain_refusal, load_session

    path = Path(path)
    known: dict[str, Any] = {"path": str(path), "software": f"adis-gonio {__version__}"}
    try:
        # Before it is read: a file that changes meanwhile has another digest next time.
        known["sha256"] = digest_of_file(path) if path.is_file() else None
        session = load_session(path)
        known |= _facts(session)
        found = _results(session, trace=trace)
        return SessionRecord(**known, **found, evidence=_evidence(session) if evidence else None)
    except (AdisGonioError, OSError) as error:
        reason = explain_refusal(str(error))
    except Exception as error:  # among thousands of files there may be an unforeseen one
        reason = f"{path}: {type(error).__name__}: {error}"
    return SessionRecord(**known, status="failed", reason=" ".join(reason.split()))


def _facts(session: Session) -> dict[str, Any]:
    """Facts of the file, which hold whether a fit succeeds or not."""
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
    from adis_gonio.tracing.trace import trace as traced_by
    from adis_gonio.tracing.traced_answer import answer_with_trace

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
    return {name: known[name] for name in QUANTITIES if name in known}


def _of_trace(found: TraceResult | None) -> dict[str, Any]:
    if found is None:
        return {}
    effects = tuple(FoundEffect(f.effect, f.axes, f.p_value, f.parameters) for f in found.found)
    return {"traced": True, "effects": effects, "adequate": found.adequate}


def _evidence(session: Session) -> dict[str, Any] | None:
    """Evidence of a session for a population; None if it has none, such as a session of one pose."""
    from adis_gonio.fleet.population import evidence_of

    try:
        return evidence_of(session).as_dict()
    except AdisGonioError:
        return None
