"""Expressions of xacro that were left in a URDF: ``${...}``, ``$(arg ...)``, ``$(optenv ...)``."""

from __future__ import annotations

import re
from contextlib import suppress
from xml.etree.ElementTree import Element

LIGHT = 0.1
"""Largest share of the mass of a robot that is left out."""
FOUND_PACKAGE = re.compile(r"(file://)?\$\(find\s+([\w-]+)\)")
"""Folder of a ROS package in the file name of a mesh."""

_NEEDED = ("parent", "child", "origin", "axis", "limit")
"""Parts of a joint that are read."""


def expression_in(element: Element) -> str:
    """Returns the first value of an element with an expression, or nothing. Meshes are found by their package."""
    values = (FOUND_PACKAGE.sub("", value) if element.tag == "mesh" else value for value in element.attrib.values())
    return next((value for value in values if "${" in value or "$(" in value), "")


def leave_out_expressions(root: Element) -> list[str]:
    """Removes what has an expression and does not matter for driving, and returns a sentence on each.

    That is: materials, visual shapes, what simulators add to links and joints, and links that are fixed by a joint with
    an expression, such as an IMU, with all that hangs on them, if that is light.
    """
    sentences = []

    def leave_out(parent: Element, part: Element, name: str) -> None:
        if found := next(filter(None, map(expression_in, part.iter())), ""):
            parent.remove(part)
            sentences.append(f"{name} is left out, as it has the expression {found} of xacro")

    for joint in root.findall("joint"):
        name = joint.get("name", "")
        for part in [*joint]:
            if part.tag not in _NEEDED:
                leave_out(joint, part, f"the {part.tag} of joint {name}")
            elif part.tag == "limit":
                for key in ("effort", "velocity"):
                    if "$" in part.get(key, ""):
                        sentences.append(f"the {key} of joint {name} is left out: {part.attrib.pop(key)} of xacro")
        origin = joint.find("origin")
        # What hangs on another link that is left out is gone already.
        if origin is not None and (found := expression_in(origin)) and joint in root.findall("joint"):
            below = _below(root, joint)
            ends = {_end(each, "child") for each in below}
            links = [link for link in root.findall("link") if link.get("name") in ends]
            is_light = _mass(links) <= LIGHT * _mass(root.findall("link"))
            if is_light and all(each.get("type") == "fixed" for each in below):
                names = ", ".join(sorted(ends))
                sentences.append(f"link {names} is left out, as its pose has the expression {found} of xacro")
                for part in (*below, *links):
                    root.remove(part)
    for link in root.findall("link"):
        for part in [*link]:
            for material in part.findall("material"):
                leave_out(part, material, f"the material of link {link.get('name')}")
            if part.tag not in ("inertial", "collision"):
                leave_out(link, part, f"the {part.tag} of link {link.get('name')}")
    for material in root.findall("material"):
        leave_out(root, material, f"the material {material.get('name')}")
    return sentences


def _below(root: Element, joint: Element) -> list[Element]:
    """Returns a joint and all that hang on its child."""
    found, joints = [joint], root.findall("joint")
    for each in found:
        found += [other for other in joints if _end(other, "parent") == _end(each, "child") and other not in found]
    return found


def _end(joint: Element, tag: str) -> str:
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")


def _mass(links: list[Element]) -> float:
    """Returns the mass of links, as far as it is stated in numbers."""
    total = 0.0
    for mass in (link.find("inertial/mass") for link in links):
        with suppress(ValueError):
            total += 0.0 if mass is None else float(mass.get("value", "0"))
    return total
