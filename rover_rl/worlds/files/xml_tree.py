"""Reading of XML files of bounded size, and of what their elements say."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rover_rl.tiny_xml import parse_xml

MAX_BYTES = 64 * 2**20


def read_xml(path: Path, data: bytes | None = None) -> Element:
    """Parses an XML file, whose content may have been read already, as Gazebo does."""
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path} has more than {MAX_BYTES >> 20} MB, which is more than a world has")
    try:
        return parse_xml(path.read_bytes() if data is None else data)
    except ValueError as error:
        raise ValueError(f"{path} is not valid XML: {error}") from error


def text_of(element: Element | None) -> str:
    """Returns the text of an element without surrounding space."""
    return "" if element is None or element.text is None else element.text.strip()


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


def is_true(element: Element | None) -> bool:
    """Returns whether the text of an element means true."""
    return text_of(element).lower() in ("1", "true")
