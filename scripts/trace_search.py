"""Count the sessions in which the search of `trace` never scored the true model.

    python scripts/trace_search.py --sessions 300 --seed 1 --jobs 2

Sessions with one or two effects of the catalogue are drawn from tests/tracing (`one`, `two`) and from the
challenge in benchmarks/blind_residual (`catalogue`, `two of the ladder`). For each session every variant of
the true names (axes, shapes, dwells), with and without each bias, is scored by itself. A row of the result
gives the sessions in which the best of these models has no score from the search, and those in which it
also beats the best model of the search. The exit status is 1 if the last number is not 0.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.fitting.estimation.readings import ACCELEROMETER, readings_of_part
from adis_gonio.fitting.slips.session_positions import positions_of
from adis_gonio.model.records import Session
from adis_gonio.record.loading import load_session
from adis_gonio.tracing.model_search import Model, Search
from adis_gonio.tracing.trace import TraceRun, correct_slips
from blind_residual.generator import draw as draw_ladder
from tracing.blind import draw, write

KINDS = ("one", "two", "catalogue", "two of the ladder")
BEATS = 1e-3
"""Score in nats by which a model has to exceed the best one; less is rounding."""


@dataclass(frozen=True)
class Figure:
    """Outcome of one session.

    Attributes
    ----------
    names : tuple of str
        The true effects.
    shown : bool
        False if the session cannot show them, so that they are no candidates.
    scored : bool
        True if the search scored the best model of the true names.
    behind : float
        Score of the best model minus the score of the best model of the true names, in nats.
    seconds : float
        Processor time of the search.
    """

    kind: str
    index: int
    names: tuple[str, ...]
    shown: bool
    scored: bool
    behind: float
    seconds: float

    @property
    def missed(self) -> bool:
        """True if the true model has no score and would be the best one."""
        return self.shown and not self.scored and self.behind < -BEATS


def written(kind: str, seed: int, index: int, folder: Path) -> tuple[Path, tuple[str, ...]]:
    """Write one session to a folder; return its path and the names of its effects."""
    path = folder / f"{kind}_{index}.csv"
    if kind in ("one", "two"):
        blind, samples = draw(kind, seed, index)
        write(path, blind, samples)
        return path, tuple(sorted(blind.names))
    csv, truth = draw_ladder(f"search {seed}", index, "two" if kind.startswith("two") else kind)
    path.write_text(csv, encoding="utf-8")
    return path, tuple(sorted(truth.names))


def searched(session: Session) -> Search:
    """Return the final search of a session, as `trace` makes it."""
    positions = positions_of(session)
    data = correct_slips(readings_of_part(session, ACCELEROMETER), positions)
    run = TraceRun(data, 6, positions)
    run.search()
    return run.selection.found


def true_models(found: Search, names: Sequence[str]) -> Iterator[Model]:
    """Yield each model with one variant of each name, with and without each bias."""
    terms = found.problem.terms
    of_name = [[k for k, term in enumerate(terms) if term.name == name] for name in names]
    biases = [k for k, term in enumerate(terms) if term.constant and "bias" not in names]
    for chosen in itertools.product(*of_name):
        for extra in ((), *((k,) for k in biases)):
            model = tuple(sorted((*chosen, *extra)))
            width = sum(int(found.problem.width[k]) for k in model)
            if found.problem.dof - width >= max(found.problem.dof // 2, 1):
                yield model


def figure(kind: str, seed: int, index: int) -> Figure:
    """Draw a session, search it, and compare with the best model of the true names."""
    with tempfile.TemporaryDirectory() as folder:
        path, names = written(kind, seed, index, Path(folder))
        session = load_session(path)
    begun = time.process_time()
    found = searched(session)
    seconds = time.process_time() - begun

    def score(model: Model) -> float:
        explained = 0.5 * found.problem.gain(model) / found.inflation
        return explained - float(sum(found.prices[k] for k in model))

    truths = {model: score(model) for model in true_models(found, names)}
    if not truths:
        return Figure(kind, index, names, False, False, 0.0, seconds)
    true = max(truths, key=truths.__getitem__)
    behind = found.scores[found.best] - truths[true]
    return Figure(kind, index, names, True, true in found.scores, behind, seconds)


def main() -> int:
    """Draw, search and print a row for each kind of session."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kind", choices=(*KINDS, "all"), default="all")
    parser.add_argument("--sessions", type=int, default=100, help="sessions of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first session")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    kinds = KINDS if given.kind == "all" else (given.kind,)
    missed = 0
    with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
        for kind in kinds:
            numbers = range(given.first, given.first + given.sessions)
            every = list(pool.map(figure, [kind] * given.sessions, [given.seed] * given.sessions, numbers))
            shown = [one for one in every if one.shown]
            never = [one for one in shown if not one.scored]
            better = [one for one in never if one.missed]
            seconds = sorted(one.seconds for one in every)
            print(
                f"{kind:18}  {len(shown):4} sessions  true model never scored {len(never):3}, "
                f"of these better than the best {len(better):3}  "
                f"({seconds[len(seconds) // 2]:.2f} s median, {seconds[-1]:.1f} s at most)",
                flush=True,
            )
            for one in better:
                print(f"    session {one.index}: {' + '.join(one.names)}, {-one.behind:.1f} nats better")
            missed += len(better)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
