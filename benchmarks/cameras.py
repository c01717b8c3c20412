"""Cost of cameras and height scans: images per second beside Bullet's renderer, and their shares of a step.

``python -m benchmarks.cameras`` measures on one core. The images show the moon from the same places.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pybullet
import torch
import trimesh
import tyro

from rover_rl import EnvConfig, RoverEnv, Sensor
from rover_rl.envs.sensors.color_camera import ColorCamera
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.envs.sensors.ray_images import DepthCamera, Lidar3D
from rover_rl.rotations import rotate
from rover_rl.sims.rendering.surfaces import Surface, ground_surface, obstacles_surface
from rover_rl.sims.warp.settings import WarpSettings
from rover_rl.worlds import get_world


@dataclass(frozen=True)
class Options:
    """Options of the script."""

    rovers: int = 1024
    """Number of rovers in Warp."""
    world: str = "moon"
    """World."""
    rounds: int = 5
    """Number of comparisons, of which the median counts."""


def make(options: Options, *sensors: Sensor) -> RoverEnv:
    """Makes an environment with sensors, on one core."""
    backend = WarpSettings(threads=1)
    env = RoverEnv(EnvConfig(world=options.world, num_envs=options.rovers, seed=0, backend=backend, sensors=sensors))
    env.reset()
    return env


def seconds_of(act: Callable[[], object], least: float = 1.0) -> float:
    """Returns the mean time of a call, s."""
    act()
    began, calls = time.perf_counter(), 0
    while time.perf_counter() < began + least:
        act()
        calls += 1
    return (time.perf_counter() - began) / calls


def bullet_seconds(env: RoverEnv, camera: DepthCamera, world: str) -> float:
    """Returns the time that Bullet's renderer takes for an image of the camera of the first rover, s."""
    scene = get_world(world)
    parts = ground_surface(scene.terrain), obstacles_surface(scene, max_edge=math.inf)
    scenery = Surface.join([part for part in parts if part is not None])
    client = pybullet.connect(pybullet.DIRECT)
    with TemporaryDirectory() as folder:
        file = Path(folder, "world.obj")
        trimesh.Trimesh(scenery.vertices, scenery.faces, process=False).export(file)
        shape = pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=str(file), physicsClientId=client)
    pybullet.createMultiBody(0, -1, shape, physicsClientId=client)
    rover = env.rover_state
    axis = torch.tensor((math.cos(camera.pitch), 0.0, -math.sin(camera.pitch)))
    mount, ahead = rotate(rover.orientation[0], torch.stack((torch.tensor(camera.mount), axis)))
    eye = rover.position[0] + mount
    view = pybullet.computeViewMatrix(eye.tolist(), (eye + ahead).tolist(), (0, 0, 1))
    degrees = math.degrees(camera.field_of_view)
    projection = pybullet.computeProjectionMatrixFOV(degrees, 1.0, camera.min_range, camera.max_range)
    rows, columns = camera.size
    options = {"renderer": pybullet.ER_TINY_RENDERER, "physicsClientId": client, "shadow": 0}
    depth = np.array(pybullet.getCameraImage(columns, rows, view, projection, **options)[3])
    if not (depth < 1).any():
        raise RuntimeError("Bullet's image is empty")
    seconds = seconds_of(lambda: pybullet.getCameraImage(columns, rows, view, projection, **options))
    pybullet.disconnect(client)
    return seconds


def main(options: Options) -> None:
    """Measures, and prints the results."""
    torch.set_num_threads(1)
    camera = DepthCamera()
    plain = make(options)
    envs = {sensor.name: make(options, sensor) for sensor in (camera, ColorCamera(), Lidar3D(), HeightScan())}
    rates: dict[str, list[float]] = {name: [] for name in ("plain", *envs, "bullet")}
    for _ in range(options.rounds):
        rates["plain"].append(seconds_of(plain.rand_step))
        for name, env in envs.items():
            rates[name].append(seconds_of(env.rand_step))
        rates["bullet"].append(bullet_seconds(plain, camera, options.world))
    step, bullet = (statistics.median(rates.pop(name)) for name in ("plain", "bullet"))
    print(f"step of {options.rovers:,} rovers: {1000 * step:.0f} ms; image of Bullet: {1000 * bullet:.2f} ms")
    for name, times in rates.items():
        added = statistics.median(times) - step
        image = added / options.rovers
        print(
            f"{name}: {1 / image:,.0f} readings/s, {bullet / image:.1f} times as many as images of Bullet's renderer; "
            f"adds {100 * added / step:.0f} % to a step"
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
