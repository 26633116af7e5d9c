"""The record of one session: its row in the store and in a table, and the job that computes it.

The commands `fit` and `report` show numbers of the same answer (`adis_gonio.tracing.traced_answer`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from adis_gonio.base import __version__
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import format_uncertain
from adis_gonio.base.uncertainty import Value, finite_or_none
from adis_gonio.record.provenance import digest_of_file, provenance_of

if TYPE_CHECKING:
    from adis_gonio.model.records import Session

ANGLE = "angle"
"""Name of the quantity that is the root mean square over the turn of the angle's error.

The u and U stated with it are the uncertainties of an angle that the calibrated sensor displays.
"""
QUANTITIES = {
    "delta_k": "1",
    "delta_phi": "deg",
    **{f"bias_{axis}": "mg" for axis in "xyz"},
    **{f"scale_{axis}": "1" for axis in "xyz"},
    **{f"skew_{axes}": "deg" for axes in ("xy", "xz", "yz")},
    ANGLE: "deg",
}
"""Unit of each quantity that a record can have, by the name in the document of `fit`.

In space the skews replace `delta_phi`.
"""
PARTS = {"": "value", "_u": "u", "_u95": "U", "_k": "k", "_dof": "dof"}
"""Key in the JSON form of a value, by the ending of the column that has it.

The ending of U is `_u95`, because names of columns ignore capitals.
"""


def format_quantity(name: str, value: float, expanded: float | None) -> str:
    """Format a quantity with its expanded uncertainty U, such as `1.08 ± 0.13`.

    The error of the angle is an rms, and its U is the uncertainty of a displayed angle: `0.026 (U 0.040)`.
    """
    text = format_uncertain(value, expanded)
    return f"{text.replace('±', '(U')})" if name == ANGLE and "±" in text else text


Kind = Literal["text", "number", "integer", "flag", "names", "numbers"]


def _fact(kind: Kind, meaning: str, unit: str = "", default: Any = None) -> Any:
    """Return a field of a record that is also a column of the table."""
    return field(default=default, metadata={"column": (kind, unit, meaning)})


class FoundEffect(JsonRecord):
    """An effect that the trace of a session found.

    `axes` are the axes on which it acts, `parameters` its amplitudes by name. `p_value` is the probability
    of at least this improvement of the fit if the effect is absent.
    """

    effect: str
    axes: tuple[str, ...]
    p_value: float
    parameters: dict[str, Value]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FoundEffect:
        """Restore the effect from the dictionary of `as_dict`."""
        values = {name: value_from(entry) for name, entry in data["parameters"].items()}
        return cls(data["effect"], tuple(data["axes"]), data["p_value"], values)


_APART = ("values", "evidence", "stage_influence")
"""Names of the fields of a record that are no columns of its row in the table."""


class SessionRecord(JsonRecord):
    """Facts and results of one session file; unknown values are None.

    Attributes
    ----------
    path : str
        Path of the file as it was read.
    sha256 : str or None
        Digest of the file; None if it could not be read.
    data_sha256 : str or None
        Digest of the dwells' data, equal for an archive and the CSV exported from it.
    serial, operator, stage : str or None
        Serial number of the sensor, operator and stage as the session states them.
    sensor : str or None
        Variant of the sensor.
    plan : str or None
        Name of the plan; None for a CSV.
    when : str or None
        Start of the session (UTC, ISO 8601); None for a CSV.
    simulated : bool or None
        True if a simulator made the readings.
    dwells : int or None
        Number of dwells.
    measuring_s : float or None
        Total time of the dwells in s.
    temperature_c : float or None
        Mean temperature over all samples in °C.
    gravity_mps2 : float or None
        Local gravity.
    method : str or None
        Recommended method of the fit, by which `values` were determined.
    model_effects : tuple of str
        Effects in the traced model if that model gives the values; empty otherwise.
    values : mapping of str to Value
        Values of those `QUANTITIES` that the session determines.
    angle_max_deg : float or None
        Largest held-out error of the angle: each dwell in turn is left out of the fit and predicted.
    traced : bool
        True if a trace ran; otherwise the effects are not known.
    effects : tuple of FoundEffect
        Effects that the trace found.
    adequate : bool or None
        True if the traced model explains the readings; None without a trace.
    stage_curve : str
        Digest of the certificate of the stage that corrected the declared angles; empty without it.
    stage_influence : dict of str to tuple of float
        Change of each value by one standard uncertainty of each independent error of that certificate,
        which sessions on one stage share.
    doubts : tuple of str
        Reasons to doubt the result: dwells that the operator kept although a guard objected.
    status : {"ok", "failed"}
        `failed` if the session has no result.
    reason : str
        Reason of a failure, one line; empty without one.
    software : str
        Program and version that computed the record.
    evidence : mapping or None
        `SessionEvidence.as_dict()`, if it was requested and the session has evidence; otherwise None.
    """

    path: str = _fact("text", "file of the session, as it was given", default=MISSING)
    sha256: str | None = _fact("text", "SHA-256 of the file")
    data_sha256: str | None = _fact("text", "SHA-256 of its data: the same for an archive and its CSV")
    serial: str | None = _fact("text", "serial number of the unit")
    operator: str | None = _fact("text", "who measured")
    stage: str | None = _fact("text", "stage on which it was measured")
    sensor: str | None = _fact("text", "variant")
    plan: str | None = _fact("text", "plan of positions")
    when: str | None = _fact("text", "begin, UTC, ISO 8601")
    simulated: bool | None = _fact("flag", "of a simulated sensor")
    dwells: int | None = _fact("integer", "number of dwells")
    measuring_s: float | None = _fact("number", "time in the dwells", "s")
    temperature_c: float | None = _fact("number", "mean temperature", "degC")
    gravity_mps2: float | None = _fact("number", "local gravity", "m/s2")
    method: str | None = _fact("text", "recommended method, source of the values")
    model_effects: tuple[str, ...] = _fact("names", "effects of the model that gave the values", default=())
    values: dict[str, Value] = field(default_factory=dict)
    angle_max_deg: float | None = _fact("number", "largest error of the angle, each dwell left out", "deg")
    traced: bool = _fact("flag", "a trace ran; otherwise effects are not known", default=False)
    effects: tuple[FoundEffect, ...] = _fact("names", "effects that the trace found", default=())
    adequate: bool | None = _fact("flag", "the traced model leaves no more than the noise")
    stage_curve: str = _fact(
        "text", "digest of the stage certificate, which corrected the angles", default=""
    )
    stage_influence: dict[str, tuple[float, ...]] = field(default_factory=dict)
    doubts: tuple[str, ...] = _fact("text", "reasons why the result is doubtful", default=())
    status: Literal["ok", "failed"] = _fact("text", "ok or failed", default="ok")
    reason: str = _fact("text", "reason of the failure", default="")
    software: str = _fact("text", "program that computed it", default="")
    evidence: dict[str, Any] | None = None

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> SessionRecord:
        """Restore the record from the dictionary of `as_dict`."""
        return cls(
            **{
                **data,
                "model_effects": tuple(data["model_effects"]),
                "values": {name: value_from(entry) for name, entry in data["values"].items()},
                "effects": tuple(FoundEffect.from_dict(entry) for entry in data["effects"]),
                "doubts": tuple(data["doubts"]),
                "stage_influence": {n: tuple(v) for n, v in data.get("stage_influence", {}).items()},
            }
        )

    def row(self) -> dict[str, Any]:
        """Return a row with the columns of `COLUMNS`; unknown values are None.

        Each of `QUANTITIES` has six columns. For ΔK, `delta_k` is the value, `delta_k_u` the standard
        uncertainty u, `delta_k_u95` the expanded uncertainty U = k·u (95 %), `delta_k_k` the factor k,
        `delta_k_dof` the degrees of freedom of u, and `delta_k_stage` the list of changes of the value by
        one standard uncertainty of each error of the stage's certificate. All six are None (an
        empty list for `_stage`) if the session does not determine the quantity, or has it in another unit
        than the column (counts of unknown scale). `effects` are the names of the effects that the trace
        found, `model_effects` the effects in the model that gives the values.
        """
        row = {name: value for name, value in vars(self).items() if name not in _APART}
        row["model_effects"] = list(self.model_effects)
        row["effects"] = list(dict.fromkeys(found.effect for found in self.effects))
        row["doubts"] = "; ".join(self.doubts)
        for name, unit in QUANTITIES.items():
            known = name in self.values and self.values[name].unit == unit
            value = self.values[name].as_dict() if known else {}
            row |= {f"{name}{end}": value.get(key) for end, key in PARTS.items()}
            row[f"{name}_stage"] = list(self.stage_influence.get(name, ()))
        return row


class Repeated(JsonRecord):
    """A file that is left out of the fleet, because the file `same_as` has the same data."""

    path: str
    same_as: str


def once(records: Iterable[SessionRecord]) -> tuple[list[SessionRecord], list[Repeated]]:
    """Keep one record of several with equal data, such as an archive and the CSV exported from it.

    Return the remaining records, sorted by path, and the files of the removed records. The record of the
    file that states more facts remains.
    """
    kept, repeated, names = [], [], dict[str, str]()
    facts = ("when", "serial", "operator", "stage", "plan")
    unstated = [(sum(getattr(one, name) is None for name in facts), one.path, one) for one in records]
    for *_, record in sorted(unstated, key=lambda entry: entry[:2]):
        data = record.data_sha256 if record.status == "ok" else None
        if data in names:
            repeated.append(Repeated(record.path, names[data]))
            continue
        if data:
            names[data] = record.path
        kept.append(record)
    return sorted(kept, key=lambda record: record.path), repeated


def value_from(entry: Mapping[str, Any]) -> Value:
    """Make a `Value` (with its uncertainty) from its JSON form.

    The form is a mapping with `value`, `u`, `unit`, `dof` and `k`; a value of None becomes NaN.
    """
    value, dof = entry["value"], entry["dof"]
    return Value(
        math.nan if value is None else value,
        entry["u"],
        entry["unit"],
        math.inf if dof is None else dof,
        entry["k"],
    )


class Options(JsonRecord):
    """Computations that are made for every session.

    Attributes
    ----------
    trace : bool
        True also traces the residual. A trace takes seconds to half a minute per session, a fit tenths of a
        second.
    evidence : bool
        True also computes the session's evidence for `trace_population`.
    """

    trace: bool = True
    evidence: bool = False

    @property
    def key(self) -> str:
        """Options and program version as one text.

        A stored record with another text is not used, since the file may now give another result.
        """
        return json.dumps([self.as_dict(), __version__])


@dataclass(frozen=True)
class Job:
    """A session to compute: the path of its file, and the SHA-256 of the file's bytes."""

    path: str
    digest: str


def lost(path: str, reason: str) -> SessionRecord:
    """Make the record of a session that could not be computed.

    It has no digest, so that the next run tries the session again. `reason` is the reason, which the record
    states after the path.
    """
    return SessionRecord(path, status="failed", reason=f"{path}: {reason}")


def work(path: str, digest: str, options: dict[str, bool], version: str) -> SessionRecord:
    """Compute the record of a job, perhaps on another machine than the caller's.

    A refused job gives a record with the reason.

    Parameters
    ----------
    path, digest : str
        Path of the session file and SHA-256 of its bytes; a file with another digest is refused.
    options : mapping
        Computations to make, as `Options.as_dict()` returns them.
    version : str
        Version of adis-gonio that runs the fleet; another version of this program refuses the job.
    """
    if version != __version__:
        return lost(path, f"the worker has adis-gonio {__version__}, the fleet {version}")
    try:
        own = digest_of_file(path)
    except OSError as error:
        return lost(path, f"cannot be read by the worker: {error.strerror or error}")
    if own != digest:
        return lost(path, "is another file at the worker, or was changed meanwhile")
    return record_of(path, **options)


def record_of(path: str | Path, *, trace: bool = False, evidence: bool = False) -> SessionRecord:
    """Compute the record of one session file.

    A broken file gives a record with the reason, never an exception.

    Parameters
    ----------
    path : str or Path
        Session file.
    trace : bool
        True also traces the residual.
    evidence : bool
        True also computes the evidence for a population trace.
    """
    from adis_gonio.fleet.session_evidence import evidence_of
    from adis_gonio.record.loading import explain_refusal, load_session

    path = Path(path)
    known: dict[str, Any] = {"path": str(path), "software": f"adis-gonio {__version__}"}
    try:
        # Digest before reading: a file that changes meanwhile has another digest in the next run.
        known["sha256"] = digest_of_file(path) if path.is_file() else None
        session = load_session(path)
        known |= _facts(session)
        found = _results(session, trace=trace)
        if evidence:
            with suppress(AdisGonioError):  # for example, a session of one pose has no evidence
                found["evidence"] = evidence_of(session).as_dict()
        return SessionRecord(**known, **found)
    except (AdisGonioError, OSError) as error:
        reason = explain_refusal(str(error))
    except Exception as error:  # one file among thousands must not stop the others
        reason = f"{path}: {type(error).__name__}: {error}"
    return SessionRecord(**known, status="failed", reason=" ".join(reason.split()))


def _facts(session: Session) -> dict[str, Any]:
    """Return the fields of the record that the session file states.

    They are known even if the fit fails.
    """
    origin = provenance_of(session)
    # A time of an archive or a CSV has a zone.
    begun = datetime.fromisoformat(origin.recorded_utc) if origin.recorded_utc else None
    return {
        "data_sha256": origin.sha256,
        "serial": origin.serial.strip() or None,
        "operator": origin.operator.strip() or None,
        "stage": origin.stage.strip() or None,
        "sensor": origin.sensor,
        "plan": (session.facts.get("plan") or {}).get("name"),
        "when": None if begun is None else begun.astimezone(UTC).isoformat(timespec="seconds"),
        "simulated": session.facts.get("simulated"),
        "dwells": len(session.dwells),
        "measuring_s": math.fsum(float(d.time_s[-1] - d.time_s[0]) for d in session.dwells if len(d)),
        "temperature_c": None if origin.temperature_c is None else origin.temperature_c.mean,
        "gravity_mps2": origin.gravity_mps2,
        "doubts": tuple(str(doubt["message"]) for doubt in session.facts.get("doubts", ())),
    }


def _results(session: Session, *, trace: bool) -> dict[str, Any]:
    from adis_gonio.fitting.methods import fit
    from adis_gonio.tracing.findings import biases_at_middle
    from adis_gonio.tracing.trace import trace as traced_by
    from adis_gonio.tracing.traced_answer import answer_with_trace

    found = traced_by(session) if trace else None
    answer = answer_with_trace(fit(session), found)
    score = answer.scores.get(answer.scored_as)
    # A bias that the fit determines, but the traced model does not need, is zero with the u of the fit.
    fitted = {n: v for n, v in answer.result.parameters.items() if n.startswith("bias_")}
    inside = biases_at_middle(found.fits[-1]) if found is not None and found.fits else {}
    biases = {n: replace(v, value=inside[n][0] if n in inside else 0.0) for n, v in fitted.items()}
    known = {**biases, **answer.parameters, **answer.values}
    results: dict[str, Any] = {
        "method": answer.recommended.method,
        "model_effects": answer.recommended.effects,
        "values": {name: known[name] for name in QUANTITIES if name in known},
        "stage_curve": "" if session.stage_curve is None else session.stage_curve.digest,
        "stage_influence": {n: tuple(c.tolist()) for n, c in answer.result.stage_influence.items()},
        "angle_max_deg": None if score is None else finite_or_none(score.angle_max_deg),
    }
    if found is not None:
        effects = tuple(FoundEffect(f.effect, f.axes, f.p_value, f.parameters) for f in found.found)
        results |= {"traced": True, "effects": effects, "adequate": found.adequate}
    return results


Row = Mapping[str, Any]


def _of_quantities() -> dict[str, tuple[Kind, str, str]]:
    columns: dict[str, tuple[Kind, str, str]] = {}
    for name, unit in QUANTITIES.items():
        what = "error of the angle, rms over held-out dwells" if name == ANGLE else name
        own = "a displayed angle" if name == ANGLE else name
        columns |= {
            name: ("number", unit, what),
            f"{name}_u": ("number", unit, f"standard uncertainty of {own}"),
            f"{name}_u95": ("number", unit, f"expanded uncertainty U of {own}, 95 %"),
            f"{name}_k": ("number", "1", f"coverage factor of {own}"),
            f"{name}_dof": ("number", "1", f"degrees of freedom of {own}; null if unlimited"),
            f"{name}_stage": ("numbers", unit, f"change of {name} by each error of that certificate"),
        }
    return columns


_FACTS = {f.name: f.metadata["column"] for f in fields(SessionRecord) if "column" in f.metadata}
COLUMNS: dict[str, tuple[Kind, str, str]] = {**_FACTS, **_of_quantities()}
"""Kind, unit and meaning of each column of the table, in order."""


def write_parquet(rows: Sequence[Row], path: str | Path, about: Mapping[str, Any]) -> None:
    """Write rows to a Parquet file.

    The metadata of the file are `unit` and `meaning` of each column, and `adis_gonio`, which is `about` as
    JSON.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    OSError
        The file cannot be written.
    """
    from adis_gonio.handover.session_export import require_pyarrow, write_table

    pa = require_pyarrow()
    kinds = {
        "text": pa.string(),
        "number": pa.float64(),
        "integer": pa.int64(),
        "flag": pa.bool_(),
        "names": pa.list_(pa.string()),
        "numbers": pa.list_(pa.float64()),
    }
    columns = {
        name: ([row[name] for row in rows], kinds[kind], {"unit": unit, "meaning": meaning})
        for name, (kind, unit, meaning) in COLUMNS.items()
    }
    write_table(path, columns, about)
