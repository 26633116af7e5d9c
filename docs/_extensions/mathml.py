"""Equations as MathML: browsers draw them themselves, and no script has to come from anywhere."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

_LOGGER = logging.getLogger(__name__)


def _element(node: nodes.math | nodes.math_block, block: bool) -> str:
    try:
        element = latex2mathml.tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        _LOGGER.warning("equation '%s': %s", node.astext(), error, location=node)
        return ""
    # As an identifier the name of a function would stand close to its neighbours.
    return re.sub(
        r"<mi>(sin|cos|tan|ln|atan2)</mi>", r'<mo lspace="0.17em" rspace="0.1em">\1</mo>', element
    )


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(_element(node, block=False))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math" style="margin: 1em 0">{_element(node, block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer `mathml`."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
