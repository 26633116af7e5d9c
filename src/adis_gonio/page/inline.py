"""Matplotlib's SVG as an element of a page.

What matplotlib writes is a file of its own: its ids clash with those of the next figure, its style sheet
would hold for the whole page, its black does not follow a dark page, and every marker repeats its style.
"""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping

_NAMESPACE = re.compile(r"\{[^}]*\}")


def inline_svg(drawing: str, colours: Mapping[str, str], *, title: str, description: str = "") -> str:
    """One `<svg>` element from a file of matplotlib's.

    Parameters
    ----------
    drawing : str
        Written with `svg.fonttype: none` and a fixed `svg.hashsalt`.
    colours : mapping of str to str
        What stands in the page for a colour of the file, such as `{"#000000": "currentColor"}`.
    title, description : str
        What a screen reader says.

    Returns
    -------
    str
        All text escaped; coordinates to a tenth; every id begins with a hash of the content.
    """
    root = ET.fromstring(drawing)
    box = root.get("viewBox", "")
    root.attrib.clear()
    for element in root.iter():
        element.tag = _NAMESPACE.sub("", element.tag)
        element.text = element.text if element.tag == "text" else None
        element.tail = None
        _attributes(element, colours)
        for child in list(element):
            if child.tag.endswith(("metadata", "style")):
                element.remove(child)
    for group in root.iter("g"):
        _say_style_once(group)
    name = "f" + hashlib.sha256(ET.tostring(root) + f"{title}\0{description}".encode()).hexdigest()[:10]
    _rename(root, name)
    root.attrib = {
        "xmlns": "http://www.w3.org/2000/svg",
        "class": "plot",
        "viewBox": box,
        "role": "img",
        "aria-labelledby": f"{name}t {name}d" if description else f"{name}t",
        "font-family": "inherit",
        "font-size": "12",
        "fill": "currentColor",
        "stroke-linejoin": "round",
    }
    for tag, text in (("desc", description), ("title", title)):
        if text:
            said = ET.Element(tag, {"id": f"{name}{tag[0]}"})
            said.text = text
            root.insert(0, said)
    return ET.tostring(root, encoding="unicode")


def _attributes(element: ET.Element, colours: Mapping[str, str]) -> None:
    """Attributes as a page needs them."""
    given = {_NAMESPACE.sub("", key): value for key, value in element.attrib.items()}
    if element.tag in ("g", "text"):
        given.pop("id", None)
    if given.get("transform", "").startswith("rotate(-0 "):
        del given["transform"]
    for key in {"d", "x", "y", "transform"} & given.keys():
        given[key] = re.sub(r"-?\d+\.\d+", _short, " ".join(given[key].split()))
    if "d" in given:
        letters_alone = re.sub(r" ?([A-Za-z]) ?", r"\1", given["d"])
        given["d"] = re.sub(r"M([^A-Z]+)L\1(?=M|$)", r"M\1h0", letters_alone)
    if "style" in given:
        rules = dict(rule.strip().split(": ", 1) for rule in given["style"].split(";") if rule.strip())
        if element.tag == "text":  # size and family are the page's
            rules = {key: value for key, value in rules.items() if not key.startswith("font")}
        given["style"] = ";".join(f"{key}:{colours.get(value, value)}" for key, value in rules.items())
    element.attrib = given


def _short(found: re.Match[str]) -> str:
    return f"{float(found[0]) + 0.0:.1f}".removesuffix(".0")


def _say_style_once(group: ET.Element) -> None:
    """The markers of a series look alike."""
    markers = group.findall("use")
    if len({marker.get("style") for marker in markers}) == 1:
        group.set("style", markers[0].get("style", ""))
        for marker in markers:
            marker.attrib.pop("style", None)


def _rename(root: ET.Element, name: str) -> None:
    """Ids in the order of the drawing, begun with the figure's own name."""
    named = [element for element in root.iter() if element.get("id")]
    new = {element.get("id", ""): f"{name}{k}" for k, element in enumerate(named)}
    for element in named:
        element.set("id", new[element.get("id", "")])
    for element in root.iter("use"):
        element.set("href", "#" + new[element.get("href", "")[1:]])
