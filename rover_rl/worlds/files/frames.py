"""Frames of SDF: poses relative to other frames, in models within models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.tiny_xml import numbers, text_of

MODEL = "__model__"
WORLD = "world"


def pose_of(element: Element, what: str) -> tuple[np.ndarray, str]:
    """Returns the pose in the ``<pose>`` of an element, ``[4, 4]``, and the frame that it is relative to.

    The frame is empty for the default one. ``what`` is what the element is, for messages.
    """
    pose = element.find("pose")
    transform = np.eye(4)
    if pose is None:
        return transform, ""
    what = f"the pose of {what}"
    if pose.get("rotation_format", "euler_rpy") == "quat_xyzw":
        values = numbers(pose, 7, (0, 0, 0, 0, 0, 0, 1), what)
        if np.linalg.norm(values[3:]) < 1e-6:
            raise ValueError(f"{what} has a quaternion of length 0")
        rotation = Rotation.from_quat(values[3:])
    else:
        values = numbers(pose, 6, (0,) * 6, what)
        degrees = pose.get("degrees", "false").lower() in ("1", "true")
        # SDF: roll, pitch and yaw about the fixed x, y and z axes, in this order.
        rotation = Rotation.from_euler("xyz", values[3:], degrees=degrees)
    transform[:3, :3], transform[:3, 3] = rotation.as_matrix(), values[:3]
    # SDF 1.5 and 1.6 call the attribute "frame".
    return transform, pose.get("relative_to", pose.get("frame", "")).strip()


def to_pose(transform: np.ndarray) -> tuple[float, float, float, float, float, float]:
    """Returns x, y, z (m), roll, pitch, yaw (rad) of a transform ``[4, 4]``."""
    x, y, z = transform[:3, 3].tolist()
    pitch = math.asin(min(1.0, max(-1.0, -float(transform[2, 0]))))
    roll = math.atan2(transform[2, 1], transform[2, 2])
    return x, y, z, roll, pitch, math.atan2(transform[1, 0], transform[0, 0])


@dataclass
class Scope:
    """The frames of a model or of the world, by name: functions of a pose, and of the frame that it is relative to.

    A pose is read when it is needed, so that a wrong one spoils nothing else. ``children`` are the scopes of the models
    in it, and ``merged`` those of models that were merged into it.
    """

    name: str
    frames: dict[str, Callable[[], tuple[np.ndarray, str]]] = field(default_factory=dict)
    children: dict[str, Scope] = field(default_factory=dict)
    merged: list[tuple[str, Scope]] = field(default_factory=list)

    @classmethod
    def of(cls, element: Element, name: str) -> Scope:
        """Returns the frames of a world, or of a model's own links, joints and frames."""
        scope = cls(name)
        for part in (*element.findall("link"), *element.findall("joint"), *element.findall("frame")):
            # A joint's frame is that of its child link; before SDF 1.7 the child is not a frame elsewhere.
            default = text_of(part.find("child")) if part.tag == "joint" else part.get("attached_to", "")
            scope.frames[part.get("name", "")] = partial(scope._own, part, default)
        return scope

    def _own(self, part: Element, default: str) -> tuple[np.ndarray, str]:
        transform, base = pose_of(part, f"{part.get('name', '')!r} in {self.name}")
        return transform, base or default

    def pose(self, name: str, below: tuple[str, ...] = ()) -> np.ndarray:
        """Returns the transform of a frame, ``[4, 4]``, in the frame of the model or world."""
        if name in ("", MODEL, WORLD, "__root__"):
            return np.eye(4)
        if name in below:
            raise ValueError(f"the frame {name!r} of {self.name} is relative to itself, through others")
        if name in self.frames:
            transform, base = self.frames[name]()
            return self.pose(base, (*below, name)) @ transform
        first, _, rest = name.partition("::")
        if rest and first in self.children:
            return self.pose(first, (*below, name)) @ self.children[first].pose(rest)
        for child, scope in self.merged:
            if name in scope.frames:
                return self.pose(child, (*below, name)) @ scope.pose(name)
        raise ValueError(f"{self.name} has no frame {name!r}; it has {sorted(self.frames)[:20]}")
