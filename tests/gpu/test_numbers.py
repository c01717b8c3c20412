"""The GPU computes what the CPU computes, within rounding."""

from __future__ import annotations

from dataclasses import replace

import torch

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.envs.sensors.cameras import ColorCamera
from tests.gpu.driven import ROUGH, drive, environment

ROVERS = 192


def test_lidar_positions_rewards_and_events_agree(gpu: torch.device) -> None:
    scans, runs = [], []
    for device in ("cpu", gpu):
        env = environment(device, ROVERS, world_n=ROUGH)
        env.reset()
        scans.append(env.base_env.scan.cpu())
        runs.append(drive(env, 20))
        env.close()
    # Beams that meet nothing are infinite on both. A beam along an edge may miss it on one of the two.
    assert scans[0].isclose(scans[1], rtol=0, atol=1e-3).float().mean() > 0.999
    first, other = runs
    for a, b in zip(first[:5], other[:5], strict=True):
        assert ((a["reward"] - b["reward"]).abs() < 1e-3).float().mean() > 0.98
        assert (a["outcome", "phase"] == b["outcome", "phase"]).float().mean() > 0.98
    # Contacts with walls amplify rounding: what drives freely is compared, in the median.
    assert (first[-1]["pose"] - other[-1]["pose"])[:, :2].norm(dim=-1).median() < 1e-3


def test_color_images_agree(gpu: torch.device) -> None:
    images = []
    for device in ("cpu", gpu):
        env = environment(device, 6, world_n=("plaza:4", *ROUGH[:2]), sensors=[ColorCamera(size=(24, 32))])
        images.append(torch.stack([step["colors"] for step in drive(env, 2)]))
        env.close()
    # A ray along an edge may miss it on one of the two.
    assert ((images[0] - images[1]).abs() < 0.02).float().mean() > 0.98


def test_a_policy_succeeds_as_often(gpu: torch.device) -> None:
    checkpoint, episodes = load_pretrained("anywhere"), draw_episodes("maze:10001", 64)
    found = []
    for device in ("cpu", gpu):
        env = replace(checkpoint.env, backend="warp", device=str(device))
        found.append(evaluate(checkpoint.make_actor().to(device), episodes, env=env, rows=64, seconds=30))
    on_cpu, on_gpu = (one.metrics["success_rate"] for one in found)
    assert on_cpu.low <= on_gpu.value <= on_cpu.high
