"""
A drive in Rerun
================

The script records a drive among people and writes it to a file for `Rerun <https://rerun.io>`_ (``pip install
rerun-sdk``): ``rerun drive.rrd`` opens it.
"""

from __future__ import annotations

import numpy as np
import rerun

from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.video.recording import curves_of, record_endless
from rover_rl.algos.video.views import lidar_beams
from rover_rl.sims.rendering.surfaces import (
    Surface,
    forms_of,
    ground_surface,
    obstacles_surface,
    part_surface,
    robot_surface,
)

SECONDS = 20
FILE = "drive.rrd"
drive = record_endless(ScriptedPolicy(), "crossing", seconds=SECONDS, rows=2, seed=0, env=None)


def mesh(surface: Surface) -> rerun.Mesh3D:
    colors = np.empty((len(surface.vertices), 3))
    colors[surface.faces.flatten()] = np.repeat(surface.colors, 3, axis=0)
    shape = {"vertex_positions": surface.vertices, "triangle_indices": surface.faces}
    return rerun.Mesh3D(**shape, vertex_normals=surface.normals, vertex_colors=np.uint8(255 * np.clip(colors, 0, 1)))


# %%
# What does not change
# --------------------

rerun.init("rover_rl")
rerun.save(FILE)
rerun.log("world/ground", mesh(ground_surface(drive.world.terrain)), static=True)
if (obstacles := obstacles_surface(drive.world)) is not None:
    rerun.log("world/obstacles", mesh(obstacles), static=True)
for part, form in enumerate(forms_of(drive.world, drive.moments[0].movers)):
    rerun.log(f"world/movers/{part}", mesh(part_surface(form)), static=True)
for row in range(2):
    rerun.log(f"world/rovers/{row}", mesh(robot_surface(drive.robot)), static=True)

# %%
# What moves
# ----------

curves = curves_of(drive)
for index, moment in enumerate(drive.moments):
    rerun.set_time("time", duration=moment.seconds)
    movers = moment.movers.position[0], moment.movers.orientation[0]
    for kind, (places, turns) in {
        "rovers": (moment.rover.position, moment.rover.orientation),
        "movers": movers,
    }.items():
        for number, (place, turn) in enumerate(zip(places.numpy(), turns.numpy(), strict=True)):
            turned = rerun.Quaternion(xyzw=turn)
            rerun.log(f"world/{kind}/{number}", rerun.Transform3D(translation=place, rotation=turned))
    ends = lidar_beams(moment.rover, moment.scan, drive.robot, drive.ray_angles)[1]
    rerun.log("world/lidar_hits", rerun.Points3D(ends[ends.isfinite().all(-1)].numpy(), radii=0.02))
    for name, values in curves.items():
        rerun.log(f"curves/{name}", rerun.Scalars(values[index]))

print(f"{FILE}: {len(drive.moments)} moments")
