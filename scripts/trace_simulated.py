"""Figures of `trace` on sessions of the simulated ADIS16354, through the archive file.

    python scripts/trace_simulated.py --sessions 40 --jobs 2
    python scripts/trace_simulated.py --case tumble-3s --effects 1 --keep /tmp/sessions
    python scripts/trace_simulated.py --case tumble-3s --alone creep

Sessions are those of `adis-gonio simulate`: the sensor of the seed (gains, misalignments, biases), its
white noise and its 1/f noise, on a stage of the default tolerance. A session says something false where
`trace` finds an effect that is not in its world, or something unnamed. Each rate stands with its 95 %
Wilson interval; the median of the smallest amplitudes that sessions would have shown is what caution costs.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from adis_gonio.base.uncertainty import wilson
from adis_gonio.record.plans import Plan, plan, write_plan

SHUFFLED = "18 angles of a turn in a drawn order"
CASES = {
    "tumble-3s": ("--plan", "tumble", "--dwell", "3"),
    "tumble-10s": ("--plan", "tumble"),
    "tumble-40s": ("--plan", "tumble", "--positions", "6", "--dwell", "40"),
    "turn-5s": ("--plan", SHUFFLED, "--dwell", "5"),
    "poses-5s": ("--plan", "poses", "--positions", "24", "--dwell", "5"),
    "quiet-3s": ("--plan", "tumble", "--dwell", "3", "--set", "bias_instability_mg=0"),
    "quiet-10s": ("--plan", "tumble", "--set", "bias_instability_mg=0"),
    "restless-5s": ("--plan", "tumble", "--dwell", "5", "--set", "bias_instability_mg=0.3"),
}
"""Options of `simulate`: plan, length of a dwell and, where it is not the default, the 1/f noise (`quiet`:
none, although the variant states some; `restless`: three times what it states)."""
BIASED = "bias"
"""The effect that every simulated sensor has."""
EFFECTS = (
    ("quadratic", "quadratic:k2_x=3"),
    ("cubic", "cubic:k3_y=5"),
    ("asymmetry", "asymmetry:asymmetry_y=3"),
    ("cross_axis", "cross_axis:kip_xy=3"),
    ("backlash", "backlash:backlash=0.15"),
    ("hysteresis", "hysteresis:hysteresis_x=1.5"),
    ("bias_drift", "bias_drift:drift_y=1.5"),
    ("outlier_dwell", "outlier_dwell:dwell=7,offset_x=5"),
    ("position_slip", "position_slip:dwell=5,slip=0.5"),
)
"""Effects of several times the smallest amplitude that 24 dwells of 3 s show."""
ALONE = {
    "creep": ("creep:creep_x=5,creep_y=-3,tau=20", ()),
    "stage_periodic": (
        "stage_periodic:cycles=17,per_sin=0.1,per_cos=0.05",
        ("--set", "fixture_sigma_deg=0.01"),
    ),
    "supply_scale": (
        "supply_scale:supply_scale_y=20000",
        ("--set", "fixture_sigma_deg=0.01", "--set", "supply_drift_v_per_h=-4"),
    ),
}
"""Effects that tests/tracing/test_trace_simulated.py puts in alone, by one seed: text, further options."""
POWER_OF = ("quadratic", "backlash", "hysteresis", "bias_drift", "outlier_dwell")


@dataclass(frozen=True)
class Answer:
    """What was said of one session.

    Attributes
    ----------
    truth, claimed : tuple of str
        Effects of the world beside the bias, and those found.
    unnamed : tuple of str
        Covariates of what was reported without a name.
    detectable : dict of str to float
        Smallest amplitudes that would have shown.
    """

    index: int
    truth: tuple[str, ...]
    claimed: tuple[str, ...]
    unnamed: tuple[str, ...]
    confounded: tuple[frozenset[str], ...]
    adequate: bool
    chi2: float
    detectable: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def false(self) -> tuple[str, ...]:
        """What is not so; a name is, where it is said that it may as well be one that was put in."""
        instead = {name for group in self.confounded if group & set(self.truth) for name in group}
        extra = tuple(name for name in self.claimed if name not in {*self.truth, BIASED, *instead})
        return extra + (("unnamed " + "+".join(self.unnamed),) if self.unnamed else ())

    @property
    def found(self) -> bool:
        """Every effect that was put in is called found, or named among those that cannot be told apart."""
        return set(self.truth) <= {*self.claimed, *(name for group in self.confounded for name in group)}


def drawn(count: int, index: int) -> tuple[tuple[str, str], ...]:
    """Effects of a session: `count` different ones of `EFFECTS`."""
    order = np.random.default_rng([count, index]).permutation(len(EFFECTS))
    return tuple(EFFECTS[k] for k in order[:count])


def shuffled(seed: int) -> Plan:
    """18 angles of a turn in a drawn order, each reached the direct way."""
    made = plan("mmpm", 18)
    drawn = [made.positions[k] for k in np.random.default_rng(seed).permutation(len(made))]
    ways = [np.sign(there.angle_deg - here.angle_deg) for here, there in itertools.pairwise(drawn)]
    turned = [replace(there, approach=int(way)) for there, way in zip(drawn[1:], ways, strict=True)]
    return replace(made, name="shuffled", positions=(drawn[0], *turned))


def simulate(path: Path, case: str, seed: int, effects: Sequence[str], further: Sequence[str] = ()) -> None:
    """Write a session as the command line does, to a place where there is none."""
    from adis_gonio.faces.cli.plan_commands import simulate_command

    if path.exists():
        return
    options = ["-o", str(path), "--seed", str(seed), *CASES[case], *further]
    if SHUFFLED in options:
        plan_file = path.with_suffix(".json")
        write_plan(plan_file, shuffled(seed))
        options[options.index(SHUFFLED)] = str(plan_file)
    for effect in effects:
        options += ["--effect", effect]
    with contextlib.redirect_stderr(io.StringIO()):
        simulate_command.main(options, standalone_mode=False)


def answer(folder: str, case: str, seed: int, count: int, alone: str | None, index: int) -> Answer:
    """Simulate one session and trace its file."""
    from adis_gonio import load_session, trace

    effects, further = drawn(count, index), ()
    if alone is not None:
        text, further = ALONE[alone]
        effects = ((alone, text),)
    path = Path(folder) / f"{case}-{seed}-{alone or count}-{index}.session"
    simulate(path, case, 1000 * seed + index, [text for _, text in effects], further)
    begin = time.perf_counter()
    result = trace(load_session(path))
    return Answer(
        index=index,
        truth=tuple(name for name, _ in effects),
        claimed=tuple(finding.effect for finding in result.found),
        unnamed=() if result.unnamed is None else result.unnamed.covariates,
        confounded=tuple(frozenset(group) for group in result.confounded),
        adequate=result.adequate,
        chi2=result.after.chi2_per_dof or np.nan,
        detectable={name: entry.amplitude or np.nan for name, entry in result.detectable.items()},
        seconds=time.perf_counter() - begin,
    )


def rate(hits: Sequence[bool]) -> str:
    """A rate with its interval."""
    count, n = sum(hits), len(hits)
    low, high = wilson(count, n)
    return f"{count / n:6.1%}  [{low:6.1%}, {high:6.1%}]  {count}/{n}"


def lines(case: str, answers: Sequence[Answer]) -> list[str]:
    """Figures of a case."""
    out = [
        f"{case:12} something false            {rate([bool(a.false) for a in answers])}",
        f"{case:12} called adequate            {rate([a.adequate for a in answers])}",
    ]
    if any(a.truth for a in answers):
        out.append(f"{case:12} all that was put in found  {rate([a.found for a in answers])}")
    chi2 = np.array([a.chi2 for a in answers])
    spent = np.array([a.seconds for a in answers])
    out.append(f"{case:12} χ² / dof, mean             {np.nanmean(chi2):6.3f}")
    out.append(f"{case:12} seconds a session, median  {np.median(spent):6.2f}  (max {spent.max():.2f})")
    told = Counter(name for a in answers for name in a.false)
    if told:
        out.append(f"{case:12} false: " + "; ".join(f"{n}× {name}" for name, n in told.most_common()))
    power = {name: np.array([a.detectable.get(name, np.nan) for a in answers]) for name in POWER_OF}
    shown = [f"{name} {np.nanmedian(v):.3g}" for name, v in power.items() if np.isfinite(v).any()]
    if shown:
        out.append(f"{case:12} smallest shown, median: " + ", ".join(shown))
    return out


def main() -> int:
    """Simulate, trace and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", choices=[*CASES, "all"], default="all")
    parser.add_argument("--sessions", type=int, default=40, help="sessions of each case (default 40)")
    parser.add_argument("--effects", type=int, default=0, help="effects of a session beside the bias")
    parser.add_argument("--alone", choices=ALONE, help="this effect alone, instead of --effects")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder of the sessions, which are made where missing")
    options = parser.parse_args()
    every: list[Answer] = []
    with tempfile.TemporaryDirectory() as scratch, ProcessPoolExecutor(options.jobs) as pool:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for case in CASES if options.case == "all" else (options.case,):
            one = partial(answer, str(folder), case, options.seed, options.effects, options.alone)
            answers = list(pool.map(one, range(options.sessions), chunksize=2))
            every += answers
            print("\n".join(lines(case, answers)), flush=True)
            for entry in answers:
                if entry.false or not entry.found:
                    said = "+".join(entry.claimed) + (f" unnamed {entry.unnamed}" if entry.unnamed else "")
                    print(f"    {case} {entry.index}: {'+'.join(entry.truth)} → {said}", flush=True)
    if options.case == "all":
        print(f"{'all':12} something false            {rate([bool(a.false) for a in every])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
