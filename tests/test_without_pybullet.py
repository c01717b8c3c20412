"""Where PyBullet and the extras are not installed, as on Linux on aarch64, everything runs in Warp."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest

# None in sys.modules makes an import fail as if the module were not installed.
PROGRAM = """
import sys
for name in ("pybullet", "pybullet_data", "pybullet_utils", "mujoco", "viser"):
    sys.modules[name] = None
from rover_rl import RoverEnv
from rover_rl.cli import main

RoverEnv(backend="warp", num_envs=2).rollout(3)
size = ["--num-envs", "4", "--workers", "1", "--rollout-length", "4", "--epochs", "1", "--total-steps", "16"]
assert main(["train", "--backend", "warp", "--runs", ".", "--name", "run", *size]) == 0
short = ["--count", "1", "--seconds", "0.2", "--workers", "1"]
assert main(["evaluate", "run", "--backend", "warp", *short]) == 0
film = ["--seconds", "0.5", "--width", "80", "--height", "60", "--out", "film.gif"]
assert main(["film", "pretrained:moon-sac", "--backend", "warp", *film]) == 0
try:
    main(["view", "--help"])
except SystemExit as end:
    assert not end.code
assert main(["view"]) == 2
try:
    RoverEnv(backend="bullet")
except ImportError as error:
    print(error)
sys.exit(main(["evaluate", "pretrained:moon-sac", "--backend", "bullet", *short]))
"""
SENTENCE = (
    "PyBullet is not installed: pip install 'rover_rl[bullet]', which compiles PyBullet where it has no wheels, or "
    "use the backends 'warp' or 'mujoco', which run without it\n"
)
VIEWER = 'rover-rl: the viewer needs viser, an extra: pip install "rover_rl[view]"\n'


@pytest.mark.slow
def test_policies_are_trained_evaluated_and_filmed_and_what_is_missing_says_what_to_do(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    files = {file.name for file in (tmp_path / "run").iterdir()}
    assert {"checkpoint.pt", "learning_curve.png", "evaluation.json", "paths.png"} <= files
    frames = imageio.imread(tmp_path / "film.gif")
    assert frames.shape == (5, 60, 80, 3)
    assert frames.std() > 0
    assert done.stdout.endswith(SENTENCE)
    assert done.stderr == f"{VIEWER}rover-rl: {SENTENCE}"
