"""Write docs/effects.md from the effects themselves; `--check` exits with 1 if the page is out of date."""

from __future__ import annotations

import argparse
import inspect
import sys
from pathlib import Path

from adis_gonio.model.effects import BUILT_IN, Effect, Enters, Parameter, effect

PAGE = Path(__file__).resolve().parent.parent / "docs" / "effects.md"

HEAD = """\
# Reference: the catalogue of effects

<!-- written by scripts/effects_page.py from src/adis_gonio/model/effects: change it there -->

An effect is a named physical term that may be added to the model of the seed paper (start angle α, one gain
per axis, Δφ; [theory](theory.md)). A fitted value outside the bounds is rejected. Typical sizes are
**estimates** for a bench with an ADIS16354.
[Theory](theory.md#from-the-residual-to-the-effect) lists the harmonics that they share.

Symbols: a_i is the ideal reading of axis i in mg, a_p the ideal reading of an axis across it, θ the
declared angle of the stage, ψ = α − θ the true angle of the part, t the time in s; for gyros ω_i is the
ideal reading of gyro i in °/s, Ω the true rate about the accelerometers' axes, f the reading of the
accelerometers in g. The parameters of an axis have its letter (`bias_x`), the parameters of a
pair have both (`kpp_xy`: axis x, acceleration along y).

Each entry has the formula, the parameters with typical size, unit (1 for a ratio) and bounds, and then what
helps to tell the effect from others like it. *needs* is a condition that the session must have recorded;
*choice* is a setting of the effect (axes count from 0: x, y, z); *enters* is stated if the effect does not
change the mean reading of an axis.

On a command line an effect is `name` (all parameters typical) or `name:parameter=value,…` (other
amplitudes are zero; time constants, frequencies and limits keep their typical values). Your own
effect: [CONTRIBUTING](../CONTRIBUTING.md#add-an-effect).
"""

ENTERS = {
    Enters.ATTITUDE: "the true angle of the part",
    Enters.READING: "the reading of an axis",
    Enters.SAMPLES: "the samples of a dwell",
}


def bounds(parameter: Parameter) -> str:
    """Bounds of a parameter, such as `±5` or `0…30`."""
    low, high = parameter.low, parameter.high
    return f"±{high:g}" if low == -high else f"{low:g}…{high:g}"


def paragraph(kind: type[Effect], name: str) -> str:
    """Text of a paragraph of an effect's docstring, which begins with its name."""
    paragraphs = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    (text,) = (one for one in paragraphs if one.startswith(f"{name}: "))
    return " ".join(text.removeprefix(f"{name}: ").split())


def section(kind: type[Effect]) -> list[str]:
    """Section of one effect."""
    choice = {"degree": 3} if "degree" in kind.choices() else {}
    made = effect(kind.name, ("x",), **choice)
    facts = [f"`{p.name}` {p.typical:g} {p.unit} ({bounds(p)})" for p in made.parameters]
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
        paragraph(kind, "Separated by"),
        "",
    ]


GROUPS = {
    "sensor_terms": "Sensor and its surroundings: response, temperature, supply, time, gravity",
    "stage_terms": "Stage, approach of a position, single dwells and samples",
    "gyro_terms": "Gyros ([how to calibrate them](gyros.md))",
}


def render() -> str:
    """The page."""
    lines = [HEAD]
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
