"""Export of a recorded drive for `Rerun <https://rerun.io>`_, as an ``.rrd`` file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.video.recording import Recording, curves_of
from rover_rl.algos.video.views import lidar_beams
from rover_rl.files import written_whole
from rover_rl.sims.rendering.mover_surfaces import forms_of, part_surface
from rover_rl.sims.rendering.robot_surface import robot_surface
from rover_rl.sims.rendering.surfaces import Surface, ground_surface, obstacles_surface

TIMELINE = "time"
"""Name of the time line, s."""
APPLICATION = "rover_rl"
"""Name of the application in Rerun."""
_HIT, _DRIVEN, _GOAL = (255, 120, 0), (30, 120, 255), (20, 190, 90)


def write_rrd(recording: Recording, path: Path) -> None:
    """Writes a recorded drive: world, movers, rovers, lidar hits, goal and driven path, and curves of the first rover.

    Raises:
        ImportError: if Rerun is not installed.
        OSError: if the file cannot be written.
    """
    try:
        import rerun
    except ImportError as error:
        raise ImportError("an .rrd file needs Rerun: pip install rerun-sdk") from error
    with written_whole(path) as temporary, rerun.RecordingStream(APPLICATION) as stream:
        stream.save(temporary)
        stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("world/ground", _mesh(rerun, ground_surface(recording.world.terrain)), static=True)
        if (obstacles := obstacles_surface(recording.world)) is not None:
            stream.log("world/obstacles", _mesh(rerun, obstacles), static=True)
        if (movers := recording.moments[0].movers) is not None:
            for part, form in enumerate(forms_of(recording.world, movers)):
                stream.log(f"world/movers/{part}", _mesh(rerun, part_surface(form)), static=True)
        for row in range(len(recording.moments[0].goal)):
            stream.log(f"world/rovers/{row}", _mesh(rerun, robot_surface(recording.robot)), static=True)
        _log_moments(rerun, stream, recording)
        stream.flush()


def _log_moments(rerun: Any, stream: Any, recording: Recording) -> None:
    curves = curves_of(recording)
    path: list[np.ndarray] = []
    for index, moment in enumerate(recording.moments):
        stream.set_time(TIMELINE, duration=moment.seconds)
        _log_poses(rerun, stream, "rovers", moment.rover.position.cpu(), moment.rover.orientation.cpu())
        if moment.movers is not None:
            _log_poses(rerun, stream, "movers", moment.movers.position[0], moment.movers.orientation[0])
        ends = lidar_beams(moment.rover, moment.scan, recording.robot, recording.ray_angles)[1]
        hits = ends[ends.isfinite().all(-1)].numpy()
        stream.log("world/lidar_hits", rerun.Points3D(hits, colors=_HIT, radii=0.02))
        goal = moment.goal.cpu()
        height = recording.world.height_at(goal.double()).float()
        places = torch.cat((goal, height.reshape(-1, 1)), -1).numpy()
        stream.log("world/goals", rerun.Points3D(places, colors=_GOAL, radii=0.1))
        path.append(moment.rover.position[0].cpu().numpy())
        stream.log("world/driven_path", rerun.LineStrips3D([np.array(path)], colors=_DRIVEN, radii=0.02))
        for name, values in curves.items():
            stream.log(["curves", name], rerun.Scalars(values[index]))


def _log_poses(rerun: Any, stream: Any, kind: str, position: Tensor, orientation: Tensor) -> None:
    for index, (place, quaternion) in enumerate(zip(position.numpy(), orientation.numpy(), strict=True)):
        turned = rerun.Quaternion(xyzw=quaternion)
        stream.log(f"world/{kind}/{index}", rerun.Transform3D(translation=place, rotation=turned))


def _mesh(rerun: Any, surface: Surface) -> Any:
    colors = np.empty((len(surface.vertices), 3))
    colors[surface.faces.flatten()] = np.repeat(surface.colors, 3, axis=0)
    return rerun.Mesh3D(
        vertex_positions=surface.vertices,
        triangle_indices=surface.faces,
        vertex_normals=surface.normals,
        vertex_colors=np.uint8(255 * np.clip(colors, 0, 1)),
    )
