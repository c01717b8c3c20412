"""
A policy without PyTorch
========================

An exported policy is one file that ONNX Runtime reads in C++, Python and other languages. This script exports a
pretrained policy, and drives a rover with it by NumPy and ONNX Runtime alone, as a robot's computer does. The simulator
stands for the robot. The extra ``onnx`` installs what it needs.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import onnxruntime
import torch

from rover_rl import make_env
from rover_rl.algos.deploy.export import export
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.worlds import get_world
from rover_rl.worlds.draw import draw_map

# %%
# Export
# ------
# ``rover-rl export pretrained:moon-sac`` does the same. The file is held against the policy before it is kept.

path = Path(tempfile.mkdtemp()) / "moon-sac.onnx"
difference = export(load_pretrained("moon-sac"), path)
print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB, actions differ by at most {difference:.0e}")

# %%
# Inputs and outputs
# ------------------
# They have names and a batch of one. A policy with memory has another input, ``state_in``: the ``state_out`` of the
# decision before.

session = onnxruntime.InferenceSession(path)
for entry in (*session.get_inputs(), *session.get_outputs()):
    print(entry.name, entry.shape, entry.type)

# %%
# The loop of a robot
# -------------------
# ``read`` and ``send`` are what a robot's drivers do: the latest sensor values, and a command. The heading offset of
# the action goes through a PID controller, which is part of the environment here and of ``rover-rl drive`` on a robot.

STEPS = 200  # of 0.05 s
env = make_env(world_n="moon", num_envs=1, seed=0, backend="warp", end_on_goal=True)
state = env.reset(start=torch.tensor([[-3.0, -3.0, 0.0]]), goal=torch.tensor([[3.0, 3.0]]))


def read(name: str) -> np.ndarray:
    return state[name].numpy()


def send(action: np.ndarray) -> bool:
    """Drives for a step. Returns whether the episode has ended."""
    global state
    after = env.step(state.set("action", torch.from_numpy(action)))["next"]
    state = after.exclude("reward")
    return bool(after["done"])


names = [entry.name for entry in session.get_inputs()]
driven = [read("pose")[0, :2]]
for _ in range(STEPS):
    (action,) = session.run(["action"], {name: read(name) for name in names})
    ended = send(action)
    driven.append(read("pose")[0, :2])
    if ended:
        break
distance = read("target")[0, 0]
print(f"{distance:.2f} m from the goal after {(len(driven) - 1) * 0.05:.1f} s")
env.close()

figure, axes = plt.subplots(figsize=(6, 5.6), layout="constrained")
draw_map(axes, get_world("moon"), ((-5, 5), (-5, 5)))
axes.plot(*np.transpose(driven), color="tab:red", linewidth=2.5, zorder=4)
axes.plot(3, 3, "*", color="gold", markeredgecolor="black", markersize=16, zorder=6)
axes.set_title("driven by ONNX Runtime")
plt.show()
