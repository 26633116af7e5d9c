"""What the simple runners share: samples CSV, noise by batch means, columns of the catalogue, answer.

They see what every entrant sees, and nothing of the truth.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..answers import AnswerError, empty
from ..catalogue import NAMES, Term, terms
from ..circumstances import STANDARD_MPS2, Circumstances, Floats
from ..likelihood import Linear, Whitened, base_parameters, linearise

LSB_MG = 0.4672
FLICKER_MG = 0.1
"""What slow noise adds to a reading beyond the scatter within its dwell: the part's (an estimate)."""
_BATCHES = 8


@dataclass
class Table:
    """A samples CSV by dwells.

    Attributes
    ----------
    c : Circumstances
    reading_mg : (n, axes) float
        Means; NaN in hidden cells.
    covariance : list of (n, n) float
        Of each axis, by batch means, mg².
    fixture_rad, gravity_mg : float
    hidden_sign : (n,) float
        In space the sign of the hidden cell of a check dwell; else 0.
    """

    c: Circumstances
    reading_mg: Floats
    covariance: list[Floats]
    fixture_rad: float
    gravity_mg: float
    hidden_sign: Floats


def read(path: Path) -> Table:
    """Read a samples CSV as `generator` writes it.

    Raises
    ------
    AnswerError
        A file that is none.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    keys = dict(line[1:].split(":", 1) for line in lines if line.startswith("#"))
    keys = {k.strip(): v.strip() for k, v in keys.items()}
    rows = [line.split(",") for line in lines if not line.startswith("#")]
    if len(rows) < 2 or "position" not in rows[0]:
        raise AnswerError(f"{path.name}: no samples CSV with a column `position`")
    head, body = rows[0], rows[1:]
    column = {name: [row[k] for row in body] for k, name in enumerate(head)}
    number = {k: np.array([float(x) if x else np.nan for x in v]) for k, v in column.items() if k != "use"}
    plane = keys.get("plane", "xy") == "xy"
    axes = ["ax", "ay"] if plane else ["ax", "ay", "az"]
    position = number["position"].astype(int)
    dwells = [np.flatnonzero(position == p) for p in dict.fromkeys(position.tolist())]
    scale = LSB_MG if keys.get("accel_unit", "lsb") == "lsb" else 1.0
    samples = np.column_stack([number[a] for a in axes]) * scale

    def of(name: str) -> Floats:
        if name not in number:
            return np.full(len(dwells), np.nan)
        return np.array([number[name][d].mean() for d in dwells])

    time_s = of("time_s")
    u = float(keys.get("reading_u_mg", 0))
    covariance, variance = [], np.zeros((len(dwells), len(axes)))
    for i in range(len(axes)):
        spread = []
        for k, d in enumerate(dwells):
            if len(d) >= 2 * _BATCHES:
                means = [part.mean() for part in np.array_split(samples[d, i], _BATCHES)]
                spread.append(np.var(means, ddof=1) / _BATCHES)
                variance[k, i] = np.var(samples[d, i])
        v = u**2 if u else (np.mean(spread) if spread else 0.04) + FLICKER_MG**2
        covariance.append(np.eye(len(dwells)) * v)
    extra = variance - variance.min(axis=0)
    if not variance.any() or not np.any(variance.max(axis=0) > 3 * variance.min(axis=0)):
        extra = np.zeros_like(variance)  # alike everywhere: no vibration
    approach = of("approach")
    c = Circumstances(
        plane,
        time_s - time_s[0],
        np.radians(of("angle_deg")) if plane else np.zeros(len(dwells)),
        of("temp_c"),
        of("supply_v"),
        np.nan_to_num(approach),
        extra,
        np.array([column["use"][d[0]] == "check" for d in dwells]),
    )
    gravity = float(keys.get("gravity_mps2", STANDARD_MPS2)) / STANDARD_MPS2 * 1000
    fixture = keys.get("fixture_sigma_deg", "0")
    return Table(
        c,
        np.array([samples[d].mean(axis=0) for d in dwells]),
        covariance,
        0.0 if fixture == "free" else np.radians(float(fixture)),
        gravity,
        np.nan_to_num(of("hidden_sign")),
    )


@dataclass
class Feature:
    """One column: `name` of the catalogue, or `~covariate` for a cause without a name."""

    name: str
    parameter: str
    column: Floats


class Prepared:
    """A session with its base model fitted and every candidate's column beside it.

    Attributes
    ----------
    x : (rows, K) float
        Columns of the features beside base model and bias, whitened, each of length 1.
    y : (rows,) float
        Residual, whitened: its noise has standard deviation about 1.
    """

    def __init__(self, directory: Path, single_dwells: bool = True) -> None:
        self.table = read(directory / "session.csv")
        self.hidden = np.isnan(self.table.reading_mg)
        self.linear = self._linearise()
        self.white = Whitened(self.linear)
        self.features = [f for f in self._features() if single_dwells or "dwell" not in f.parameter]
        z = [self.white.project(self.white.white(f.column[:, None]))[:, 0] for f in self.features]
        raw = [np.linalg.norm(self.white.white(f.column[:, None])) for f in self.features]
        keep = [k for k in range(len(z)) if np.linalg.norm(z[k]) > 1e-5 * max(raw[k], 1e-9)]
        self.features = [self.features[k] for k in keep]
        self.x = np.array([z[k] / np.linalg.norm(z[k]) for k in keep]).T
        self.y = self.white.left

    def _linearise(self) -> Linear:
        t = self.table
        r = t.reading_mg.copy()
        if t.c.plane:
            r[self.hidden] = 0.0
        for _ in range(1 if t.c.plane else 3):
            if not t.c.plane:
                for k, i in np.argwhere(self.hidden):
                    if np.isnan(r[k, i]):
                        others = np.nansum(r[k] ** 2)
                        r[k, i] = t.hidden_sign[k] * np.sqrt(max(t.gravity_mg**2 - others, 1.0))
            linear = linearise(t.c, r, t.covariance, t.fixture_rad, t.gravity_mg)
            if not t.c.plane:
                for k, i in np.argwhere(self.hidden):
                    r[k, i] -= linear.e[k] / linear.to_rows[k, i * t.c.n + k]
        self.filled = r
        return linearise(t.c, r, t.covariance, t.fixture_rad, t.gravity_mg)

    def _features(self) -> list[Feature]:
        c, a = self.linear.c, self.linear.ideal_g
        out = []
        for name in NAMES:
            ways = terms(name, c, a)
            widest = max((len(t.parameters) for t in ways), default=0)
            for t in [t for t in ways if len(t.parameters) == widest] if name != "position_slip" else ways:
                columns = self.linear.columns(t)
                label = t.label[t.label.find("(") :] if "(" in t.label else ""
                out += [Feature(name, p + label, columns[:, k]) for k, p in enumerate(t.parameters)]
        return out + [
            Feature(f"~{word}", f"~{k}", column) for k, (word, column) in enumerate(self._nameless(c, a))
        ]

    def _nameless(self, c: Circumstances, a: Floats) -> list[tuple[str, Floats]]:
        """Products of a place (zero, gain, angle) and a covariate that the catalogue does not have."""
        drives = {"time": [c.minutes / max(c.minutes[-1], 1e-9)]}
        if not np.isnan(c.temp_c).any():
            drives["temperature"] = [(c.temp_c - c.temp_c.mean()) / max(np.ptp(c.temp_c), 1e-9)]
        if not np.isnan(c.supply_v).any():
            drives["supply"] = [(c.supply_v - c.supply_v.mean()) / max(np.ptp(c.supply_v), 1e-9)]
        if np.ptp(c.approach) > 0:
            drives["approach"] = [c.approach]
        drives["pause"] = [c.pause_s / c.pause_s.max()]
        out = []
        for word, (x,) in drives.items():
            for i in range(c.axes):
                for shape in [x**2, a[:, i] * x, a[:, i] * x**2] if word != "approach" else [a[:, i] * x]:
                    value = np.zeros((c.n, c.axes, 1))
                    value[:, i, 0] = shape
                    out.append((word, self.linear.rows(value, np.zeros((c.n, 1)))[:, 0]))
            if c.plane:
                nothing = np.zeros((c.n, c.axes, 1))
                out.append((word, self.linear.rows(nothing, np.radians(x)[:, None])[:, 0]))
        if c.plane:
            nothing = np.zeros((c.n, c.axes, 1))
            for k in (3, 4, 5, 6):
                for f in (np.sin, np.cos):
                    out.append(
                        ("angle", self.linear.rows(nothing, np.radians(f(k * c.angle_rad))[:, None])[:, 0])
                    )
        return out

    def gain(self, chosen: list[int]) -> float:
        """2Δ ln L of features together, at unit noise."""
        if not chosen:
            return 0.0
        q, s, _ = np.linalg.svd(self.x[:, chosen], full_matrices=False)
        return float(np.sum((q[:, s > 1e-6].T @ self.y) ** 2))

    def partial(self, chosen: list[int]) -> list[float]:
        """2Δ ln L of each feature beside the others."""
        whole = self.gain(chosen)
        return [whole - self.gain([j for j in chosen if j != k]) for k in chosen]

    def prune(self, chosen: list[int], least: float) -> list[int]:
        """Drop the least feature until each gains at least that much beside the others."""
        chosen = list(chosen)
        while chosen:
            gains = self.partial(chosen)
            k = int(np.argmin(gains))
            if gains[k] >= least:
                break
            chosen.pop(k)
        return chosen

    def answer(self, chosen: list[int], sets: list[dict[str, Any]] | None = None) -> dict[str, Any]:
        """The answer of who chose these features; without sets each name stands alone at its BIC weight."""
        out = empty()
        columns = np.column_stack(
            [np.zeros((len(self.linear.e), 0)), *(self.features[k].column for k in chosen)]
        )
        values, covariance = self.white.solve(columns)
        u = np.sqrt(np.maximum(np.diag(covariance), 0))
        p = len(self.linear.values)
        out["base"] = base_parameters(
            self.linear.names, self.linear.values + values[:p], covariance[:p, :p]
        )
        parameters: dict[str, dict[str, Any]] = {}
        by_name: dict[str, list[int]] = {}
        for j, k in enumerate(chosen):
            feature = self.features[k]
            by_name.setdefault(feature.name, []).append(k)
            clean = feature.parameter.split("(")[0]
            parameters.setdefault(feature.name, {})[clean] = {
                "value": float(values[p + j]),
                "u": float(u[p + j]),
            }
        weight = {}
        for name, members in by_name.items():
            rest = [k for k in chosen if k not in members]
            logit = (self.gain(chosen) - self.gain(rest) - len(members) * np.log(len(self.y))) / 2 - np.log(
                20
            )
            weight[name] = float(1 / (1 + np.exp(-np.clip(logit, -50, 50))))
        out["covariates"] = sorted({n[1:] for n in by_name if n.startswith("~")})
        if sets is None:
            named = [n for n in by_name if not n.startswith("~")]
            sets = [
                {"names": [n], "probability": [weight[n]]} for n in sorted(named, key=lambda n: -weight[n])
            ]
        out["causes"] = [s | {"parameters": parameters.get(s["names"][0], {})} for s in sets]
        out["something"] = max(weight.values(), default=self._quiet())
        out["heldout"] = self._heldout(values, columns)
        return out

    def _quiet(self) -> float:
        """Probability of something where nothing was chosen: BIC weight of the best single feature."""
        best = float(np.max((self.x.T @ self.y) ** 2)) if self.x.size else 0.0
        logit = (best - np.log(len(self.y))) / 2 - np.log(20)
        return float(1 / (1 + np.exp(-np.clip(logit, -50, 50))))

    def _heldout(self, values: Floats, columns: Floats) -> dict[str, Any]:
        left = self.linear.e - np.hstack([self.linear.base, columns]) @ values
        return predictions(self.table.c, self.linear, self.filled, left, self.hidden)


def predictions(
    c: Circumstances, linear: Linear, filled: Floats, left: Floats, hidden: Any
) -> dict[str, Any]:
    """Predicted cells of the check dwells; `left` (rows,) is what the model leaves of `filled`."""
    out: dict[str, Any] = {}
    for k in np.flatnonzero(c.check):
        cell = {}
        for i, axis in enumerate(("ax", "ay", "az")[: c.axes]):
            if c.plane:
                cell[axis] = float(filled[k, i] - left[i * c.n + k])
            elif hidden[k, i]:
                cell[axis] = float(filled[k, i] - left[k] / linear.to_rows[k, i * c.n + k])
        out[str(k)] = cell
    return out


OVERRIDE: dict[str, dict[str, float]] = {}
"""Settings that tune.py tries."""


def tuned(name: str) -> dict[str, float]:
    """Settings of a runner as tuned on its training set (tuned.json, written by tune.py)."""
    if name in OVERRIDE:
        return OVERRIDE[name]
    values: dict[str, dict[str, float]] = json.loads(
        (Path(__file__).parent / "tuned.json").read_text(encoding="utf-8")
    )
    return values[name]


__all__ = ["Feature", "Prepared", "Table", "Term", "predictions", "read", "tuned"]
