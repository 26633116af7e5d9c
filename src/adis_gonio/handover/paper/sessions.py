"""Simulated sessions for the comparison: through chip and driver, as `adis-gonio simulate` records them.

Every part is measured twice on its stage: at four positions, every 90°, and at nine, every 40°. The paper's
method, the closed form and `four-position` use the first, MMPM, `ml` and the trace the second.
"""

from __future__ import annotations

import shlex
import signal
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from adis_gonio.base.budget import with_progress
from adis_gonio.base.errors import FitError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.result import FitResult
from adis_gonio.handover.paper.truth import Truth
from adis_gonio.model.records import Session
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.settings import Settings
from adis_gonio.tracing.trace import trace
from adis_gonio.tracing.trace_result import TraceResult

DWELL_S = 1.0
PLANS = ("four-position", "mmpm")
USES = {
    "paper": "four-position",
    "two-position": "four-position",
    "four-position": "four-position",
    "mmpm": "mmpm",
    "ml": "mmpm",
}
"""Method → the plan whose session it is applied to; `ml` on MMPM's own nine dwells."""
TRACED = "traced"
METHODS = (*USES, TRACED)


@dataclass(frozen=True)
class Part:
    """A simulated part on its stage.

    Attributes
    ----------
    seed : int
        Of the simulator: start angle within ±5°, noise and the stage's errors.
    truth : Truth
    settings : mapping of str to float
        Further settings of the simulated world.
    effects : str
        Effects of the catalogue, as in a URL.
    """

    seed: int
    truth: Truth
    settings: Mapping[str, float] = field(default_factory=dict)
    effects: str = ""

    def _pairs(self) -> dict[str, float]:
        truth = self.truth
        return {
            "scale_y": truth.scale_y,
            "delta_k": truth.delta_k,
            "delta_phi_deg": truth.delta_phi_deg,
            "bias_x_mg": truth.bias_mg[0],
            "bias_y_mg": truth.bias_mg[1],
            **self.settings,
        }

    @property
    def url(self) -> str:
        """Of the simulated sensor."""
        settings = "".join(f"&{name}={float(value)!r}" for name, value in self._pairs().items())
        return f"sim:?seed={self.seed}{settings}" + (f"&effects={self.effects}" if self.effects else "")

    def command(self, plan_name: str, output: str = "one.session") -> str:
        """The `simulate` that records the same session."""
        words = ["adis-gonio", "simulate", "--plan", plan_name, "--dwell", f"{DWELL_S:g}"]
        words += ["--seed", str(self.seed)]
        for name, value in self._pairs().items():
            words += ["--set", f"{name}={float(value)!r}"]
        if self.effects:
            words += ["--effect", self.effects]
        return shlex.join([*words, "-o", output])


def measured(part: Part, plan_name: str) -> Session:
    """Record one session of a part."""
    with tempfile.TemporaryDirectory() as folder, open_sensor(part.url) as sensor:
        world = sensor.bus.world  # type: ignore[attr-defined]  # the simulator's bus has one
        path = Path(folder) / "one.session"
        runner = SessionRunner.begin(
            sensor,
            path,
            plan(plan_name),
            Settings(dwell_s=DWELL_S),
            auto=True,
            gravity_mps2=world.settings.gravity_mps2,
            fixture_sigma_deg=world.settings.fixture_sigma_deg,
        )
        for _ in runner.run():
            pass
        return load_session(path)


@dataclass(frozen=True)
class MethodValues:
    """What a method gives for one part; None where it does not determine it.

    Attributes
    ----------
    values, u : mapping of str to float or None
        By `scale_error_x`, `scale_error_y`, `offset_x`, `offset_y` (g), `non_orthogonality` (degree) and
        `delta_k`, with standard uncertainties.
    """

    values: Mapping[str, float | None]
    u: Mapping[str, float | None] = field(default_factory=dict)


_FROM_FIT = {
    "scale_error_x": ("scale_x", 1.0, 1.0),
    "scale_error_y": ("scale_y", 1.0, 1.0),
    "offset_x": ("bias_x", 1e-3, 0.0),
    "offset_y": ("bias_y", 1e-3, 0.0),
    "non_orthogonality": ("delta_phi", 1.0, 0.0),
    "delta_k": ("delta_k", 1.0, 0.0),
}
"""The paper's quantities: (name − zero) · factor of a parameter of `fit`."""


def quantities(result: FitResult | TraceResult) -> MethodValues:
    """The paper's parameters from a result.

    The paper gives ΔK and Δφ only. Its scales are those that go with them: X's from equation 6, the length
    of (U_x1, U_x2), and Y's from that and ΔK.
    """
    if isinstance(result, TraceResult):
        stated = dict(result.base)
        for finding in result.found:
            stated |= finding.parameters if finding.effect == "bias" else {}
        found = {name: (value.value, value.u) for name, value in stated.items()}
    else:
        found = {estimate.name: (estimate.value, estimate.u) for estimate in result.parameters}
        if result.method == "paper" and result.origin is not None:
            k_x, k_y = (float(k) for k in result.origin.fit.values.base[1:3])
            found |= {"scale_x": (k_x, None), "scale_y": (k_y, None)}
    values: dict[str, float | None] = {}
    u: dict[str, float | None] = {}
    for key, (name, factor, zero) in _FROM_FIT.items():
        value, spread = found.get(name, (None, None))
        values[key] = None if value is None else (value - zero) * factor
        u[key] = None if spread is None else spread * factor
    return MethodValues(values, u)


@dataclass(frozen=True)
class Results:
    """What each method gave for one part; a method that refused is not there, its reason in `refused`."""

    part: Part
    found: Mapping[str, MethodValues]
    refused: Mapping[str, str] = field(default_factory=dict)


def results_of(part: Part, traced: bool = False) -> Results:
    """Measure a part and apply every method."""
    sessions = {name: measured(part, name) for name in PLANS}
    found: dict[str, MethodValues] = {}
    refused: dict[str, str] = {}
    for method, used in USES.items():
        try:
            found[method] = quantities(fit(sessions[used], method))
        except FitError as error:
            refused[method] = str(error)
    if traced:
        found[TRACED] = quantities(trace(sessions["mmpm"]))
    return Results(part, found, refused)


def all_results(parts: Sequence[tuple[Part, bool]], jobs: int = 1) -> list[Results]:
    """Results of many parts in their order; each with whether it is traced too."""
    if jobs <= 1:
        return [results_of(*one) for one in with_progress(parts)]
    # Ctrl-C is the parent's to answer: it ends the pool in order, without a traceback from each process.
    with ProcessPoolExecutor(
        jobs, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
    ) as pool:
        done = pool.map(results_of, *zip(*parts, strict=True))
        return [one for one, _ in zip(done, with_progress(parts), strict=True)]


def facts_of(results: Results) -> dict[str, Any]:
    """JSON form of one part's results."""
    return {
        "seed": results.part.seed,
        "values": {method: dict(found.values) for method, found in results.found.items()},
        "u": {method: dict(found.u) for method, found in results.found.items()},
        "refused": dict(results.refused),
    }
