"""Rendering with MuJoCo's OpenGL renderer, for installations without PyBullet."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.native.mujoco import mujoco
from rover_rl.sims.rendering.camera import FIELD_OF_VIEW, NEAR, Camera
from rover_rl.sims.rendering.scenery import FAR, GOAL, GROUND, OBSTACLE, POST_LENGTH, POST_RADIUS, SUN, post_position
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.description import Description
from rover_rl.sims.worlds import World

if TYPE_CHECKING:
    from mujoco.renderer import Renderer as MujocoRenderer

_VISUAL_GROUP = 1
"""Group of geoms that MuJoCo gives to the visual shapes of a URDF. It is also that of the scenery."""


class OpenGLRenderer:
    """Renderer of one world, with the interface of :class:`rover_rl.sims.rendering.renderer.Renderer`.

    Args:
        world: world to render.
        robot: robot model.

    Raises:
        ImportError: if OpenGL is not available.
    """

    def __init__(self, world: World, robot: Robot) -> None:
        self._world = world
        self._model = _make_model(world, robot)
        self._data = mujoco.MjData(self._model)
        self._renderer: MujocoRenderer | None = None
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[_VISUAL_GROUP] = 1

    def render(
        self,
        position: Tensor,
        orientation: Tensor,
        view: View,
        width: int,
        height: int,
        goal: Tensor | None = None,
    ) -> Tensor:
        """Renders a rover at a pose, with a post at its goal.

        See :meth:`rover_rl.sims.rendering.renderer.Renderer.render`.
        """
        camera = Camera.on(position, orientation, self._world, view)
        rover, post = self._data.mocap_pos
        rover[:] = position
        post[:] = post_position(self._world, goal)
        self._data.mocap_quat[0] = orientation.roll(1)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        renderer = self._sized(width, height)
        renderer.update_scene(self._data, _free_camera(camera), self._options)
        return torch.from_numpy(renderer.render().copy())

    def close(self) -> None:
        """Releases the OpenGL context. Idempotent."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _sized(self, width: int, height: int) -> MujocoRenderer:
        """Returns a renderer of images of the given size in pixels. Creates a new one if the size has changed."""
        if self._renderer is None or (self._renderer.width, self._renderer.height) != (width, height):
            self.close()
            buffer = self._model.vis.global_
            buffer.offwidth, buffer.offheight = width, height
            try:
                self._renderer = mujoco.Renderer(self._model, height, width)
            # Every OpenGL library raises errors of its own, among them AttributeError.
            except Exception as error:
                raise ImportError(
                    "pictures need PyBullet (pip install 'rover_rl[bullet]', which needs a compiler) or OpenGL for "
                    "MuJoCo: on Linux without a display, install libegl1 or libosmesa6 and set MUJOCO_GL=egl or osmesa"
                ) from error
        return self._renderer


def _make_model(world: World, robot: Robot) -> mujoco.MjModel:
    """Creates a model of the scenery, the visual shapes of the robot and the post of the goal."""
    spec = mujoco.MjSpec.from_string(_with_visual_shapes(robot.urdf))
    spec.body(Description(robot.urdf).base).mocap = True
    post = spec.worldbody.add_body(name="goal", mocap=True)
    size = (POST_RADIUS, POST_LENGTH / 2, 0)
    _add_geom(post, GOAL, type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size)
    _add_mesh(spec, "ground", *world.terrain.mesh(), color=GROUND)
    for index, obstacle in enumerate(world.obstacles):
        # Separate vertices for every face give flat shading with visible edges.
        corners = obstacle.vertices[obstacle.faces.flatten()]
        _add_mesh(spec, f"obstacle {index}", corners, torch.arange(len(corners)).reshape(-1, 3), OBSTACLE)
    light = {"diffuse": (0.5, 0.5, 0.5), "specular": (0, 0, 0), "castshadow": False}
    spec.worldbody.add_light(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=-np.array(SUN), **light)
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
    spec.add_texture(name="sky", width=8, height=48, rgb1=(1, 1, 1), rgb2=(1, 1, 1), **sky)
    model = spec.compile()
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:], model.vis.headlight.specular[:] = 0.5, 0.1, 0.0
    # Distances of the near and far planes are relative to the extent.
    model.stat.extent = 1.0
    model.vis.map.znear, model.vis.map.zfar = NEAR, FAR
    model.vis.global_.fovy = FIELD_OF_VIEW
    return model


def _with_visual_shapes(urdf: Path) -> str:
    """Returns the text of a URDF with MuJoCo's options to keep visual shapes and to find meshes beside the file."""
    root = ET.parse(urdf).getroot()
    options = {"discardvisual": "false", "fusestatic": "false", "meshdir": str(urdf.parent.resolve())}
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", options)
    return ET.tostring(root, encoding="unicode")


def _add_mesh(spec: mujoco.MjSpec, name: str, vertices: Tensor, faces: Tensor, color: tuple[float, ...]) -> None:
    center = vertices.mean(0)
    spec.add_mesh(
        name=name,
        uservert=(vertices - center).flatten().tolist(),
        userface=faces.flatten().tolist(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    _add_geom(spec.worldbody, color, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=center.numpy())


def _add_geom(body: Any, color: tuple[float, ...], **options: Any) -> None:
    body.add_geom(rgba=color, group=_VISUAL_GROUP, contype=0, conaffinity=0, **options)


def _free_camera(camera: Camera) -> mujoco.MjvCamera:
    """Converts a camera to MuJoCo's, which has the distance, azimuth and elevation (degrees) of its target."""
    sight = (camera.target - camera.eye).tolist()
    distance = math.hypot(*sight)
    free = mujoco.MjvCamera()
    free.type = mujoco.mjtCamera.mjCAMERA_FREE
    free.lookat, free.distance = camera.target.numpy(), distance
    free.elevation = math.degrees(math.asin(sight[2] / distance))
    # Seen from above, the azimuth is the direction that points up in the image.
    x, y = sight[:2] if math.hypot(*sight[:2]) > 1e-6 * distance else camera.up[:2].tolist()
    free.azimuth = math.degrees(math.atan2(y, x))
    return free
