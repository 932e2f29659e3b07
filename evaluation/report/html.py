"""HTML and SVG as trees: text and attributes are escaped by the serialiser, so no name can break the page."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree

Element = ElementTree.Element
Child = Element | str | None | Iterable["Child"]


def h(tag: str, attributes: dict[str, object] | None = None, *children: Child) -> Element:
    """An element. Attributes that are None or False are left out, True stands for an empty one."""
    element = Element(tag)
    for name, value in (attributes or {}).items():
        if value is not None and value is not False:
            element.set(name, "" if value is True else number(value) if isinstance(value, float) else str(value))
    append(element, children)
    return element


def append(element: Element, children: Child) -> None:
    """Add text, elements or nested sequences of them."""
    if children is None:
        return
    if isinstance(children, str):
        if len(element):
            element[-1].tail = (element[-1].tail or "") + children
        else:
            element.text = (element.text or "") + children
    elif isinstance(children, Element):
        element.append(children)
    else:
        for child in children:
            append(element, child)


def number(value: float) -> str:
    """A coordinate: at most one decimal, the least text."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def page(root: Element) -> str:
    """The whole document."""
    return "<!doctype html>\n" + ElementTree.tostring(root, encoding="unicode", method="html") + "\n"
