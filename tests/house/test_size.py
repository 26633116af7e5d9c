"""The package can be carried on by one person only as long as it is small."""

import ast
import io
import tokenize
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2] / "src" / "adis_gonio"
MOST_LINES = 45_553
"""Lines of code of the package; a change may lower this number."""
MOST_FILES = 218
SILENT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}


def lines_of_code(source: str) -> int:
    """Lines that hold code: neither blank, nor a comment, nor a docstring."""
    docs: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for entry in body if isinstance(body, list) else []:
            value = entry.value if isinstance(entry, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                docs.update(range(value.lineno, (value.end_lineno or value.lineno) + 1))
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in SILENT and token.string:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code - docs)


def test_lines_of_code_are_neither_blank_nor_comments_nor_docstrings():
    source = '"""Doc.\n\nMore."""\n\n# why\nX = (\n    1\n)\n"""Of X."""\n\n\n'
    source += 'def f():\n    """Doc."""\n    return X\n'
    assert lines_of_code(source) == 5


def test_the_package_does_not_grow():
    counted = {path: lines_of_code(path.read_text(encoding="utf-8")) for path in SOURCE.rglob("*.py")}
    assert len(counted) <= MOST_FILES
    assert sum(counted.values()) <= MOST_LINES
