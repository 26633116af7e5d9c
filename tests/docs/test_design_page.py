"""The page of the design names every module."""

from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_module_is_named() -> None:
    page = (ROOT / "docs" / "design.md").read_text("utf-8")
    modules = (ROOT / "src" / "adis_gonio").rglob("[!_]*.py")
    missing = [
        str(module.relative_to(ROOT))
        for module in modules
        if f"`{module.name}`" not in page and f"`{module.stem}`" not in page and module.stem not in page
    ]
    assert not missing
