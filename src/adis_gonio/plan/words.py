"""A prediction as lines of plain text, at most 80 columns wide."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence

from adis_gonio.base.numbers import NAMES, count_decimals, counted, format_fixed, format_unit
from adis_gonio.base.tables import align_columns, fold_text
from adis_gonio.base.uncertainty import Value
from adis_gonio.plan.best import BestPlan
from adis_gonio.plan.criteria import Best
from adis_gonio.plan.prediction import Prediction
from adis_gonio.plan.sight import Sight
from adis_gonio.record.plans import Plan

WIDTH = 80
_GAINED = {
    "delta_k": "u(ΔK)",
    "delta_phi": "u(Δφ)",
    "angle_worst_by_parameters": "angle, fitted",
    "angle_worst": "angle, all",
}
_ASKED: dict[Best, str] = {
    "angle": "best for the angle (G-optimal)",
    "parameters": "best for the parameters (D-optimal)",
    "tell-apart": "best to tell apart",
}
_FIGURE: dict[Best, str] = {
    "angle": "u of the angle by the fitted parameters, worst place: {:.2g}°",
    "parameters": "generalised u of the parameters: {:.2g}",
    "tell-apart": "an effect of typical size stands out by {:.2g} standard uncertainties at least",
}


def lines_of(prediction: Prediction, found: BestPlan | None = None) -> Iterator[str]:
    """All that a terminal shows; the headline first."""
    yield headline(prediction)
    if found is not None:
        yield from _asked(found)
    yield ""
    yield from _reach(prediction)
    if found is not None:
        yield from _gains(found)
    yield ""
    yield from _sight(prediction.sight)
    yield ""
    yield from _positions(prediction.plan)
    for note in prediction.reach.notes:
        yield from fold_text(note, WIDTH)


def headline(prediction: Prediction) -> str:
    """Positions, minutes and the error of the angle in one line."""
    minutes = f"{max(prediction.seconds / 60, 1):.0f} min"
    count = counted(len(prediction.plan), "position")
    u, expanded = prediction.reach.angle.u, prediction.reach.angle_worst.U
    if u is None or expanded is None:
        return f"{count}, {minutes}: they do not determine an angle at this fixture"
    digits = count_decimals(min(u, expanded))
    angle = f"± {format_fixed(u, digits)}° rms, U {format_fixed(expanded, digits)}° at the worst place"
    return f"{count}, {minutes}: angle {angle}"


def _asked(found: BestPlan) -> Iterator[str]:
    beware = f" {', '.join(found.beware)}" if found.best == "tell-apart" else ""
    beside = f", {', '.join(found.beware)} fitted beside" if found.beware and not beware else ""
    yield from fold_text(
        f"{_ASKED[found.best]}{beware}{beside}; {_FIGURE[found.best].format(found.figure)}", 80
    )


def _reach(prediction: Prediction) -> Iterator[str]:
    reach = prediction.reach
    rows = [["quantity", "unit", "u", "U (95 %)"]]
    rows.append(_row("angle, rms over the turn", reach.angle))
    rows.append(_row("angle, worst place", reach.angle_worst))
    rows += [_row(NAMES.get(name, name), value) for name, value in reach.parameters.items()]
    yield f"Predicted, by method {reach.method}"
    yield from align_columns(rows)
    if reach.undetermined:
        yield from fold_text(f"not determined: {', '.join(reach.undetermined)}", WIDTH, 2)


def _row(name: str, value: Value) -> list[str]:
    digits = count_decimals(value.u or 0.0)
    return [name, format_unit(value.unit), format_fixed(value.u, digits), format_fixed(value.U, digits)]


def _gains(found: BestPlan) -> Iterator[str]:
    yield ""
    yield "Gain: the other plan's uncertainty through this one's"
    rows = [["over", "criterion", *_GAINED.values()]]
    for gain in found.gains:
        cells = [_times(gain.u.get(name)) for name in _GAINED]
        rows.append([gain.over, _times(gain.criterion), *cells])
    yield from align_columns(rows, texts=1)


def _times(ratio: float | None) -> str:
    if ratio is None or math.isnan(ratio):
        return "–"
    return f"× {ratio:.2f}" if ratio < 100 else "× > 100"


def _sight(sight: Sight) -> Iterator[str]:
    seen = {name: one for name, one in sight.detectable.items() if one.amplitude is not None}
    if seen:
        yield "Sees from this size on (found in 90 of 100 sessions)"
        cells = [f"{name} {one.amplitude:.2g} {one.unit}" for name, one in seen.items()]
        yield from _columns(cells)
    blind = defaultdict(list)
    for name, one in sight.detectable.items():
        if one.amplitude is None:
            blind[one.reason].append(name)
    yield "Cannot see"
    for reason, names in blind.items():
        yield from fold_text(f"{', '.join(names)}: {reason}", WIDTH, 2)
    yield "Cannot tell apart"
    others = defaultdict(list)
    for pair in sight.alike:
        others[pair.one].append(pair.other)
    for name, several in others.items():
        yield from fold_text(f"{name} from {', '.join(several)}", WIDTH, 2)
    if not others:
        yield "  nothing of what it sees"


def _positions(made: Plan) -> Iterator[str]:
    yield "Positions, in this order"
    yield from _columns([f"{k:>3}  {position}" for k, position in enumerate(made.positions, 1)], least=24)


def _columns(cells: Sequence[str], least: int = 38) -> Iterator[str]:
    """Cells in as many columns as the width has, column by column."""
    width = max(least, *(len(cell) for cell in cells)) if cells else least
    across = max(1, (WIDTH - 2) // width)
    down = -(-len(cells) // across)
    for row in range(down):
        yield "  " + "".join(cell.ljust(width) for cell in cells[row::down]).rstrip()
