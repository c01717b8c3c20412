"""The GPU computes what the CPU computes, within rounding."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.sensors.color_camera import ColorCamera
from rover_rl.robots import get_robot
from rover_rl.robots.fleet import Fleet
from tests.gpu.driven import ROUGH, drive, environment

ROVERS = 192


@pytest.mark.parametrize("beams", [128, 640])
def test_the_lidar_measures_the_same_within_a_millimeter(gpu: torch.device, beams: int) -> None:
    scans = []
    for device in ("cpu", gpu):
        env = environment(device, ROVERS, world_n=ROUGH, lidar_beams=beams)
        env.reset()
        scans.append(env.base_env.scan.cpu())
        env.close()
    # Beams that meet nothing are infinite on both.
    same = scans[0].isclose(scans[1], rtol=0, atol=1e-3)
    # A beam along an edge may miss it on one of the two.
    assert same.float().mean() > 0.999


def test_color_images_agree(gpu: torch.device) -> None:
    images = []
    for device in ("cpu", gpu):
        env = environment(device, 6, world_n=("plaza:4", *ROUGH[:2]), sensors=[ColorCamera(size=(24, 32))])
        images.append(torch.stack([step["colors"] for step in drive(env, 2)]))
        env.close()
    # A ray along an edge may miss it on one of the two.
    assert ((images[0] - images[1]).abs() < 0.02).float().mean() > 0.98


def test_positions_after_a_second_on_flat_ground_agree_within_a_millimeter(gpu: torch.device) -> None:
    places = []
    for device in ("cpu", gpu):
        env = environment(device, ROVERS, length=100)
        env.reset()
        # Contacts with walls amplify rounding: what drives freely is compared, in the median.
        state = drive(env, 20)[-1]
        places.append(state["pose"][:, :2])
        env.close()
    apart = torch.linalg.vector_norm(places[0] - places[1], dim=-1)
    assert apart.median() < 1e-3


def test_rewards_and_events_agree(gpu: torch.device) -> None:
    first, other = (drive(environment(device, ROVERS, world_n=ROUGH), 5) for device in ("cpu", gpu))
    for a, b in zip(first, other, strict=True):
        close = (a["reward"] - b["reward"]).abs() < 1e-3
        assert close.float().mean() > 0.98
        assert (a["outcome", "phase"] == b["outcome", "phase"]).float().mean() > 0.98


@pytest.mark.parametrize("world", ["maze", "moon"])
def test_routes_on_the_map_agree(gpu: torch.device, world: str) -> None:
    env = environment("cpu", 64, world_n=world, length=200, lidar_points=128)
    maps = [
        SeenMap(Fleet.of(get_robot("rover_zero"), 64, device), env.base_env.config.lidar) for device in ("cpu", gpu)
    ]
    for step in drive(env, 40)[::4]:
        renewed = step["outcome", "steps"].squeeze(-1) <= 4
        routes = [
            seen(step.to(device), renewed=renewed.to(device)).cpu()
            for seen, device in zip(maps, ("cpu", gpu), strict=True)
        ]
        same = ((routes[0] - routes[1]).abs() < 1e-2).all(-1)
        # Of two routes of equal length, either may be found.
        assert same.float().mean() > 0.95


def test_a_policy_succeeds_as_often(gpu: torch.device) -> None:
    checkpoint, episodes = load_pretrained("anywhere"), draw_episodes("maze:10001", 64)
    found = []
    for device in ("cpu", gpu):
        env = replace(checkpoint.env, backend="warp", device=str(device))
        found.append(evaluate(checkpoint.make_actor().to(device), episodes, env=env, rows=64, seconds=30))
    on_cpu, on_gpu = (one.metrics["success_rate"] for one in found)
    assert on_cpu.low <= on_gpu.value <= on_cpu.high
