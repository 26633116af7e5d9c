"""`trace` against the usual ways of choosing terms, on the same blind sessions and candidate columns.

All peers get the candidates of `scripts/trace_peers.py`: whitened columns of every name of the catalogue on
each axis, base model projected out, and the true noise of the readings, which `trace` has to estimate from
the samples. Their time holds building the columns, `trace`'s reading the file.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from speed.timing import Row, quartiles, require

ROOT = Path(__file__).parents[2]
Floats = NDArray[np.float64]
Select = Callable[[Floats, Floats, int], list[int]]
KINDS = ("none", "one", "two")
MOST = 8
"""Columns at most, where a method asks for a limit."""


def _bic(y: Floats, x: Floats) -> float:
    import statsmodels.api as sm

    found = sm.WLS(y, x, weights=1.0).fit() if x.size else None
    squares = float(y @ y) if found is None else float(found.ssr)
    return squares + np.log(len(y)) * x.shape[1]  # the noise is known: whitened, it is 1


def stepwise_statsmodels(x: Floats, y: Floats, dwells: int) -> list[int]:
    """Forward and backward by BIC, each model fitted by statsmodels."""
    chosen: list[int] = []
    best = _bic(y, x[:, []])
    while len(chosen) < MOST:
        left = y if not chosen else y - x[:, chosen] @ np.linalg.lstsq(x[:, chosen], y, rcond=1e-8)[0]
        likely = [k for k in np.argsort(-np.abs(x.T @ left))[:12].tolist() if k not in chosen]
        moves = [[*chosen, k] for k in likely] + [[c for c in chosen if c != k] for k in chosen]
        scored = [(_bic(y, x[:, move]), move) for move in moves]
        value, to = min(scored, key=lambda pair: pair[0])
        if value >= best - 1e-9:
            break
        best, chosen = value, to
    return chosen


def sequential_sklearn(x: Floats, y: Floats, dwells: int) -> list[int]:
    """scikit-learn's SequentialFeatureSelector, forward, until five folds gain under 2 %."""
    from sklearn.feature_selection import SequentialFeatureSelector
    from sklearn.linear_model import LinearRegression

    # The 60 columns nearest to the residual: the selector fits every candidate anew in each fold.
    near = np.argsort(-np.abs(x.T @ y))[:60]
    groups = np.repeat(np.arange(dwells) % 5, 2)
    folds = [(np.flatnonzero(groups != k), np.flatnonzero(groups == k)) for k in range(5)]
    search = SequentialFeatureSelector(
        LinearRegression(fit_intercept=False),
        n_features_to_select="auto",
        tol=0.02 * float(np.mean(y**2)),
        scoring="neg_mean_squared_error",
        cv=folds,
    )
    return [int(k) for k in near[search.fit(x[:, near], y).get_support()]]


def _peers() -> dict[str, Select]:
    _reach()
    import trace_peers

    return {
        "scikit-learn LassoCV": trace_peers.lasso_cv,
        "scikit-learn SequentialFeatureSelector": sequential_sklearn,
        "pysindy STLSQ": trace_peers.stlsq,
        "statsmodels stepwise BIC": stepwise_statsmodels,
    }


def _reach() -> None:
    """The blind sessions of the tests, and the peers' columns."""
    for folder in ("tests", "scripts"):
        if str(ROOT / folder) not in sys.path:
            sys.path.insert(0, str(ROOT / folder))


def _names_alone(names: list[str]) -> dict[str, Any]:
    """The JSON of a trace that names these effects."""
    rms = {"heldout_rms_mg": None}
    return {
        "adequate": True,
        "found": [{"effect": n, "axes": [], "parameters": {}} for n in dict.fromkeys(names)],
        "unnamed": None,
        "confounded": [],
        "error": {"before": rms, "after": rms},
    }


def run(seed: int, *, fast: bool) -> list[Row]:
    """Rows of every peer: time, and share of sessions named exactly and with a wrong name."""
    peers = _peers()
    from adis_gonio import load_session, trace
    from trace_peers import columns_of
    from tracing.blind import draw, write
    from tracing.verdict import judge

    sessions = [(kind, k) for kind in KINDS for k in range(1 if fast else 6)]
    times: dict[str, list[float]] = {name: [] for name in ("", *peers)}
    right = dict.fromkeys(times, 0)
    false = dict.fromkeys(times, 0)
    known = _known(peers)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a path that does not converge is the method's own affair
        for round_, (kind, index) in enumerate([sessions[0], *sessions]):
            blind, samples = draw(kind, seed, index)
            path = Path(folder) / f"{kind}{index}.csv"
            write(path, blind, samples)

            def ours(path: Path = path) -> dict[str, Any]:
                answer: dict[str, Any] = json.loads(json.dumps(trace(load_session(path)).as_dict()))
                return answer

            def theirs(select: Select, blind: Any = blind) -> dict[str, Any]:
                columns = columns_of(blind, with_nameless=False)
                x, y = columns.past_base(~columns.check)
                chosen = select(x, y, int((~columns.check).sum()))
                return _names_alone([columns.labels[k][0] for k in chosen])

            for name in times:
                began = time.process_time()
                answer = theirs(peers[name]) if name else ours()
                spent = time.process_time() - began
                if not round_:  # the warm-up
                    continue
                times[name].append(spent)
                said = judge(blind, answer)
                right[name] += said.exact
                false[name] += bool(said.wrong) or said.unnamed
    n = len(sessions)
    rows = []
    for name in peers:
        ratios = [a / b for a, b in zip(times[name], times[""], strict=True)]
        low, middle, high = quartiles(ratios)
        note = (
            f"named exactly {right[name]} of {n}, `trace` {right['']}; "
            f"something false {false[name]}, `trace` {false['']}"
        )
        figures = {"sessions": n, "right": right[name], "false": false[name]}
        figures |= {"trace_right": right[""], "trace_false": false[""]}
        rows.append(Row("trace, blind sessions", name, middle, low, high, n, known[name], note, figures))
    return rows


def _known(peers: dict[str, Select]) -> dict[str, str]:
    """That every peer finds a column of 30 standard uncertainties among 100: else it is not set up."""
    rng = np.random.default_rng(0)
    x = rng.normal(0, 1, (96, 100))
    x /= np.linalg.norm(x, axis=0)
    y = 30.0 * x[:, 17] + rng.normal(0, 1, 96)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {
            name: require(17 in select(x, y, 48), "finds a column of 30 u among 100")
            for name, select in peers.items()
        }
