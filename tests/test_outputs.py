"""Files: no command writes over one that rover-rl did not make, each writes over its own, and all of it or nothing."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rover_rl import Terrain, World
from rover_rl.algos.config import training_config
from rover_rl.algos.evaluation.report import write_rows
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import make_actor
from rover_rl.cli import main
from rover_rl.files import MADE_BY, check_outputs, errors_name, write_json, written_whole
from tests.algos.benchmarks.mini import write_barn_folder
from tests.full_disk import largest_file

MAP = "image: lab.png\nresolution: 0.1\norigin: [-3, -3, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
EPISODES = ["--world", "maze", "--count", "2", "--seconds", "0.2"]
FILM = ["film", "scripted", "--world", "maze", "--seconds", "0.1", "--width", "64", "--height", "48"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a map of ROS, worlds, a trained policy with an evaluation, and what benchmarks read."""
    monkeypatch.chdir(tmp_path)
    walls = np.full((60, 60), 254, np.uint8)
    walls[[0, -1]] = walls[:, [0, -1]] = 0
    Image.fromarray(walls).save("lab.png")
    Path("lab.yaml").write_text(MAP)
    World("hall", Terrain.flat((8.0, 8.0))).save("hall.world.npz")
    config = training_config("ppo", world="maze", hidden=(8,))
    checkpoint = Checkpoint(config=config, steps=0, actor=make_actor(hidden=(8,)).state_dict())
    checkpoint.save(tmp_path / "runs" / "small" / "checkpoint.pt")
    write_barn_folder(tmp_path / "barn")
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], line: list[str], path: Path) -> str:
    """Runs a command that must not write a file of someone else, and returns what it says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = b"\x89PNG of a person" if path.suffix == ".png" else b"policy,notes of a person\n"
    path.write_bytes(content)
    before = {*path.parent.iterdir()}
    assert main(line) == 2
    told = capsys.readouterr()
    assert path.read_bytes() == content
    assert {*path.parent.iterdir()} == before
    (line,) = told.err.splitlines()
    return line


OUTPUTS = [
    (["calibrate", "drive.mcap"], "runs/calibration/calibration.yaml"),
    (["worlds", "import", "lab.yaml"], "lab.world.npz"),
    (["worlds", "show", "maze:7"], "maze-7.world.png"),
    (["worlds", "--world", "maze", "moon"], "worlds/moon.png"),
    (["robots", "show", "leo"], "leo.robot.png"),
    (["export", "runs/small"], "small.onnx"),
    ([*FILM, "--out", "film.gif", "--rewards", "rewards.png"], "rewards.png"),
    ([*FILM, "--html", "page.html"], "page.html"),
    (["play", "scripted", "--world", "maze", "--seconds", "0.1"], "runs/play/scripted-maze.gif"),
    (["evaluate", "scripted", *EPISODES, "--html", "page.html"], "page.html"),
    (["evaluate", "runs/small", *EPISODES], "runs/small/evaluation.json"),
    (
        ["evaluate", "scripted", *EPISODES, "--backend", "bullet", "warp", "--imperfect", "late"],
        "runs/evaluation/paths-warp-late.png",
    ),
    (["compare", "runs/small"], "runs/comparison/comparison.csv"),
    (["benchmark", "barn", "scripted", "--data", "barn", "--worlds", "all"], "runs/benchmark-barn/worst-scripted.png"),
    (["drive", "scripted", "--goal", "1", "0", "--world", "maze", "--bag", "drive.mcap"], "drive.mcap"),
]


@pytest.mark.parametrize(("line", "output"), OUTPUTS, ids=[output for _, output in OUTPUTS])
def test_a_command_does_not_touch_a_file_that_it_did_not_make(
    capsys: pytest.CaptureFixture[str], folder: Path, line: list[str], output: str
) -> None:
    told = refused(capsys, line, folder / output)
    assert told.startswith(f"rover-rl: {output} is ")
    assert "--force" in told or "name another --bag" in told


def test_failures_are_not_filmed_over_a_file_of_someone_else(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    assert main(["evaluate", "runs/small", *EPISODES]) == 0
    line = ["film", "runs/small", "--failures", "--out", "film.gif", "--width", "64", "--height", "48"]
    assert "film-1.gif is there already" in refused(capsys, line, folder / "film-1.gif")
    assert not (folder / "film-0.gif").exists()


def test_a_training_takes_no_folder_that_is_there(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    told = refused(capsys, ["train", "--name", "small", "--total-steps", "64"], folder / "runs/small/progress.csv")
    assert "there is a run runs/small already" in told


def test_inputs_are_not_outputs_however_they_are_spelled(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    (folder / "link.world.npz").symlink_to("hall.world.npz")
    (folder / "here").symlink_to(folder)
    content = (folder / "hall.world.npz").read_bytes()
    for out in ("hall.world.npz", str(folder / "hall.world.npz"), "link.world.npz", "here/hall.world.npz"):
        assert main(["worlds", "import", "hall.world.npz", "--out", out]) == 2
        assert f"{out} is read by this command" in capsys.readouterr().err
    assert main(["export", "runs/small", "--out", "runs/small/checkpoint.pt"]) == 2
    assert main([*FILM, "--out", "film.gif", "--rewards", "./film.gif"]) == 2
    assert (folder / "hall.world.npz").read_bytes() == content
    Checkpoint.load(folder / "runs" / "small")


@pytest.mark.parametrize(
    "line",
    [
        ["worlds", "import", "lab.yaml"],
        *(["worlds", "show", "maze", "--out", f"maze.{kind}"] for kind in ("pdf", "svg")),
        [*FILM, "--out", "film.gif", "--rewards", "rewards.png"],
        ["evaluate", "scripted", *EPISODES, "--world", "maze:10000-10001"],
    ],
    ids=" ".join,
)
def test_the_same_command_works_twice(folder: Path, line: list[str]) -> None:
    before = {*folder.rglob("*")}
    assert main(line) == 0
    assert {path for path in folder.rglob("*") if path.is_file()} > {path for path in before if path.is_file()}
    assert main(line) == 0


def test_links_and_devices_are_not_replaced(folder: Path) -> None:
    (folder / "nowhere.gif").symlink_to("not-there.gif")
    os.mkfifo("pipe.gif")
    for name in ("nowhere.gif", "pipe.gif", os.devnull):
        with pytest.raises(FileExistsError, match="did not make it"):
            check_outputs(Path(name))


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.jpg", "a.webp"])
def test_pictures_carry_the_mark_and_stay_what_they_are(tmp_path: Path, name: str) -> None:
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 9, (40, 50, 3), np.uint8))
    picture.save(tmp_path / f"plain-{name}")
    with written_whole(tmp_path / name) as temporary:
        picture.save(temporary)
    shown, plain = Image.open(tmp_path / name), Image.open(tmp_path / f"plain-{name}")
    assert (np.asarray(shown.convert("RGB")) == np.asarray(plain.convert("RGB"))).all()
    if name != "a.webp":
        check_outputs(tmp_path / name)
    else:
        # The mark has no place in other formats.
        with pytest.raises(FileExistsError, match="--force"):
            check_outputs(tmp_path / name)


def test_tables_and_json_are_known_by_their_mark_and_not_by_their_names(tmp_path: Path) -> None:
    write_rows(tmp_path / "runs.csv", [{"run": "a, b", "success": 0.5}, {"run": "c"}])
    write_json(tmp_path / "runs.json", {**MADE_BY, "runs": 2})
    check_outputs(tmp_path / "runs.csv", tmp_path / "runs.json")
    assert (tmp_path / "runs.csv").read_bytes() == b'"run",success\r\n"a, b",0.5\r\nc,\r\n'
    for name, text in {"runs.csv": "run,success\na,0.5\n", "runs.json": json.dumps({"runs": 2})}.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(FileExistsError, match=f"{name} is there already"):
            check_outputs(tmp_path / name)
    # As spreadsheets and R write them: all names quoted.
    (tmp_path / "runs.csv").write_text('"run","success"\n"a",0.5\n')
    with pytest.raises(FileExistsError):
        check_outputs(tmp_path / "runs.csv")


# Files are written whole, and errors name them


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    path.write_text("old")

    def fail() -> None:
        with written_whole(path) as temporary:
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_write_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "data.json"
    with largest_file(10), pytest.raises(OSError, match="too large") as failure:
        write_json(path, [*range(1000)])
    assert failure.value.filename == str(path)
    with pytest.raises(IsADirectoryError) as is_folder:
        write_json(tmp_path, [])
    assert is_folder.value.filename == str(tmp_path)
    # A file in the place of a folder is named as it is.
    path.touch()
    with pytest.raises(OSError, match=r"data\.json'$"):
        write_json(path / "more.json", [])
    assert [*tmp_path.iterdir()] == [path]


def test_other_errors_are_unchanged(tmp_path: Path) -> None:
    other = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "elsewhere")
    for error in (ConnectionError("no cluster"), other):
        with pytest.raises(OSError) as raised, errors_name(tmp_path):
            raise error
        assert raised.value is error
