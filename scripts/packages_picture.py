"""Draw the packages and their imports: docs/pictures/packages.svg.

    python scripts/packages_picture.py            # writes the picture
    python scripts/packages_picture.py --check    # exit 1 if the picture is out of date

One row is one package, in the order of the floors in pyproject.toml. A dot in a row marks a package that
the row's package imports. All dots are to the right of the diagonal if no import leads upwards.
"""

import argparse
import ast
import sys
import tomllib
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "pictures" / "packages.svg"
PURPOSE = {
    "faces": "command line, screen, IIO server, Python functions",
    "fleet": "many sessions: store, history, due dates, population",
    "handover": "exports, reports, digital twin",
    "bench": "guided session, bring-up, write-back, IIO source",
    "plan": "prediction of a plan, the best plan",
    "live": "the angle while the part moves",
    "tracing": "from the residual to the missing effect",
    "fitting": "readings, noise, fits, uncertainty",
    "calibrate": "from readings to the corrected angle",
    "record": "session archive, samples files, plans",
    "sim": "simulated chip, world and stage, test doubles",
    "model": "measurement model, effects, sessions as data",
    "device": "buses, registers, driver",
    "page": "parts of HTML pages, SVG figures",
    "base": "errors, numbers, files, JSON, budget of time",
}
ROW, LEFT, COLUMN, TOP = 26, 450, 26, 96


def floors() -> list[str]:
    """Packages from the top floor to the bottom, from the contract of import-linter."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    layers: list[str] = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    return layers


def imported_packages(package: str) -> set[str]:
    """Packages that a module of `package` names in an import, deferred and type-only imports included."""
    found = set()
    for path in (ROOT / "src" / "adis_gonio" / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            parts = [name.split(".") for name in names]
            found |= {part[1] for part in parts if part[0] == "adis_gonio" and len(part) > 1}
    return found - {package}


def render() -> str:
    """The picture as SVG."""
    packages = floors()
    width, height = LEFT + COLUMN * len(packages) + 16, TOP + ROW * len(packages) + 12
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif" font-size="13">',
        "<title>The packages and their imports</title>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for k, package in enumerate(packages):
        y, x = TOP + ROW * k, LEFT + COLUMN * k
        parts += [
            f'<rect x="8" y="{y}" width="{width - 16}" height="{ROW - 2}" fill="#eef3f8"/>',
            f'<text x="16" y="{y + 17}" font-weight="bold">{package}</text>',
            f'<text x="104" y="{y + 17}" fill="#333333">{escape(PURPOSE[package])}</text>',
            f'<rect x="{x}" y="{y}" width="{COLUMN - 2}" height="{ROW - 2}" fill="#9db4cc"/>',
            f'<text transform="translate({x + 16} {TOP - 8}) rotate(-60)">{package}</text>',
        ]
    for k, package in enumerate(packages):
        for other in sorted(imported_packages(package) & set(packages), key=packages.index):
            x, y = LEFT + COLUMN * packages.index(other) + 12, TOP + ROW * k + 12
            parts.append(f'<circle cx="{x}" cy="{y}" r="6" fill="#2060a0"/>')
    return "\n".join([*parts, "</svg>", ""])


def main() -> int:
    """Write or check the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if out of date")
    if parser.parse_args().check:
        if not PICTURE.exists() or PICTURE.read_text("utf-8") != render():
            print(f"{PICTURE} is out of date: run python scripts/packages_picture.py", file=sys.stderr)
            return 1
        return 0
    PICTURE.write_text(render(), encoding="utf-8")
    print(f"wrote {PICTURE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
