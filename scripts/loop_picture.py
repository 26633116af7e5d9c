"""Draw the closed loop on the thermal-chamber recording: the residual before and after the trace.

    python scripts/loop_picture.py docs/pictures/thermal_loop.svg

Each panel shows one axis: the residual of the base model and of the traced model against the temperature.
The title gives the error on left-out blocks of time before and after.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt

from adis_gonio import load_session, trace
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.tracing.trace_figures import views_of

RECORDING = Path(__file__).parents[1] / "examples" / "measured" / "thermal_cycle.csv.gz"


def draw(path: Path) -> None:
    """Trace the recording and write the picture to `path`."""
    session = load_session(RECORDING)
    result = trace(session)
    error = result.as_dict()["error"]
    before, after = (error[key]["heldout_by_axis_mg"] for key in ("before", "after"))
    views = views_of(readings_of(session), result)
    panels = [panel for panel in views.left if panel.covariate == "temperature"]
    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "loop", "font.size": 9})
    figure, places = plt.subplots(1, 3, figsize=(9, 2.9), layout="constrained")
    for place, panel, axis in zip(places, panels, "xyz", strict=True):
        for residual, colour, label in (
            (panel.before, "#d08050", "base model"),
            (panel.after, "#2060a0", "traced model"),
        ):
            place.plot(panel.x, residual, ".", ms=3, color=colour, label=label)
        place.set_title(f"{axis}: held-out error {before[axis]:.3g} → {after[axis]:.3g} mg", fontsize=10)
        place.set_xlabel("temperature / °C")
    places[0].set_ylabel("residual / mg")
    places[2].legend(markerscale=2, frameon=False, loc="upper right")
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None, dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    draw(parser.parse_args().picture)
