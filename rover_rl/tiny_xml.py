"""XML as Gazebo and ROS read it, with the rules of TinyXML 2 in place of those of the XML standard."""

from __future__ import annotations

import re
from collections.abc import Callable
from xml.etree.ElementTree import Element, TreeBuilder

MAX_DEPTH = 500
"""Largest number of elements within one another, that of TinyXML 2."""
_NAME = r"[A-Za-z_:\x80-\U0010ffff][\w:.\x80-\U0010ffff-]*"
_OTHER = re.compile(r"<!--.*?-->|<\?.*?\?>|<!\[CDATA\[(.*?)\]\]>|<!(?!--|\[CDATA\[)[^>]*>|([^<]+)", re.DOTALL)
"""A comment, a declaration, CDATA (group 1), a document type, or text (group 2)."""
_TAG = re.compile(rf"<\s*(/?)({_NAME})")
_ATTRIBUTE = re.compile(rf"\s*({_NAME})\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_TAG_END = re.compile(r"\s*(/?)>")
_ENTITY = re.compile(r"&(?:(quot|amp|apos|lt|gt)|#(\d+)|#x([0-9a-fA-F]+));")
_CHARACTERS = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}


def parse_xml(data: bytes) -> Element:
    """Parses XML into a tree without comments.

    As in TinyXML 2, a prefix such as ``gz:`` is part of the name and needs no declaration, space and comments may come
    before the declaration, a comment may hold ``--``, and an entity that XML does not define stays as it is written.

    Raises:
        ValueError: if it is not XML, or declares entities. The message is one sentence.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # All numbers and most names are ASCII, whatever the encoding.
        text = data.decode("latin-1")
    builder, place = TreeBuilder(), 0
    names: list[str] = []
    root: Element | None = None

    def wrong(what: str) -> ValueError:
        return ValueError(f"{what}: line {text.count(chr(10), 0, place) + 1}")

    while place < len(text) and root is None:
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
        attributes, place = _attributes(text, place, wrong)
        end = _TAG_END.match(text, place)
        if end is None:
            raise wrong(f"the tag <{closing}{name[:40]}> is damaged")
        place = end.end()
        if not closing:
            builder.start(name, attributes)
            names.append(name)
            if len(names) > MAX_DEPTH:
                raise wrong(f"elements are within one another more than {MAX_DEPTH} deep")
        elif not names or names[-1] != name:
            raise wrong(f"</{name[:40]}> ends no <{name[:40]}>")
        if closing or end[1]:
            builder.end(names.pop())
            root = None if names else builder.close()
    if root is None:
        raise wrong(f"no element found that ends <{names[-1][:40]}>" if names else "no element found")
    return root


def _attributes(text: str, place: int, wrong: Callable[[str], ValueError]) -> tuple[dict[str, str], int]:
    """Returns the attributes from a place in a tag on, and the place behind them."""
    attributes: dict[str, str] = {}
    while (found := _ATTRIBUTE.match(text, place)) is not None:
        name, place = found[1], found.end()
        if name in attributes:
            raise wrong(f"duplicate attribute {name[:40]!r}")
        attributes[name] = _decoded(found[2] or found[3] or "")
    return attributes, place


def _decoded(text: str) -> str:
    """Returns text with the characters that XML's own entities, and numbers of characters, stand for."""
    return _ENTITY.sub(_character, text) if "&" in text else text


def _character(entity: re.Match[str]) -> str:
    if entity[1]:
        return _CHARACTERS[entity[1]]
    digits = entity[2] or entity[3]
    code = int(digits[-8:], 10 if entity[2] else 16) if len(digits.lstrip("0")) <= 8 else 0
    return chr(code) if 0 < code <= 0x10FFFF else entity[0]
