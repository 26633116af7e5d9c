"""Blind test sessions: drawn with what they hide, and written as a samples CSV that does not tell.

Size of an effect: its largest contribution to a reading, in standard uncertainties of that reading (noise
of the dwell and the fixture's share together), *after* projecting off the base model, to which the zeros of
the part belong; drawn from 4 to 12. A
draw is repeated where the excess of χ² that it causes past the base model (and past the other effect of the
session) is below `SEEN`: an effect that the base model or its partner absorbs is not in the session at all.
An undeclared effect is drawn again, besides, where a single catalogue name explains it to within `FOREIGN`:
it would be that name.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tracing.lens import Lens
from tracing.named_truth import NAMES, Term, draw_named
from tracing.plans import LSB_MG, Bench, Floats, draw_bench, draw_noise
from tracing.undeclared import BEYOND, GRAMMAR

KINDS = ("none", "one", "two", "uncatalogued", "beyond")
SIZES = (4.0, 12.0)
SEEN = 50.0
"""Least noncentrality: a test of two degrees of freedom, 1 % over a thousand candidates, has 97 % power."""
FOREIGN = 36.0
"""Least noncentrality of what the best single catalogue name leaves of an undeclared effect."""


@dataclass(frozen=True)
class Blind:
    """A session and its truth.

    Attributes
    ----------
    terms : tuple of Term
        What was put in, scaled.
    undeclared : bool
        Whether the first term is none of the catalogue's.
    readings_mg : (d, 2) float
        Means of the dwells, as the file holds them.
    """

    kind: str
    seed: tuple[int, ...]
    bench: Bench
    terms: tuple[Term, ...]
    undeclared: bool
    readings_mg: Floats

    @property
    def names(self) -> frozenset[str]:
        """Catalogue names that are in it."""
        return frozenset(term.name for term in self.terms[1 if self.undeclared else 0 :])


def draw(kind: str, seed: int, index: int) -> tuple[Blind, Floats]:
    """Session number `index` of a kind with its samples (n, 2) in mg; the same for the same arguments."""
    key = (seed, KINDS.index(kind), index)
    rng = np.random.default_rng(key)
    for _ in range(2000):
        bench = draw_bench(rng)
        terms = _draw_terms(kind, index, rng, bench)
        if terms is not None:
            break
    else:
        raise RuntimeError(f"no session of kind {kind} shows effect {index}")
    samples = _measure(bench, terms, rng)
    blind = Blind(kind, key, bench, terms, kind in {"uncatalogued", "beyond"}, bench.mean(samples))
    return blind, samples


def _draw_terms(kind: str, index: int, rng: np.random.Generator, bench: Bench) -> tuple[Term, ...] | None:
    """Terms of a session that this bench can show, or None."""
    if kind == "none":
        return ()
    lens = Lens(bench)
    rows, check = bench.dwells, bench.check
    if kind == "one":
        drawn = [draw_named(rng, NAMES[index % len(NAMES)], rows, check)]
    elif kind == "two":
        names = rng.choice(NAMES, 2, replace=False)
        drawn = [draw_named(rng, str(name), rows, check) for name in names]
    else:
        shapes = GRAMMAR if kind == "uncatalogued" else BEYOND
        drawn = [shapes[list(shapes)[index % len(shapes)]](rng, rows)]
        if (index // len(shapes)) % 3 == 2:  # every third round in company
            drawn.append(draw_named(rng, str(rng.choice(NAMES)), rows, check))
    have = {"surroundings": bench.has_surroundings, "approach": bench.has_approach}
    if not all(have[need] for term in drawn for need in term.needs):
        return None
    sized = []
    for term in drawn:
        peak = lens.peak(term)
        if not peak > 1e-9:
            return None
        sized.append(term.scaled(rng.uniform(*SIZES) / peak))
    if not believable(sized):
        return None
    for k, term in enumerate(sized):
        others = [lens.columns(other) for j, other in enumerate(sized) if j != k]
        if lens.unexplained(lens.contribution(term), others) < SEEN:
            return None
    if kind in {"uncatalogued", "beyond"}:
        target = lens.contribution(sized[0])
        if any(lens.unexplained_by_names(target, [name]) < FOREIGN for name in NAMES):
            return None
    return tuple(sized)


def believable(terms: list[Term]) -> bool:
    """Whether the sizes that a projection asks for are a bench's: an effect of at most some 100 mg."""
    limits = {
        "tempco": 20,
        "scale_tempco": 2000,
        "k2": 100,
        "k3": 100,
        "kip": 100,
        "kpp": 100,
        "asymmetry": 100,
        "supply": 500,
        "warm_up": 200,
        "lag": 50,
        "drift": 50,
        "scale_drift": 50000,
        "supply_scale": 500000,
        "misalignment_tempco": 0.1,
        "creep": 100,
        "per": 2,
        "ecc": 2,
        "ell": 2,
    }
    return all(
        abs(value) <= limits.get(label.rsplit("_", 1)[0], 300)
        for term in terms
        for label, value in zip(term.reported, term.coefficients, strict=False)
    )


def _measure(bench: Bench, terms: tuple[Term, ...], rng: np.random.Generator) -> Floats:
    """Samples (n, 2) in mg: the base model at the true angles, the zeros, the terms, and noise."""
    rows = bench.samples
    slips = np.deg2rad(bench.fixture_deg) * rng.normal(size=len(bench.check))
    psi = bench.alpha - rows.angle_rad + np.repeat(slips, np.diff(bench.starts))
    nominal = bench.ideal_mg(psi)
    for term in terms:
        if term.attitude:
            psi = psi + np.deg2rad(term.value(rows, nominal))
    ideal = bench.ideal_mg(psi)
    readings = ideal + sum((t.value(rows, ideal) for t in terms if not t.attitude), bench.zero_mg)
    samples = readings + draw_noise(rng, bench)
    return np.round(samples / LSB_MG) * LSB_MG if bench.in_steps else np.round(samples, 4)


def write(path: Path, blind: Blind, samples_mg: Floats) -> None:
    """The session as a samples CSV, which says nothing of what was put in."""
    bench, rows = blind.bench, blind.bench.samples
    angles = [repr(float(a)) for a in np.round(np.rad2deg(rows.angle_rad[bench.starts[:-1]]), 6)]
    uses = ["check" if check else "fit" for check in bench.check]
    header, columns = ["time_s", "position", "angle_deg"], []
    index = rows.order.astype(int)
    columns += [np.char.mod("%.4f", rows.time_s), index.astype(str), np.array(angles)[index]]
    if bench.has_approach:
        header.append("approach")
        columns.append(rows.approach.astype(int).astype(str))
    header += ["ax", "ay"]
    columns += list(np.char.mod("%.4f", samples_mg).T)
    if bench.has_surroundings:
        header += ["temp_c", "supply_v"]
        columns += [np.char.mod("%.3f", rows.temperature_c), np.char.mod("%.4f", rows.supply_v)]
    if bench.check.any():
        header.append("use")
        columns.append(np.array(uses)[index])
    lines = [
        "# sensor: generic",  # whose noise is what its samples show: no 1/f noise from a data sheet
        f"# fixture_sigma_deg: {bench.fixture_deg:g}",
        "# accel_unit: mg",
        ",".join(header),
        *map(",".join, zip(*columns, strict=True)),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
