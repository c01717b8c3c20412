"""Where PyBullet and the extras are not installed, as on Linux on aarch64, everything runs in Warp."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio

# None in sys.modules makes an import fail as if the module were not installed.
WITHOUT_PYBULLET = """
import sys
for name in ("pybullet", "pybullet_data", "pybullet_utils", "mujoco"):
    sys.modules[name] = None
from rover_rl import RoverEnv
from rover_rl.cli import main
"""
TRAIN_AND_EVALUATE = """
RoverEnv(backend="warp", num_envs=2).rollout(3)
size = ["--num-envs", "4", "--workers", "1", "--rollout-length", "8", "--epochs", "1", "--total-steps", "64"]
assert main(["train", "--backend", "warp", "--runs", ".", "--name", "run", *size]) == 0
assert main(["evaluate", "run", "--backend", "warp", "--count", "2", "--seconds", "1"]) == 0
"""
FILM = """
assert main(["film", "pretrained:moon-sac", "--backend", "warp", "--seconds", "0.5", "--out", "film.gif"]) == 0
"""
ASK_FOR_BULLET = """
try:
    RoverEnv(backend="bullet")
except ImportError as error:
    print(error)
sys.exit(main(["evaluate", "pretrained:moon-sac", "--backend", "bullet", "--count", "2", "--seconds", "1"]))
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs code in a folder, in a process that has no PyBullet."""
    command = [sys.executable, "-c", WITHOUT_PYBULLET + code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_policies_are_trained_and_evaluated(tmp_path):
    done = run(TRAIN_AND_EVALUATE, tmp_path)
    assert done.returncode == 0, done.stderr
    files = {file.name for file in (tmp_path / "run").iterdir()}
    assert {"checkpoint.pt", "learning_curve.png", "evaluation.json", "paths.png"} <= files


def test_policies_are_filmed(tmp_path):
    done = run(FILM, tmp_path)
    assert done.returncode == 0, done.stderr
    frames = imageio.imread(tmp_path / "film.gif")
    assert frames.shape == (5, 480, 640, 3)
    assert frames.std() > 0


def test_bullet_says_what_to_do_in_one_sentence(tmp_path):
    done = run(ASK_FOR_BULLET, tmp_path)
    assert done.returncode == 2
    sentence = (
        "PyBullet is not installed: pip install 'rover_rl[bullet]', which compiles PyBullet where it has no wheels, or "
        "use the backends 'warp' or 'mujoco', which run without it\n"
    )
    assert done.stdout == sentence
    assert done.stderr == f"rover-rl: {sentence}"
