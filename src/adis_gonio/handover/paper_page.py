"""The page of the reproduced seed paper: table 1, figure 3, the map, and the effect of a bias."""

from __future__ import annotations

from adis_gonio.base.numbers import NO_BREAK, counted, format_fixed, format_number
from adis_gonio.handover.paper_map import BIASES_MG, FIXTURES_DEG, NOISES_MG, RMSD, TABLE, Point
from adis_gonio.handover.paper_study import (
    COLUMNS,
    DWELL_S,
    METHODS,
    TRACED,
    Cell,
    MethodSpread,
    Study,
    printed_verdicts,
)
from adis_gonio.page.document import Figure, KeyFigure, Section, Table, render
from adis_gonio.page.svg import Series, plot

NAMES = {
    "paper": "paper's method",
    "two-position": "two-position",
    "four-position": "four-position",
    "mmpm": "MMPM",
    "ml": "ml",
    TRACED: "traced model",
}
POSITIONS = {"paper": 2, "two-position": 2, "four-position": 4, "mmpm": 9, "ml": 9, TRACED: 9}
_GRAPHS = {"scale_error": ("SF", "1"), "offset": ("Δφ", "g"), "non_orthogonality": ("N", "°")}
SHOWN_NOISE_MG = 0.16
"""Noise of a reading in the printed map: a dwell of 1 s of the ADIS16354."""
_SHOWN_BIASES_MG = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0)


def build_page(done: Study) -> str:
    """Render the study as one HTML page that loads nothing."""
    return render(
        "The seed paper reproduced",
        "two positions against nine",
        shape=f"{counted(done.sessions, 'simulated part')} of each kind, adis16354, seed {done.seed}",
        simulated=True,
        sections=sections(done),
        closing=f"This page is made by {done.command} -o PAGE.html and can be made again by it.",
    )


def sections(done: Study) -> tuple[Section, ...]:
    """Sections of the HTML page of the study."""
    return (
        _summary(done),
        _table(done),
        _figure_3(done),
        _others(done),
        _map(done),
        _bias(done),
        _again(done),
    )


def verdicts(done: Study) -> tuple[str, ...]:
    """Sentences that state the results of the study."""
    printed = printed_verdicts().values()
    signed = sum(verdict["nearer"] == "paper" for verdict in printed)
    unsigned = sum(verdict["nearer_without_sign"] == "paper" for verdict in printed)
    free = done.map.crossing[(0.0, SHOWN_NOISE_MG)]
    usual = done.map.crossing[(10.0, SHOWN_NOISE_MG)]
    least = done.map.least_ratio_phi
    return (
        "Two positions beat nine in the gains, on a coarse stage"
        + (", and never in the angle between the axes." if least > 1 else "."),
        f"For ΔK the paper's method overtakes MMPM from a fixture error of {_deg(free)} without bias, and"
        f" of {_deg(usual)} with biases of 10 mg. For Δφ its error is everywhere on the map at least"
        f" {format_number(least, 2)} times the error of MMPM.",
        f"The printed table has the paper's method nearer to its own measured column in {signed} of"
        f" {len(TABLE)} rows, the rows of N, in which MMPM's values have the other sign. By sizes alone it"
        f" is nearer in {unsigned or 'none'}.",
        f"With biases of 10 mg the paper's Δφ is off by {format_number(done.bias.error_deg['paper'], 2)}°"
        f" (rms), {format_number(done.bias.multiple, 2)} times as far as ours, by ml (95{NO_BREAK}%"
        f" interval {format_number(done.bias.low, 2)} to {format_number(done.bias.high, 2)}).",
    )


def _deg(value: float | None) -> str:
    return "more than 10°" if value is None else f"{format_number(value, 2)}°"


def _summary(done: Study) -> Section:
    return Section(
        "Results",
        words=verdicts(done),
        key=(
            KeyFigure(
                "Crossing in ΔK, no bias",
                _deg(done.map.crossing[(0.0, SHOWN_NOISE_MG)]),
                "fixture error, standard deviation",
            ),
            KeyFigure("Crossing in Δφ", "none", "on the whole map"),
            KeyFigure(
                "Error of Δφ at 10 mg of bias",
                f"{format_number(done.bias.multiple, 2)} times",
                "paper's method over ml",
            ),
        ),
        notes=(f"Command: {done.command} -o PAGE.html",),
    )


def _cell(spread: MethodSpread) -> str:
    if spread.mean is None:
        return "not determined"
    return f"{format_fixed(spread.mean, 4)}{NO_BREAK}({format_fixed(spread.spread or 0.0, 4)})"


def _table(done: Study) -> Section:
    head = (
        "row",
        "measured",
        "paper's method, printed",
        "ours",
        "u",
        "MMPM, printed",
        "ours",
        "u",
        "specification",
    )
    rows = [_row(cell) for cell in done.table.cells]
    return Section(
        "Table 1",
        words=(
            "Measured is the truth of the simulated parts. Next to each printed value is the result of our"
            " sessions: mean (standard deviation) over the sessions, and u, the standard uncertainty"
            " that the method states for one session. SF is a relative error, Δφ an offset in g, N an angle"
            " in degrees.",
            "Two positions do not determine an offset, the paper's Δφ, so that the printed offset cannot"
            " follow from its equations. The u of its N is large because it includes a bias of 10 mg, which"
            " a part may have but these sessions do not.",
        ),
        tables=(Table(head, rows, numeric=tuple(range(1, len(head)))),),
        notes=(
            f"Specifications are averages; RMSDs are printed for SF, {RMSD['SF']}, and Δφ, {RMSD['Δφ']}.",
            f"Command: {done.command} --json (table_1)",
        ),
    )


def _row(cell: Cell) -> list[str]:
    row = cell.row
    texts = [row.label, format_fixed(row.measured, 4)]
    for method in COLUMNS:
        spread = cell.ours[method]
        texts += [
            format_fixed(getattr(row, method), 4),
            _cell(spread),
            "–" if spread.u is None else format_fixed(spread.u, 4),
        ]
    return [*texts, format_fixed(row.specification, 4)]


def _figure_3(done: Study) -> Section:
    return Section(
        "Figure 3: differences to the measured value",
        words=(
            "Printed values less the measured column, and ours less the truth: mean over the sessions, bars"
            " the standard deviation. Two positions do not determine the offset; it is taken as zero, and"
            " its whole size is drawn as the paper's difference.",
        ),
        figures=[Figure(svg, caption) for svg, caption in figures_3(done).values()],
        notes=(f"Command: {done.command} --json (table_1: sessions)",),
    )


def figures_3(done: Study) -> dict[str, tuple[str, str]]:
    """The three graphs of the paper's figure 3 as SVG with captions, by parameter."""
    made = {}
    for key, (printed, unit) in _GRAPHS.items():
        cells = [cell for cell in done.table.cells if cell.row.key == key]
        label = f"difference of {printed}" + (f" / {unit}" if unit != "1" else "")
        at = [
            (2.5 * k + place, cell.row.measured, getattr(cell.row, method), cell.ours[method])
            for k, cell in enumerate(cells)
            for place, method in enumerate(COLUMNS)
        ]
        series = [
            Series(
                [x - 0.12 for x, *_ in at],
                [value - measured for _, measured, value, _ in at],
                "printed",
                role="before",
            ),
            Series(
                [x + 0.12 for x, *_ in at],
                [(ours.mean or 0.0) - measured for _, measured, _, ours in at],
                "our sessions",
                error=[ours.spread or 0.0 for *_, ours in at],
                role="after",
            ),
        ]
        ticks = {0.0: "X, paper", 1.0: "X, MMPM", 2.5: "Y, paper", 3.5: "Y, MMPM"}
        svg = plot(
            series,
            "",
            label,
            title=f"Differences of {printed}",
            description=f"Printed and simulated differences of {printed} for X and Y by both methods.",
            x_ticks=ticks,
            x_range=(-0.6, 4.1),
            zero=True,
        )
        made[key] = (svg, f"{printed}: by the paper's method and by MMPM.")
    return made


def _others(done: Study) -> Section:
    head = ["row", *(NAMES[method] for method in METHODS)]
    rows = []
    for cell in done.table.cells:
        rows.append([cell.row.label, *(_error(cell.ours[method]) for method in METHODS)])
    rows.append(["ΔK, column X", *(_error(done.table.gain[method]) for method in METHODS)])
    rows.append(["positions", *(str(POSITIONS[method]) for method in METHODS)])
    traced = max(cell.ours[TRACED].sessions for cell in done.table.cells)
    return Section(
        "The other methods on the same sessions",
        words=(
            "Error about the truth, rms over the sessions. Each part is measured at four positions,"
            " of which the paper's method and its closed form use the first two, and at MMPM's nine, which"
            f" ml and the traced model also use. The traced model is of {counted(traced, 'part')} of each"
            " column: it has to find the bias before it corrects it.",
        ),
        tables=(Table(head, rows, numeric=tuple(range(1, len(head)))),),
        notes=(f"Command: {done.command} --json (table_1: sessions, error)",),
    )


def _error(spread: MethodSpread) -> str:
    return "–" if spread.error is None else format_number(spread.error, 2)


def _map(done: Study) -> Section:
    return Section(
        "Where the paper's method overtakes MMPM",
        words=(
            f"Each point of the map is {done.map.draws} sessions of readings, not of the chip: the planar"
            " model with an error of every declared angle, a bias of each axis and white noise, each normal"
            " with the stated standard deviation, and a start angle within ±5°. Each cell is the rms error"
            " of the paper's method over the error of MMPM: below 1 the paper's method is better.",
            "MMPM uses the declared angles: their errors enter its gains by √(2/9), but the gains of two"
            " positions at a small start angle only by √2 tan α. In Δφ it is the reverse: √(2/9) for MMPM,"
            " √2 for two positions. The bias, which two positions cannot determine, moves the crossing up"
            " in proportion. From a start angle of 18° on, at which √2 tan α reaches √(2/9), there is no"
            " crossing in ΔK either.",
        ),
        figures=[Figure(svg, caption) for svg, caption in map_figures(done).values()],
        tables=(_ratios(done, "delta_k", "ΔK"), _ratios(done, "non_orthogonality", "Δφ")),
        notes=(f"Command: {done.command} --json (map)",),
    )


def map_figures(done: Study) -> dict[str, tuple[str, str]]:
    """Figures of the map as SVG with captions.

    They show the fixture error at which both methods are equally good for ΔK, and the ratio of their errors
    at the usual noise.
    """
    biases = [bias for bias in BIASES_MG if bias > 0]
    lines = [
        Series(
            biases,
            [done.map.crossing[(bias, noise)] or float("nan") for bias in biases],
            f"{noise:g} mg of noise",
            style="line",
        )
        for noise in NOISES_MG
    ]
    crossing = plot(
        lines,
        "bias of an axis / mg",
        "fixture error / °",
        title="Crossing of the paper's method and MMPM in ΔK",
        description="Above a line the paper's method has the smaller error of ΔK, below it MMPM.",
        x_log=True,
        y_log=True,
    )
    fixtures = [fixture for fixture in FIXTURES_DEG if fixture > 0]
    curves = []
    for key, label in (("delta_k", "ΔK"), ("non_orthogonality", "Δφ")):
        for bias in (0.0, 3.0):
            at = [done.map.ratio(Point(f, bias, SHOWN_NOISE_MG), key) for f in fixtures]
            curves.append(Series(fixtures, at, f"{label}, {bias:g} mg of bias", style="line"))
    level = Series([fixtures[0], fixtures[-1]], [1.0, 1.0], role="model", style="line")
    ratio = plot(
        [*curves, level],
        "fixture error / °",
        "error over MMPM's error",
        title="Error of the paper's method over the error of MMPM",
        description="Below one the paper's method is better: ΔK crosses, Δφ does not.",
        x_log=True,
        y_log=True,
    )
    return {
        "crossing": (crossing, "ΔK: above its line the paper's method is better, below it MMPM."),
        "ratio": (ratio, f"Error of the paper's method over MMPM's, {SHOWN_NOISE_MG:g} mg of noise."),
    }


def _ratios(done: Study, key: str, name: str) -> Table:
    rows = [
        [
            f"{fixture:g}°",
            *(
                format_number(done.map.ratio(Point(fixture, bias, SHOWN_NOISE_MG), key), 2)
                for bias in _SHOWN_BIASES_MG
            ),
        ]
        for fixture in FIXTURES_DEG
    ]
    return Table(
        ("fixture error", *(f"{bias:g}{NO_BREAK}mg" for bias in _SHOWN_BIASES_MG)),
        rows,
        f"{name}: error of the paper's method over MMPM's by fixture error and bias, {SHOWN_NOISE_MG:g} mg"
        " of noise a reading.",
        numeric=tuple(range(1, len(_SHOWN_BIASES_MG) + 1)),
    )


def _bias(done: Study) -> Section:
    bias = done.bias
    rows = [
        [
            NAMES[m],
            str(POSITIONS[m]),
            format_number(error, 2),
            format_number(error / bias.error_deg["ml"], 2),
        ]
        for m, error in bias.error_deg.items()
    ]
    return Section(
        "A bias of 10 mg",
        words=(
            f"{counted(bias.sessions, 'part')} with biases of a standard deviation of 10 mg per axis,"
            " as the simulated part has, on a stage with an error of 0.02°. The paper's error of Δφ is"
            f" {format_number(bias.multiple, 2)} times the error of ml (95 %: {format_number(bias.low, 2)}"
            f" to {format_number(bias.high, 2)}, by bootstrap over the sessions), by medians"
            f" {format_number(bias.median, 2)} times."
            + (f" It refused {bias.refused} more." if bias.refused else ""),
        ),
        tables=(
            Table(
                ("method", "positions", "error of Δφ / °, rms", "times the error of ml"),
                rows,
                numeric=(1, 2, 3),
            ),
        ),
        notes=(f"Command: {done.command} --json (bias)",),
    )


def _again(done: Study) -> Section:
    part = done.results["x"][0].part
    return Section(
        "Repeat the numbers",
        words=(
            f"The whole page: {done.command} -o PAGE.html. All numbers as one document: {done.command}"
            " --json; its parts state the command that records each session. Dwells last"
            f" {DWELL_S:g} s. The first part of column X at its nine positions, and MMPM of it:",
        ),
        points=(part.command("mmpm"), "adis-gonio fit one.session --method mmpm"),
    )
