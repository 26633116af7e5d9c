"""The page of all results, docs/results/index.md, from the JSON documents of its sections.

python scripts/results/page.py            # writes the page
python scripts/results/page.py --check    # exit 1 if the page is out of date
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "results"
HEAD = """\
# Results

<!-- written by scripts/results/page.py from the JSON files of this folder: change it there -->

The figures of this page come from simulated sessions with a known truth. Each section names the command
and the seed that make it again; `NAME.json` in this folder has all numbers. *Coverage* is the share of
intervals (U, 95 %) that contain the truth; the *bound* is the Cramér–Rao bound.
"""

Document = Mapping[str, Any]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def percent(share: float, digits: int = 1) -> str:
    """A share in percent."""
    return f"{100 * share:.{digits}f} %"


def trace(found: Document) -> str:
    """Tables of the trace, as `scripts/trace_ablation.py` and its sisters printed them."""
    parts = []
    for one in found["tables"]:
        parts += [f"### {one['title']}", one["text"]]
        if one.get("rows"):
            parts.append(table(one["head"], one["rows"]))
    return "\n\n".join(parts)


def angle(found: Document) -> str:
    """Error of the shown angle by method."""
    methods = ("paper", "two-position", "four-position", "mmpm", "ml", "trace")
    rows = []
    for plan, positions in (
        ("two-position", None),
        ("four-position", None),
        ("mmpm", None),
        ("tumble", 12),
    ):
        for kind in ("none", "bias", "quadratic"):
            by_method = {
                one["method"]: one["calibration"]
                for one in found["angle"]
                if (one["plan"], one["positions"], one["kind"], one["fixture_deg"])
                == (plan, positions, kind, 0.02)
            }
            if by_method and (kind != "none" or plan in methods[1:3]):
                cells = [f"{by_method[m]['rms']:.4f}" if m in by_method else "–" for m in methods]
                bound = next(iter(by_method.values()))["bound"]
                name = f"{plan} {positions}" if positions else plan
                rows.append((name, kind, *cells, f"{bound:.4f}" if bound else "–"))
    all_lines = found["efficiency"]
    lowest = min(all_lines, key=lambda one: one["efficiency"])
    high = sum(one["efficiency"] >= 0.98 for one in all_lines)
    return "\n\n".join(
        (
            "Error of the corrected angle in degrees, rms over 72 angles that the session did not visit, "
            "fixture "
            "0.02°, noise of a reading 0.2 mg. Parts: no bias; 10 mg on each axis (`bias`); also 2 mg/g² "
            "on X "
            "(`quadratic`).",
            table(("plan", "part", *(f"`{m}`" for m in methods), "bound"), rows),
            "![Error over the turn with a bias](angle-bias.svg)",
            f"The efficiency of `ml` (bound over mean square error) is 0.98 or more in {high} of "
            f"{len(all_lines)} combinations of parameter, plan, fixture and noise. The lowest is "
            f"{lowest['efficiency']:.3f} ({lowest['low']:.3f} to {lowest['high']:.3f}): "
            f"{lowest['parameter']}, {lowest['positions']} positions, fixture {lowest['fixture_deg']}°.",
        )
    )


def paper(found: Document) -> str:
    """The seed paper's comparison."""
    crossing = {
        one["bias_mg"]: one["fixture_deg"]
        for one in found["crossing_of_delta_k"]
        if one["noise_mg"] == 0.16
    }
    rows = {f"{row['name']}": row["sessions"] for row in found["table_1"]["rows"]}
    wanted = ("paper", "mmpm", "ml", "traced")
    gain, skew = (
        ", ".join(f"`{name}` {rows[key][name]['error']:.2g}" for name in wanted if rows[key][name]["error"])
        for key in ("SF, X", "N, X")
    )
    return "\n\n".join(
        (
            f"Error (rms) of the gain of X: {gain}; of the angle between the axes in degrees: {skew}. "
            "`adis-gonio paper --json` has all rows of the paper's table 1.",
            "The paper's method is better than MMPM in ΔK if the fixture is worse than "
            f"{crossing[0.0]:.3f}° (no bias) or {crossing[10.0]:.1f}° (10 mg), because two positions "
            "hardly show fixture errors in the gains. In Δφ it is never better. "
            "[Theory](../theory.md#open-points-of-the-seed-paper) lists the points that the paper leaves "
            "open.",
        )
    )


def plan(found: Document) -> str:
    """Predicted and simulated uncertainties of plans."""
    by = {(one["case"], one["fixture_deg"], one["name"]): one for one in found["lines"]}
    rows = []
    for best, other in (("best 12", "even 12"), ("best 12", "tumble 12"), ("best 24", "even 24")):
        for fixture in (0.01,):
            cells = []
            for name in ("angle", "delta_k", "delta_phi"):
                if (best, fixture, name) in by:
                    one, two = by[best, fixture, name], by[other, fixture, name]
                    gain = two["predicted"] / one["predicted"], two["simulated"] / one["simulated"]
                    cells.append(f"{gain[0]:.2f} / {gain[1]:.2f}")
            if cells:
                rows.append((best, other, f"{fixture}°", *cells))
    ratios = [one["ratio"] for one in found["lines"]]
    close = sum(abs(ratio - 1) <= 0.05 for ratio in ratios)
    names = found["names"]
    right = {
        (order, effect): f"{counts[0]} of {names['sessions']}"
        for order, by_effect in names["right_and_wrong"].items()
        for effect, counts in by_effect.items()
    }
    return "\n\n".join(
        (
            f"Of {len(ratios)} predicted uncertainties, {close} are within 5 % of the error of "
            f"{found['sessions']} "
            f"simulated sessions per plan (largest ratio {max(ratios):.2f}). Gain of the best plan, "
            "predicted / "
            "simulated:",
            table(("best", "over", "fixture", "angle", "ΔK", "Δφ"), rows),
            "![Simulated over predicted](plan-ratios.svg)",
            "Twelve positions in the best order name a `bias_drift` in "
            f"{right['best', 'bias_drift']} sessions and a `stage_eccentricity` in "
            f"{right['best', 'stage_eccentricity']}; in even order {right['even', 'bias_drift']} and "
            f"{right['even', 'stage_eccentricity']}.",
        )
    )


def free_turn(found: Document) -> str:
    """Coverage of the free turn, and its angle against 24 dwells."""
    rows = []
    for key, name in (
        ("two_turns", "two turns"),
        ("forth_and_back", "forth and back"),
        ("one_turn", "one turn"),
    ):
        one = found[key]
        shares = [percent(one["coverage"][k]) for k in ("delta_k", "delta_phi", "bias_x", "angle")]
        low, high = one["ratio_95"]
        ratio = f"{one['ratio']:.2f} ({low:.2f} to {high:.2f})"
        rows.append((name, str(one["hands"]), *shares, f"{one['angle_rms_deg']:.4f}°", ratio))
    head = ("60 s", "hands", "ΔK", "Δφ", "bias of X", "angle", "error of the angle", "over 24 dwells")
    return "\n\n".join(
        (
            "Coverage of U, and the error of the angle relative to 24 dwells with equal measuring time.",
            table(head, rows),
            "![Error of the angle, hand by hand](free_turn-errors.svg)",
        )
    )


def gyros(found: Document) -> str:
    """Gains of the gyros from whole turns."""
    one = found["gyro_scale"]
    xy, yx = (f"{one['misalignment_u_deg_by_name'][pair]:.3f}°" for pair in ("xy", "yx"))
    rows = [
        ("coverage of U, gains", percent(one["coverage"])),
        ("coverage of U, misalignments", percent(one["coverage_of_misalignment"])),
        (
            "u / error / bound of a gain, rms",
            " / ".join(f"{100 * one[k]:.4f} %" for k in ("u_rms", "error_rms", "bound_rms")),
        ),
        ("u of `gyro_misalignment_xy` / `yx`, median", f"{xy} / {yx}"),
        ("share of 1/f noise in the bound", percent(one["share_of_bound"]["flicker"])),
    ]
    return "\n\n".join(
        (
            f"{one['hands']} simulated hands, plan `gyro-turns`: five turns each way at "
            f"{one['rate_dps']:.0f} °/s.",
            table(("figure", "value"), rows),
            "![Error of the gains over their bound](gyros-errors.svg)",
        )
    )


def links(found: Document) -> str:
    """Turns between poses in space."""
    one = found["links"]
    rows = []
    for poses, at in one["poses"].items():
        if poses not in ("4", "6", "9", "14"):
            continue
        row = [poses]
        for kind, factor, unit in (("scale", 100.0, " %"), ("skew", 1.0, "°")):
            for way in ("alone", "sheet", "calibrated"):
                u = at[way][kind]["u"]
                row.append("–" if u is None else f"{factor * u:.2g}{unit}")
        ways = [at[way][kind] for way in ("sheet", "calibrated") for kind in ("scale", "skew", "bias")]
        share = [one["coverage"] for one in ways if one["coverage"] is not None]
        rows.append((*row, f"{100 * min(share):.1f} to {percent(max(share))}" if share else "–"))
    head = (
        "poses",
        *(f"{kind}, {way}" for kind in ("gain", "skew") for way in ("gravity", "data sheet", "calibrated")),
        "coverage",
    )
    refused = sum(case["refused"] for case in one["false"].values())
    total = sum(case["sessions"] for name, case in one["false"].items() if name != "saturated at its range")
    return "\n\n".join(
        (
            f"{one['sessions']} simulated parts in random poses. Median u by gravity alone, with turns "
            "and the data sheet "
            "of the gyros, and with turns and calibrated gyros; coverage with turns.",
            table(head, rows),
            "![Gain by turns](links-ratio.svg)",
            f"Gyros with wrong signs, axes, gains or range were not used in {refused} of {total} "
            "sessions; in the "
            "others single turns were left out.",
        )
    )


def slips(found: Document) -> str:
    """Wrong positions that were found."""
    kinds = ("with_gyros", "without_gyros")
    rows = []
    for key, name in (
        ("slipped", "slip of 0.5° to 20°"),
        ("swapped", "two positions swapped"),
        ("mistyped", "one mistyped"),
    ):
        faults = [found[kind]["by_fault"][key] for kind in kinds]
        cells = [f"{one['right']} of {one['sessions']} ({one['oracle']})" for one in faults]
        rows.append((name, *cells))
    head = ("fault", "right (oracle)", "without gyros")
    good = found["with_gyros"]["good"], found["without_gyros"]["good"]
    accused = found["with_gyros"]["accused"] + found["without_gyros"]["accused"]
    return "\n\n".join(
        (
            "Sessions with the right name, position and angle, and no other position. The *oracle* knows "
            "how the sessions were drawn.",
            table(head, rows),
            f"Of {good[0] + good[1]} sessions without a fault, {accused} had a position called wrong. "
            f"Slips above {found['slips_from_deg'] or math.nan:.2f}° are found in 99 %.",
            "![Slips by size and fixture](slips-sizes.svg)",
        )
    )


def smoother(found: Document) -> str:
    """Error of the angle in motion."""
    names = {"gravity": "gravity alone", "0": "lag 0"}
    rows = []
    for way, one in found["plain"].items():
        if not isinstance(one, dict):
            continue
        known = found["calibrated"][way]
        shares = [
            percent(x["motion"]["coverage"]) if "coverage" in x["motion"] else "–" for x in (one, known)
        ]
        errors = [f"{x['motion']['rms_deg']:.3f}°" for x in (one, known)]
        rows.append((names.get(way, f"lag {way} s"), *errors, *shares, f"{known['rest']['rms_deg']:.4f}°"))
    head = ("", "rms in motion", "calibrated gyros", "coverage", "calibrated gyros", "rms at rest")
    return "\n\n".join(
        (
            f"{found['plain']['hands']} simulated hands turn a part by 90 to 400° at 15 to 60 °/s, with "
            "tremor and vibration.",
            table(head, rows),
            "![Error of the angle by lag](smoother-lag.svg)",
        )
    )


def allan(found: Document) -> str:
    """Noise at rest: coverage, false claims, errors of slopes."""
    names = {"quantization": "quantization", "white": "N", "flicker": "F", "walk": "K"}
    rows, false, covered = [], [], []
    for case, one in found["cases"].items():
        for kind, figures in one["kinds"].items():
            if "claimed" not in figures:
                continue
            if figures["truth"] is None:
                false.append(figures["claimed"])
                continue
            covered.append(figures["coverage"])
            if kind != "quantization" and case == "all three":
                slopes = "–" if figures["peer_rms"] is None else percent(figures["peer_rms"], 0)
                error = "–" if figures["rms"] is None else percent(figures["rms"])
                shares = percent(figures["claimed"], 0), percent(figures["coverage"])
                rows.append((names[kind], *shares, error, slopes))
    head = ("noise", "found", "coverage", "rms error", "rms error by slopes")
    return "\n\n".join(
        (
            "360 axes with white noise N, bias instability F and random walk K; *by slopes* reads the "
            "Allan deviation where its slope is −½, 0 and +½.",
            table(head, rows),
            f"A noise that a record does not have is reported in {percent(min(false))} to "
            f"{percent(max(false))}; over all cases the coverage is {percent(min(covered))} to "
            f"{percent(max(covered))}.",
            "![Coverage by case and noise](allan-coverage.svg)",
        )
    )


def population(found: Document) -> str:
    """Effects that many sessions share."""
    kinds = found["kinds"]
    shared, others = kinds["effect"], [kinds[kind] for kind in kinds if kind != "effect"]
    total = sum(one["populations"] for one in others)
    false = sum(one["false"] for one in others)
    foreign = kinds["foreign"]
    return "\n\n".join(
        (
            f"Populations of {found['units']} sessions; the effect has half the detection limit of each "
            "session.",
            f"Of {shared['populations']} populations with one effect in 30 % of the sessions, "
            f"{shared['named']} name it alone and {shared['in_set']} in a set; {shared['false']} have a "
            f"wrong name. Of {total} populations without an effect of the catalogue (no effect, random "
            f"walks, an effect outside the catalogue, one gross session) {false} got a name; the effect "
            f"outside the catalogue is unnamed in {foreign['unnamed']} of "
            f"{foreign['populations']}.",
            "![How often each effect was named](population-named.svg)",
        )
    )


def fleet(found: Document) -> str:
    """Speed of a fleet by processes."""
    fits, traces, summary = found["fits"], found["traces"], found["summary"]
    return (
        f"{fits['workers']} processes fit {fits['ratio']:.2f} times and trace {traces['ratio']:.2f} "
        "times as many sessions "
        f"per second as one process, with equal summaries. The summary of {summary['rows']} rows takes "
        f"{summary['processor_s']:.0f} s of one core."
    )


def bench(found: Document) -> str:
    """Speed against other programs."""
    ratios: dict[str, list[str]] = {}
    for one in found["rows"]:
        if one["baseline"] and one["ratio"] is not None:
            ratios.setdefault(one["benchmark"], []).append(f"{one['ratio']:.2g} {one['baseline']}")
    rows = [(benchmark, "; ".join(cells)) for benchmark, cells in ratios.items()]
    return "\n\n".join(
        (
            "Time of the baseline over ours; above 1 we are faster. `trace` also weighs unnamed causes, "
            "leaves dwells out and looks into the dwells; its peers do not.",
            table(("benchmark", "ratio and baseline"), rows),
        )
    )


TITLES: dict[str, tuple[str, Callable[[Document], str]]] = {
    "trace": ("Trace", trace),
    "angle": ("The corrected angle", angle),
    "paper": ("The seed paper", paper),
    "plan": ("Plans", plan),
    "free_turn": ("Free turn", free_turn),
    "gyros": ("Gyros from turns", gyros),
    "links": ("Turns between poses", links),
    "slips": ("Wrong positions", slips),
    "smoother": ("The angle during a turn", smoother),
    "allan": ("Noise at rest", allan),
    "population": ("Weak effects in many sessions", population),
    "fleet": ("Fleet", fleet),
    "bench": ("Speed", bench),
}
"""Title and text of each section, in the order of the page."""


def render(folder: Path) -> str:
    """The page of all sections with a JSON file in the folder."""
    parts = [HEAD]
    for name, (title, text) in TITLES.items():
        path = folder / f"{name}.json"
        if path.exists():
            document = json.loads(path.read_text("utf-8"))
            parts.append(f"## {title}\n\n{text(document)}\n\nMade by `{document['command']}`.\n")
    return "\n".join(parts)


def main() -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if out of date")
    page = FOLDER / "index.md"
    if parser.parse_args().check:
        if page.read_text("utf-8") != render(FOLDER):
            print(f"{page} is out of date: run python scripts/results/page.py", file=sys.stderr)
            return 1
        return 0
    page.write_text(render(FOLDER), encoding="utf-8")
    print(f"wrote {page}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
