"""What limits the held-out error where no formula is right: smoothing by one who is told the cause.

    python scripts/trace_smoothing.py --sessions 200

On the blind sessions `beyond` with `check` dwells and a single cause: held-out error of base model and
bias, of `trace`, and of a Gaussian process that is told which covariate drives the cause and where it
enters (its length and size by evidence), each over the error of the oracle, which knows the very form and
estimates its size only. What lies between the third and 1 is the price of not knowing the form, which no
method that learns it from these readings escapes.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio import load_session, trace
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm
from adis_gonio.model.effects import effect
from adis_gonio.tracing.averaging import evidence, processes
from adis_gonio.tracing.validation import residuals_on, rms
from tracing.blind import Blind, draw, write
from tracing.lens import Lens
from tracing.verdict import oracle_rms


def told(blind: Blind, data: Readings) -> list[NamelessTerm]:
    """Processes of the covariate and the place that the cause has."""
    term = blind.terms[0]
    contribution = Lens(blind.bench).plain(term)
    axes = tuple(j for j in range(2) if np.abs(contribution[:, :, j]).max() > 0)
    places = {"gain": "gain", "lean": "misalignment"}
    place = next((places[p] for p in places if p in term.name), "bias")
    if term.attitude:
        place, axes = "angle", ()
    told_of = term.covariates[0].split("|") if len(term.covariates) == 1 else list(term.covariates)
    names = {"previous_angle" if name == "previous" else name for name in told_of}
    return [p for p in processes(data) if (p.where, p.axes) == (place, axes) and set(p.covariates) == names]


def told_error(blind: Blind, fitted: Readings, checked: Readings) -> float:
    """Held-out rms in mg of the process that is told; NaN where no process expresses the cause."""
    candidates = told(blind, fitted)
    if not candidates:
        return float("nan")
    bias = NamedTerm("bias", (), 0.0, effect("bias", ("x", "y")))
    fit = Fit.begin(fitted).with_terms((bias,), (np.zeros(2),)).refit()
    for _ in range(2):  # the second time about the first one's state
        base, blocks, target = fit.linear()
        base = np.hstack([base, blocks[0]])
        beside = np.linalg.qr(base / np.linalg.norm(base, axis=0))[0]
        left = target - beside @ (beside.T @ target)
        scores = evidence(fit, beside, left, candidates)
        term = candidates[int(np.argmax(scores))]
        width = term.columns(fitted.mean, fitted.conditions).shape[-1]
        fit = fit.with_terms((bias, term), (np.zeros(2), np.zeros(width))).refit()
    return rms(residuals_on(fit, checked).residual, True)


def one(seed: int, index: int) -> tuple[str, float, float, float] | None:
    """Cause, and errors over the oracle's: before, trace, told."""
    blind, samples = draw("beyond", seed, index)
    if not blind.bench.check.any() or len(blind.terms) > 1:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.csv"
        write(path, blind, samples)
        session = load_session(path)
    data = readings_of(session)
    after = trace(session).as_dict()["error"]["after"]["heldout_rms_mg"]
    oracle, _ = oracle_rms(blind)
    before, _ = oracle_rms(replace(blind, terms=()))
    limit = told_error(blind, data.rows(~data.check), data.rows(data.check))
    return blind.terms[0].name, before / oracle, after / oracle, limit / oracle


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        every = pool.map(partial(one, options.seed), range(options.sessions), chunksize=4)
        rows = [row for row in every if row is not None]
    ratios = np.array([row[1:] for row in rows])
    print(f"{len(rows)} sessions with check dwells and one cause; errors over the oracle's")
    for name, column in zip(("before", "trace", "told"), ratios.T, strict=True):
        some = ~np.isnan(column)
        values, before = column[some], ratios[some, 0]
        quarter, median, most, high = np.quantile(values, [0.25, 0.5, 0.75, 0.9])
        print(
            f"{name:8} median {median:6.3f}  quartiles {quarter:6.3f} {most:6.3f}  90 % {high:6.3f}  "
            f"more than 5 % worse than before in {np.mean(values > 1.05 * before):.1%} of {some.sum()}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
