"""The examples run, here with fewer steps than in the gallery."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest
import torch

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(monkeypatch, capsys):
    """A function that runs an example with other values of its constants and returns its output and its names."""
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    threads = torch.get_num_threads()

    def run_example(name: str, **constants: int) -> tuple[str, dict[str, object]]:
        code = (EXAMPLES / name).read_text(encoding="utf-8")
        for constant, value in constants.items():
            code, count = re.subn(rf"^{constant} = \d[\d_]*", f"{constant} = {value}", code, flags=re.MULTILINE)
            assert count == 1, constant
        names: dict[str, object] = {}
        exec(compile(code, name, "exec"), names)
        names["figures"] = len(plt.get_fignums())
        return capsys.readouterr().out, names

    yield run_example
    plt.close("all")
    torch.set_num_threads(threads)


def test_every_example_has_a_test():
    tests = Path(__file__).read_text()
    for path in EXAMPLES.glob("*.py"):
        assert f'run("{path.name}"' in tests


@pytest.mark.parametrize("path", [pytest.param(path, id=path.name) for path in sorted(EXAMPLES.glob("*.py"))])
def test_examples_are_pages_of_the_gallery(path):
    text = path.read_text(encoding="utf-8")
    title, line = re.match(r'"""\n(.+)\n(=+)\n', text).groups()
    assert len(line) == len(title)
    assert text.count("\n# %%\n") >= 2


def test_gymnasium_drive_reaches_its_goal(run):
    output, names = run("gymnasium_drive.py", ROVERS=4)
    assert re.search(r"^goal reached after \d", output, re.MULTILINE)
    assert "4 rovers reached" in output
    assert names["figures"] == 1


def test_lidar_scan(run):
    _, names = run("lidar_scan.py")
    assert names["figures"] == 2


def test_own_world(run):
    output, names = run("own_world.py")
    # The gate and the posts, not the ground alone, and a way out ahead.
    assert 60 < int(re.search(r"^(\d+) of 128 beams", output)[1]) < 128
    assert names["figures"] == 2


def test_import_map(run):
    pytest.importorskip("PIL")
    output, names = run("import_map.py", EPISODES=1)
    assert "16 boxes" in output
    assert "anywhere: 1 of 1 goals" in output
    assert names["figures"] == 2


def test_own_robot(run):
    output, names = run("own_robot.py", STEPS=20)
    assert re.search(r"^scout: 1\.00 m/s", output, re.MULTILINE)
    assert names["figures"] == 1


@pytest.mark.slow
def test_deploy_policy(run):
    pytest.importorskip("onnxruntime")
    output, names = run("deploy_policy.py", STEPS=20)
    assert names["names"] == ["lidar", "imu", "target", "velocities"]
    assert "m from the goal after 1.0 s" in output
    assert names["figures"] == 1


def test_own_reward(run):
    _, names = run("own_reward.py", STEPS=60)
    assert names["totals"]["tilt"] < 0 < names["totals"]["progress"]
    assert names["figures"] == 2


def test_evaluate_policies(run):
    output, names = run("evaluate_policies.py", EPISODES=2)
    assert "anywhere: 2 of 2 goals" in output
    assert "scripted: " in output
    assert names["figures"] == 1


@pytest.mark.slow
def test_fine_tuning(run):
    output, names = run("fine_tuning.py", EPISODES=2, STEPS=2_000)
    assert "fine-tuned: " in output
    assert names["figures"] == 1


def test_torchrl_ppo(run):
    output, names = run("torchrl_ppo.py", STEPS=256, ROVERS=2)
    assert len(output.splitlines()) == 2
    assert "256 steps" in output
    assert names["figures"] == 1


def test_sb3_sac(run):
    pytest.importorskip("stable_baselines3")
    output, _ = run("sb3_sac.py", STEPS=64, ROVERS=2, EPISODE=20)
    assert "of 2 rovers reached a goal" in output


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.name) for path in sorted((EXAMPLES / "other_libraries").glob("*.py"))]
)
def test_programs_for_other_libraries_use_what_exists(path):
    """Their libraries are not installed here: what they import from this package exists, and a page shows them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    ours = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module.startswith("rover_rl")]
    assert ours or "import rover_rl" in ast.unparse(tree)
    for node in ours:
        if node.module != "rover_rl.envs.wrappers.rsl_rl":
            module = import_module(node.module)
            assert all(hasattr(module, alias.name) for alias in node.names)
    attributes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    for node in attributes:
        if ast.unparse(node.value) == "rover_rl":
            assert hasattr(import_module("rover_rl"), node.attr)
    assert path.name in (EXAMPLES.parent / "docs" / "other_libraries.md").read_text(encoding="utf-8")
