"""Write docs/effects.md from the effects themselves; `--check` exits with 1 if the page is out of date."""

from __future__ import annotations

import argparse
import inspect
import sys
from pathlib import Path

import numpy as np

from adis_gonio.model.effects import BUILT_IN, Conditions, Effect, Enters, effect

PAGE = Path(__file__).resolve().parent.parent / "docs" / "effects.md"

HEAD = """\
# Reference: the catalogue of effects

<!-- written by scripts/effects_page.py from src/adis_gonio/model/effects: change it there -->

An effect is a named physical term that the seed paper's model (start angle α, one gain per axis,
Δφ) lacks. The simulator, the fit and the trace use the same objects. A fitted value outside the
bounds is rejected. Typical sizes are **estimates** for a bench with an ADIS16354, not the maker's
figures.

Symbols: a_i is the ideal reading of axis i in mg, a_p the ideal reading of an axis across it, θ the
declared angle of the stage, ψ = α − θ the true angle of the part, t the time; for gyros ω_i is the ideal
reading of gyro i in °/s, Ω the true rate about the accelerometers' axes, f the reading of the
accelerometers in g. The parameters of an axis have its letter (`bias_x`), the parameters of a
pair have both (`kpp_xy`: axis x, acceleration along y).

On a command line an effect is `name` (all parameters typical) or `name:parameter=value,…` (other
amplitudes are zero; time constants, frequencies and limits keep their typical values). Your own
effect: [CONTRIBUTING](../CONTRIBUTING.md#add-an-effect).
"""

ENTERS = {
    Enters.ATTITUDE: "the true angle of the part",
    Enters.READING: "the reading of an axis",
    Enters.SAMPLES: "the samples of a dwell",
}

HARMONICS_HEAD = """\
## Harmonics of a turn

One unit of a parameter adds these harmonics of t (the angle of X from gravity) to X over one turn
at 1 g, in mg, with the stage's zero at t = 0. Computed from the effects; terms below 0.0005 mg are
empty. Harmonic n needs at least 2n + 1 positions.

"""

TURN = ("quadratic", "cross_axis", "cross_quadratic", "cubic", "asymmetry", "misalignment", "scale", "bias")
STAGE_TURN = ("stage_eccentricity", "stage_ellipticity", "stage_periodic")


def harmonics(made: Effect, values: np.ndarray, positions: int = 360) -> dict[str, float]:
    """Harmonics of what an effect adds to X over one turn at 1 g, in mg."""
    t = 2 * np.pi * np.arange(positions) / positions
    ideal = 1000 * np.column_stack([np.cos(t), np.sin(t)])
    conditions = Conditions(time_s=np.zeros(positions), angle_rad=-t)
    if made.enters is Enters.ATTITUDE:
        added = -ideal[:, 1] * made.attitude_rad(values, conditions)
    else:
        added = made.reading(values, ideal, conditions)[:, 0]
    lines = np.fft.rfft(added) / positions
    table = {"mean": float(lines[0].real)}
    for n in range(1, 5):
        table[f"cos {n}t"] = float(2 * lines[n].real)
        table[f"sin {n}t"] = float(-2 * lines[n].imag)
    return table


def harmonics_table() -> list[str]:
    """Rows of the table of harmonics."""
    columns = ["mean", *(f"{wave} {n}t" for n in range(1, 5) for wave in ("cos", "sin"))]
    rows = [
        "| parameter | " + " | ".join(columns) + " |",
        "|---|" + "---:|" * len(columns),
    ]
    for name in (*TURN, *STAGE_TURN):
        made = effect(name)
        for k, parameter in enumerate(made.parameters):
            if name in TURN and k:
                break  # Y's terms are X's with the axes exchanged
            found = harmonics(made, np.eye(len(made.parameters))[k])
            cells = [f"{found[c]:.3f}" if abs(found[c]) > 5e-4 else "" for c in columns]
            rows.append(f"| `{parameter.name}` ({name}, {parameter.unit}) | " + " | ".join(cells) + " |")
    return rows


def paragraph(kind: type[Effect], name: str) -> str:
    """Text of a paragraph of an effect's docstring, which begins with its name."""
    paragraphs = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    (text,) = (one for one in paragraphs if one.startswith(f"{name}: "))
    return " ".join(text.removeprefix(f"{name}: ").split())


def section(kind: type[Effect]) -> list[str]:
    """Section of one effect."""
    choice = {"degree": 3} if "degree" in kind.choices() else {}
    made = effect(kind.name, ("x",), **choice)
    facts = [f"`{p.name}` {p.unit}, {p.low:g} … {p.high:g}, typical {p.typical:g}" for p in made.parameters]
    facts += [f"choice `{name}` (default {getattr(kind, name)})" for name in kind.choices()]
    facts += [f"enters {ENTERS[kind.enters]}"] if kind.enters is not Enters.READING else []
    facts += [f"needs `{need}`" for need in kind.needs]
    facts += ["found within the dwells"] if kind.within_dwell else []
    return [
        f"### `{kind.name}`",
        "",
        kind.cause,
        "",
        f"    {paragraph(kind, 'Formula')}",
        "",
        "; ".join(facts) + ".",
        "",
        f"*Separated by:* {paragraph(kind, 'Separated by')}",
        "",
    ]


GROUPS = {
    "sensor_terms": "Sensor and its surroundings: response, temperature, supply, time, gravity",
    "stage_terms": "Stage, approach of a position, single dwells and samples",
    "gyro_terms": "Gyros ([how to calibrate them](gyros.md))",
}


def render() -> str:
    """The page."""
    lines = [HEAD, HARMONICS_HEAD + "\n".join(harmonics_table()), ""]
    for module, title in GROUPS.items():
        lines += [f"## {title}", ""]
        for kind in BUILT_IN.values():
            if kind.__module__.endswith(f".{module}"):
                lines += section(kind)
    return "\n".join(lines)


def main() -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if the page is old")
    if parser.parse_args().check:
        if not PAGE.exists() or PAGE.read_text(encoding="utf-8") != render():
            print(f"{PAGE} is not up to date: run python scripts/effects_page.py", file=sys.stderr)
            return 1
        return 0
    PAGE.write_text(render(), encoding="utf-8")
    print(f"wrote {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
