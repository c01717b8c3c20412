"""All examples run: those of docstrings, the Python blocks of the pages, and the programs of the gallery.

A docstring may use the names of its module and of ``MODULES`` without an import, and the runs in ``runs/``.
What it prints counts only where it shows a result.
"""

from __future__ import annotations

import ast
import doctest
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rover_rl.algos.config import with_settings
from rover_rl.algos.deploy import export
from rover_rl.algos.train import train
from tests.algos.train.runs import PPO, SAC
from tests.pages import NEEDS, ROOT, blocks, name_of, pages

MODULES = """
rover_rl rover_rl.algos.config rover_rl.algos.evaluation.episodes rover_rl.algos.evaluation.evaluate
rover_rl.algos.evaluation.report rover_rl.algos.experiments.runs
rover_rl.algos.policy.checkpoint rover_rl.algos.policy.names rover_rl.algos.policy.networks
rover_rl.algos.policy.runner rover_rl.algos.pretrained
rover_rl.algos.train.ppo rover_rl.envs rover_rl.sims.bullet rover_rl.sims.free_space rover_rl.robots
rover_rl.worlds rover_rl.worlds.pool rover_rl.worlds.table
"""
"""Modules whose public names examples of docstrings may use."""
DOCSTRINGS = [path for path in sorted((ROOT / "rover_rl").rglob("*.py")) if ">>> " in path.read_text(encoding="utf-8")]
PAGES = [page for page in pages() if blocks(page.read_text(encoding="utf-8"), "python")]
EXAMPLES = ROOT / "examples"


class Checker(doctest.OutputChecker):
    """Compares results, and lets what shows none print anything."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        return not want or super().check_output(want, got, optionflags)


@pytest.fixture(autouse=True)
def few_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exported policies are compared on few observations: other tests compare them on many."""
    monkeypatch.setattr(export, "CHECKED", 50)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with runs that examples read."""
    folder = tmp_path_factory.mktemp("examples")
    for name, config in (("ppo-moon", PPO), ("sac-moon", SAC)):
        train(with_settings(config, total_steps=64, name=name, runs=str(folder / "runs")))
    return folder


@pytest.fixture
def folder(runs: Path, monkeypatch: pytest.MonkeyPatch, own_registries: None) -> Path:
    """The current folder, which is that of the runs."""
    monkeypatch.chdir(runs)
    return runs


@pytest.mark.parametrize("path", [pytest.param(path, id=name_of(path)) for path in DOCSTRINGS])
@pytest.mark.usefixtures("folder")
def test_examples_of_docstrings(path: Path) -> None:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    try:
        module = import_module(name)
    except ImportError as error:
        pytest.skip(str(error))
    known: dict[str, Any] = {"Path": Path, "torch": torch}
    for known_module in map(import_module, MODULES.split()):
        names = getattr(known_module, "__all__", None) or vars(known_module)
        known |= {each: getattr(known_module, each) for each in names if not each.startswith("__")}
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    for test in doctest.DocTestFinder().find(module, globs={**known, **vars(module)}):
        told: list[str] = []
        if doctest.DocTestRunner(Checker(), optionflags=flags).run(test, out=told.append).failed:
            pytest.fail("".join(told), pytrace=False)


def shortened(code: str) -> str:
    """Shortens or leaves out training, which has its own tests, and makes large batches small."""
    code = re.sub(r"\.learn\([\d_]+\)", "", code)
    code = re.sub(r"\b1_000\b", "50", code)
    code = re.sub(r"\bnum_iter=\d+", "num_iter=20", code)
    code = re.sub(r"total_frames=\d+_000", "total_frames=100", code)
    code = re.sub(r"\brollout\(\d{3}\b", "rollout(10", code)
    code = code.replace(".first(8)", ".first(1)").replace("seconds=6", "seconds=0.5")
    code = re.sub(r"^(\w+ = evaluate\(.*)\)$", r"\1, seconds=1)", code, flags=re.MULTILINE)
    code = re.sub(r"^UPDATES = \d+", "UPDATES = 2", code, flags=re.MULTILINE)
    code = re.sub(r"^ROVERS = \d+", "ROVERS = 2", code, flags=re.MULTILINE)
    return re.sub(r"\bnum_envs=(48|64|4096)\b", "num_envs=6", code)


@pytest.fixture
def threads() -> Iterator[None]:
    """Gives PyTorch its number of threads back, which programs set."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("page", [pytest.param(page, id=name_of(page)) for page in PAGES])
@pytest.mark.usefixtures("own_registries", "capsys", "threads")
def test_python_blocks_of_pages(page: Path) -> None:
    """Blocks run one after another, as a reader would run them, apart from those that need a rover."""
    names: dict[str, Any] = {}
    for block in blocks(page.read_text(encoding="utf-8"), "python"):
        code = compile(shortened(block.code), f"{name_of(page)}:{block.line}", "exec")
        if not block.code.startswith(NEEDS) and "__main__" not in block.code:
            exec(code, names)
    if "viewer" in names:
        # It would drive its rovers beside all tests that follow.
        names["viewer"].close()


def first_program(page: str) -> str:
    """Returns the first program of a page in ``docs/``."""
    return blocks((ROOT / "docs" / page).read_text(encoding="utf-8"), "python")[0].code


def test_the_example_of_ppo_is_the_program_of_the_page() -> None:
    """The example has the lines of the page in their order. It adds headings and the learning curve."""
    lines = iter((EXAMPLES / "torchrl_ppo.py").read_text(encoding="utf-8").splitlines())
    assert [line for line in first_program("torchrl.md").splitlines() if line not in lines] == []


@pytest.mark.slow
@pytest.mark.usefixtures("threads")
def test_the_first_program_for_torchrl_learns(capsys: pytest.CaptureFixture[str]) -> None:
    code, count = re.subn(r"^UPDATES = \d+", "UPDATES = 12", first_program("torchrl.md"), flags=re.MULTILINE)
    assert count == 1
    exec(compile(code, "torchrl.md", "exec"), {})
    goals = [float(each) for each in re.findall(r"([\d.]+) goals per", capsys.readouterr().out)]
    assert len(goals) == 12
    assert sum(goals[:4]) / 4 < 1
    assert sum(goals[-2:]) / 2 > 3


@pytest.mark.slow
def test_python_blocks_that_start_processes(tmp_path: Path) -> None:
    found = [block.code for page in PAGES for block in blocks(page.read_text(encoding="utf-8"), "python")]
    scripts = [code for code in found if "__main__" in code]
    script = tmp_path / "script.py"
    # Forked, which does not import the package in each process again.
    start = "import torch, torchrl.collectors\ntorch.multiprocessing.set_start_method('fork', force=True)\n"
    script.write_text(start + "\n".join(scripts))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("(") >= len(scripts) >= 2


@pytest.mark.parametrize(
    ("name", "constants", "expected"),
    [
        ("gymnasium_drive.py", {"ROVERS": 4}, r"^goal reached after \d(.|\n)*4 rovers reached"),
        ("lidar_scan.py", {}, ""),
        ("cameras.py", {}, ""),
        # The gate and the posts, not the ground alone, and a way out ahead.
        ("own_world.py", {}, r"^([6-9]\d|1[01]\d) of 128 beams"),
        ("import_map.py", {"EPISODES": 1}, r"16 boxes(.|\n)*anywhere: 1 of 1 goals"),
        ("own_robot.py", {"STEPS": 20}, r"^scout: 1\.00 m/s"),
        ("own_reward.py", {"STEPS": 60}, ""),
        ("evaluate_policies.py", {"EPISODES": 2}, r"anywhere: 2 of 2 goals"),
        ("torchrl_ppo.py", {"UPDATES": 2, "ROVERS": 2}, "256 steps"),
        ("sb3_sac.py", {"STEPS": 64, "ROVERS": 2, "EPISODE": 20}, "of 2 rovers reached a goal"),
        ("sweep.py", {"TRIALS": 1, "STEPS": 1_000, "EPISODES": 1, "SECONDS": 1}, "best: trial 0, success"),
        pytest.param("deploy_policy.py", {"STEPS": 20}, r"m from the goal after 1\.0 s", marks=pytest.mark.slow),
        pytest.param(
            "fine_tuning.py", {"EPISODES": 1, "STEPS": 1_000, "SECONDS": 1}, "fine-tuned: ", marks=pytest.mark.slow
        ),
    ],
)
@pytest.mark.usefixtures("threads")
def test_programs_of_the_gallery(
    name: str,
    constants: dict[str, int],
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They run with other values of their constants, draw what they have found, and print it."""
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    monkeypatch.chdir(tmp_path)
    code = (EXAMPLES / name).read_text(encoding="utf-8")
    for constant, value in constants.items():
        code, count = re.subn(rf"^{constant} = \d[\d_]*", f"{constant} = {value}", code, flags=re.MULTILINE)
        assert count == 1, constant
    exec(compile(code, name, "exec"), {})
    figures = len(plt.get_fignums())
    plt.close("all")
    assert re.search(expected, capsys.readouterr().out, re.MULTILINE)
    assert figures or name == "sb3_sac.py"


def test_the_notebook_runs_from_its_first_cell_to_its_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its outputs are left out of the repository. Only the installation is not run here."""
    monkeypatch.chdir(tmp_path)
    cells = json.loads((EXAMPLES / "colab.ipynb").read_text(encoding="utf-8"))["cells"]
    programs = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all((cell["outputs"], cell["execution_count"]) == ([], None) for cell in programs)
    install, *others = programs
    assert install["metadata"]["tags"] == ["install"]
    shown: list[str] = []
    stand_in = SimpleNamespace(Image=lambda filename: filename, display=shown.append)
    monkeypatch.setitem(sys.modules, "IPython.display", stand_in)
    code = "".join("".join(cell["source"]) + "\n" for cell in others)
    for line, tiny in {
        "num_envs=64": "num_envs=2",
        "rollout(100": "rollout(3",
        "MINUTES, ROVERS = 2, 512": "MINUTES, ROVERS = 1e-6, 16",
        "seed=0)\nsummary": "rollout_length=4, minibatch=16, epochs=1, seed=0)\nsummary",
        "EPISODES, SECONDS = 64, 30.0": "EPISODES, SECONDS = 2, 0.2",
        "FILMED = 16.0": "FILMED = 0.2",
    }.items():
        assert code.count(line) == 1, line
        code = code.replace(line, tiny)
    exec(compile(code, "colab.ipynb", "exec"), {})
    assert [Path(picture).name for picture in shown] == ["test_curve.png", "film.gif"]
    assert all(Path(picture).stat().st_size > 1000 for picture in shown)


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.name) for path in sorted((EXAMPLES / "other_libraries").glob("*.py"))]
)
def test_programs_for_other_libraries_use_what_exists(path: Path) -> None:
    """Their libraries are not installed here: what they import from this package exists, and a page shows them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "rover_rl":
            assert hasattr(import_module("rover_rl"), node.attr)
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("rover_rl"):
            assert all(hasattr(import_module(node.module), each.name) for each in node.names)
    assert "rover_rl" in ast.unparse(tree)
    assert path.name in (ROOT / "docs" / "gymnasium.md").read_text(encoding="utf-8")


def test_the_environment_for_rsl_rl_resets_rovers_whose_episode_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """The library is not installed here: its base class has no behavior, and its runner steps the environment."""
    taken = []

    class Runner:
        def __init__(self, envs: Any, settings: Any, **_: Any) -> None:
            self.envs, self.groups = envs, settings["obs_groups"]

        def learn(self, updates: int, **_: Any) -> None:
            self.envs.episode_length_buf = torch.tensor([self.envs.max_episode_length - 2, 0])
            for _ in range(3):
                observations, rewards, dones, extras = self.envs.step(torch.zeros(2, 2))
                assert (observations[self.groups["actor"][0]].shape, rewards.shape) == ((2, 41), (2,))
                taken.append((dones.tolist(), extras["time_outs"].tolist(), self.envs.episode_length_buf.tolist()))

    library = {
        "rsl_rl": {},
        "rsl_rl.env": {"VecEnv": type("VecEnv", (), {})},
        "rsl_rl.runners": {"OnPolicyRunner": Runner},
    }
    for name, attributes in library.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**attributes))
    monkeypatch.setattr(sys, "argv", ["rsl_rl_ppo.py"])
    code = (
        (EXAMPLES / "other_libraries" / "rsl_rl_ppo.py")
        .read_text(encoding="utf-8")
        .replace("ROVERS = 256", "ROVERS = 2")
    )
    exec(compile(code, "rsl_rl_ppo.py", "exec"), {})
    no, ended = [False, False], [True, False]
    assert taken == [(no, no, [499, 1]), (ended, ended, [0, 2]), (no, no, [1, 3])]
