"""XML as Gazebo and ROS read it, with the rules of TinyXML 2 in place of those of the XML standard."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder

import numpy as np

_NAME = r"[A-Za-z_:\x80-\U0010ffff][\w:.\x80-\U0010ffff-]*"
_OTHER = re.compile(r"<!--.*?-->|<\?.*?\?>|<!\[CDATA\[(.*?)\]\]>|<!(?!--|\[CDATA\[)[^>]*>|([^<]+)", re.DOTALL)
"""A comment, a declaration, CDATA (group 1), a document type, or text (group 2)."""
_TAG = re.compile(rf"<\s*(/?)({_NAME})")
_ATTRIBUTE = re.compile(rf"\s*({_NAME})\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_TAG_END = re.compile(r"\s*(/?)>")
_ENTITY = re.compile(r"&(?:(quot|amp|apos|lt|gt)|#(\d{1,8})|#x([0-9a-fA-F]{1,8}));")
_CHARACTERS = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}


def parse_xml(data: bytes) -> Element:
    """Parses XML into a tree without comments.

    As in TinyXML 2, a prefix such as ``gz:`` is part of the name and needs no declaration, space and comments may come
    before the declaration, a comment may hold ``--``, and an entity that XML does not define stays as it is written.
    Raises ``ValueError`` if it is not XML, or declares entities.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # All numbers and most names are ASCII, whatever the encoding.
        text = data.decode("latin-1")
    builder, place = TreeBuilder(), 0
    names: list[str] = []

    def wrong(what: str) -> ValueError:
        return ValueError(f"{what}: line {text.count(chr(10), 0, place) + 1}")

    while place < len(text):
        other = _OTHER.match(text, place)
        if other is not None:
            if other[0].startswith("<!") and "<!ENTITY" in other[0]:
                raise ValueError("it declares XML entities or external references, which are not read")
            if names and (other[1] or other[2]):
                builder.data(other[1] or _decoded(other[2]))
            place = other.end()
            continue
        tag = _TAG.match(text, place)
        if tag is None:
            raise wrong("no tag, comment or text")
        (closing, name), place = tag.groups(), tag.end()
        attributes: dict[str, str] = {}
        while (found := _ATTRIBUTE.match(text, place)) is not None:
            if found[1] in attributes:
                raise wrong(f"duplicate attribute {found[1][:40]!r}")
            attributes[found[1]], place = _decoded(found[2] or found[3] or ""), found.end()
        end = _TAG_END.match(text, place)
        if end is None:
            raise wrong(f"the tag <{closing}{name[:40]}> is damaged")
        place = end.end()
        if not closing:
            builder.start(name, attributes)
            names.append(name)
        elif not names or names[-1] != name:
            raise wrong(f"</{name[:40]}> ends no <{name[:40]}>")
        if closing or end[1]:
            builder.end(names.pop())
            if not names:
                return builder.close()
    raise wrong(f"no element found that ends <{names[-1][:40]}>" if names else "no element found")


def _decoded(text: str) -> str:
    return _ENTITY.sub(_character, text) if "&" in text else text


def _character(entity: re.Match[str]) -> str:
    if entity[1]:
        return _CHARACTERS[entity[1]]
    code = int(entity[2]) if entity[2] else int(entity[3], 16)
    return chr(code) if 0 < code <= 0x10FFFF else entity[0]


def read_xml(path: Path) -> Element:
    """Parses an XML file. The message of the ``ValueError`` for a wrong one names it."""
    try:
        return parse_xml(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path} is not valid XML: {error}") from error


def text_of(element: Element | None) -> str:
    return "" if element is None or element.text is None else element.text.strip()


def is_true(element: Element | None) -> bool:
    return text_of(element).lower() in ("1", "true")


def numbers(element: Element | None, count: int, default: tuple[float, ...] | None, what: str) -> np.ndarray:
    """Returns the numbers in the text of an element: ``[count]``. ``what`` describes it for messages.

    ``default`` is the value for a missing or empty element; ``None``: there must be one.
    """
    text = text_of(element)
    if not text and default is not None:
        return np.array(default, dtype=float)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{what} must be {count} finite {'numbers' if count > 1 else 'number'}, got {text[:80]!r}")
    return values
