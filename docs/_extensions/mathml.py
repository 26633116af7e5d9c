"""Equations as MathML: browsers draw them themselves, and no script has to come from anywhere."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx


def _element(tex: str, block: bool) -> str:
    tree = latex2mathml.tex2mathml(tex, as_block=block)
    return tree if isinstance(tree, str) else tree.toxml()


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(_element(node.astext(), block=False))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math">{_element(node.astext(), block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer `mathml`."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
