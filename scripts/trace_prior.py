"""Rows of `trace` with another prior share of unnamed functions, or with the true noise of the readings.

    python scripts/trace_prior.py --share 0.03 --sessions 180 --seed 5160271849
    python scripts/trace_prior.py --noise --sessions 120 --secret 3946105196

With `--share`: wrong names among strangers (benchmarks/strangers), and sessions of two effects
(tests/tracing) in which both and nothing else are found. A larger share gives fewer wrong names and fewer
right ones. With `--noise`: true names in a set on the ladder (benchmarks/blind_residual, gain 16 to 50,
without sessions of averaged readings), by the noise that the trace measures with the figure of the data
sheet, and by the noise that the generator drew. The oracle of `trace_limits.py` knows this noise. Its level
of 1/f noise does not show in the dwells.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from benchmarks.strangers.score import Verdict, judge, wilson
from benchmarks.strangers.session import consult_oracle, session_of

from adis_gonio import load_session, trace
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.model.records import Session
from adis_gonio.tracing import trace as traced
from adis_gonio.tracing.thresholds import limits
from blind_residual.generator import Truth, draw
from blind_residual.noise import Noise
from blind_residual.runners.adis_gonio import from_trace
from blind_residual.scoring import score
from trace_limits import ladder_outcomes
from tracing.rounds import judge_answer, trace_file, write_session

Reader = Callable[[Session, str], Readings]
FAMILIES = ("catalogue", "two")


def document_of(csv: str) -> dict:
    """Return the JSON of `trace` for a session in the samples CSV."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.csv"
        path.write_text(csv, encoding="utf-8")
        return trace(load_session(path)).as_dict()


def stranger(seed: int, index: int) -> Verdict:
    """Return the verdict on one session of the strangers."""
    session = session_of(index, seed)
    return judge(session, consult_oracle(session), document_of(session.csv), index)


def found_both(seed: int, index: int) -> bool:
    """Return True if the trace finds both effects of a session and nothing else."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "session.csv")
        write_session(path, "two", seed, index)
        return judge_answer(trace_file(path), "two", seed, index).exact


def true_noise(reader: Reader, truth: Truth) -> Reader:
    """Return a function like `reader` that gives its readings the noise of which they were drawn."""
    start, m = np.array(truth.start_s), truth.samples
    motion = truth.problem().c.variance_mg2 / m
    axes = [Noise(**row) for row in truth.noise]
    own = np.array([axis.sample_covariance(m).sum() / m**2 for axis in axes])

    def read(session: Session, part: str) -> Readings:
        data = reader(session, part)
        n = len(data)
        slow = np.zeros((n, len(axes), n * len(axes)))
        for k, axis in enumerate(axes):
            shared = axis.reading_covariance(start, m, truth.rate_hz) - own[k] * np.eye(n)
            values, vectors = np.linalg.eigh(shared)
            slow[:, k, k * n : (k + 1) * n] = vectors * np.sqrt(np.maximum(values, 0.0))
        covariance = (own + motion)[:, :, None] * np.eye(len(axes))
        return replace(data, own_covariance=covariance, slow=slow, dof=np.full(n, np.inf))

    return read


def ladder(secret: str, sessions: int) -> dict[str, list[tuple[float, float, float]]]:
    """Return the shares of true names in sets, by rung: measured noise, true noise, oracle."""
    rows = defaultdict(list)
    for family in FAMILIES:
        for index in range(sessions):
            csv, truth = draw(f"{secret} {family}", index, family)
            least = min(truth.gain, default=0.0)
            if not 16 <= least < 50 or truth.noise[0]["reading_u_mg"]:
                continue
            plain: Reader = traced.readings_of_part
            shares = []
            for reader in (plain, true_noise(plain, truth)):
                traced.readings_of_part = reader
                shares.append(float(score(truth, from_trace(document_of(csv)))["right_set"]))
            traced.readings_of_part = plain
            (best,) = ladder_outcomes(f"{secret} {family}", family, index).values()
            rows["16 to 30" if least < 30 else "30 to 50"].append((*shares, best))
    return rows


def show(what: str, outcomes: list[bool]) -> None:
    """Print a rate with its 95 % interval."""
    low, high = wilson(sum(outcomes), len(outcomes))
    print(f"{what:40} {sum(outcomes):4} of {len(outcomes):4}  [{low:.1%}, {high:.1%}]")


def main() -> None:
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    asked = parser.add_mutually_exclusive_group(required=True)
    asked.add_argument("--share", type=float, help="prior share of unnamed functions (0.3 in the trace)")
    asked.add_argument("--noise", action="store_true", help="give the ladder its true noise")
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--secret", default="1", help="of the ladder")
    given = parser.parse_args()
    if given.noise:
        for rung, rows in ladder(given.secret, given.sessions).items():
            measured, true, best = np.sum(rows, axis=0)
            print(f"gain {rung}: {measured:g} / {true:g} / oracle {best:g} of {len(rows)}")
        return
    limits.nameless_share = given.share
    verdicts = [stranger(given.seed, index) for index in range(given.sessions)]
    show("strangers: a wrong name", [bool(one.wrong) for one in verdicts])
    show("two: both and nothing else", [found_both(given.seed, k) for k in range(given.sessions)])


if __name__ == "__main__":
    main()
