"""Replay without a server: one HTML file that opens offline, with a time slider.

The file holds viser's client and its recording of the scene, so that it shows what the page shows.
"""

from __future__ import annotations

from pathlib import Path

import torch

from rover_rl.algos.video.recording import Moment, Recording
from rover_rl.algos.video.session import Pose
from rover_rl.files import written_whole
from rover_rl.sims.free_space.path_distance import PathDistances
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.view.cameras import LOOK_AT, Cameras
from rover_rl.view.page import close_page, open_page
from rover_rl.view.stage import Stage

RATE = 10.0  # largest number of moments in a replay, 1/s. Between two, the rovers go on in small steps
CAPTION_EVERY = 5  # number of moments after which the caption changes


def write_replay(recording: Recording, path: Path, seconds: float | None = None) -> None:
    """Writes a recorded drive to an HTML file. ``seconds`` is the part at its end that is shown, s.

    Raises:
        ImportError: if the extra ``view`` is not installed.
        OSError: if the file cannot be written.
    """
    shown = recording if seconds is None else recording.last(seconds)
    server = open_page(port=0)
    try:
        stage, cameras = Stage(server), Cameras(server)
        stage.enter(recording.world, recording.robot, recording.ray_angles)
        first = Pose.of(shown.moments[0].rover)
        cameras.follow(first.position[0].numpy(), quaternion_to_euler(first.orientation[:1])[0, 2].item())
        label = server.scene.add_label("/caption", "", position=(0.0, 0.0, 1.0))
        server.initial_camera.position, server.initial_camera.look_at = cameras.place(), LOOK_AT
        stride = max(1, round(1 / (RATE * recording.dt)))
        rows = torch.arange(len(shown.moments[0].goal))
        goal: torch.Tensor | None = None
        serializer = server.get_scene_serializer()
        for index, moment in enumerate(shown.moments[::stride]):
            pose = Pose.of(moment.rover)
            stage.show(moment, 0, rows, pose)
            cameras.follow(pose.position[0].numpy(), quaternion_to_euler(pose.orientation[:1])[0, 2].item())
            if index % CAPTION_EVERY == 0:
                label.text = _caption(moment)
            if goal is None or not moment.goal[0].equal(goal):
                goal = moment.goal[0]
                _show_route(stage, recording, pose.position[0, :2], goal)
            serializer.insert_sleep(stride * recording.dt)
        page = serializer.as_html()
    finally:
        close_page(server)
    with written_whole(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _show_route(stage: Stage, recording: Recording, position: torch.Tensor, goal: torch.Tensor) -> None:
    distances = PathDistances([recording.world], recording.robot)
    stage.show_route(distances.path(0, position, goal.cpu()))


def _caption(moment: Moment) -> str:
    distance = torch.dist(moment.rover.position[0, :2].cpu(), moment.goal[0].cpu()).item()
    speed = moment.rover.linear_velocity[0].item()
    event, since = moment.event
    recent = f" · {event}" if event and moment.seconds < since + 3 else ""
    return f"{moment.seconds:.1f} s · {speed:.2f} m/s · goal {distance:.1f} m · goals {int(moment.goals[0])}{recent}"
