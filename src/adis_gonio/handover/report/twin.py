"""The section of the page that holds the digital twin against the measured data."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.handover.twin import TwinComparison, compare, simulate_like
from adis_gonio.model.records import Session
from adis_gonio.page.document import Figure, Section, Table
from adis_gonio.page.svg import Role, Series, plot
from adis_gonio.tracing.trace_result import TraceResult

_AXES = "xyz"


def twin_section(session: Session, traced: TraceResult, *, seed: int = 0) -> Section | None:
    """Simulate a session by its own model and compare; None where the trace has no model to simulate.

    Raises
    ------
    DataError
        As `simulate_like`: dwells of a single averaged sample have no noise to copy.
    """
    if not traced.fits:
        return None
    twin = simulate_like(session, traced.fits[-1], seed=seed)
    found = compare(session, twin, traced.fits[-1])
    verdict = (
        "They agree: the model and the noise account for what was measured."
        if found.agrees
        else "They differ: the session holds something that neither the model nor the measured noise has."
    )
    return Section(
        title="The digital twin against the measured data",
        words=(
            "The model that was traced became the world of the simulated sensor, which was then measured in"
            " the same positions at the same times. " + verdict,
        ),
        folded=True,
        figures=tuple(_figures(found)),
        tables=(_table(found),),
    )


def _figures(found: TwinComparison) -> list[Figure]:
    pairs = (
        (
            found.tau_s,
            found.allan_measured_mg,
            found.allan_twin_mg,
            "averaging time / s",
            "Allan deviation / mg",
        ),
        (
            found.frequency_hz,
            found.density_measured,
            found.density_twin,
            "frequency / Hz",
            "density / mg/√Hz",
        ),
    )
    figures = []
    for x, ours, theirs, x_label, y_label in pairs:
        for k in range(ours.shape[1]):
            series = [
                Series(x, ours[:, k], "measured", role="before"),
                Series(x, theirs[:, k], "twin", role="after", style="line"),
            ]
            title = f"{y_label.split(' /')[0]} of {_AXES[k]}"
            svg = plot(series, x_label, y_label, title=title, x_log=True, y_log=True)
            figures.append(Figure(svg, f"{title}, within the dwells."))
    series = [
        _share_below(found.residual_measured, "measured", "before"),
        _share_below(found.residual_twin, "twin", "after"),
    ]
    title = "Distribution of the residuals"
    svg = plot(series, "residual / its standard uncertainty", "share below", title=title)
    return [*figures, Figure(svg, f"{title} of the readings.")]


def _share_below(values: Floats, label: str, role: Role) -> Series:
    share = (np.arange(len(values)) + 0.5) / len(values)
    return Series(np.sort(values), share, label, role=role, style="steps")


def _table(found: TwinComparison) -> Table:
    rows = (
        ("residuals, standard deviation: measured", f"{np.std(found.residual_measured):.2f}"),
        ("residuals, standard deviation: twin", f"{np.std(found.residual_twin):.2f}"),
        ("same distribution (Kolmogorov-Smirnov), p", f"{found.p_residual:.3f}"),
        ("same variance (F), p", f"{found.p_variance:.3f}"),
        ("Allan deviation, measured over twin", f"{found.allan_ratio:.2f}"),
        ("spectral density, measured over twin", f"{found.density_ratio:.2f}"),
    )
    return Table(("figure", "value"), rows, numeric=(1,))
