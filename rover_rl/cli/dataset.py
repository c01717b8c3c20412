"""The command ``rover-rl dataset``."""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import tyro

from rover_rl.sims.ros2.settings import BagTopics


@dataclass(frozen=True)
class Dataset:
    """Make a Minari data set of recorded drives, for offline reinforcement learning.

    It has the environment's transitions, with actions of the kind twist: the commands that the robot was sent. Read it
    with minari.MinariDataset("DIR/data") (needs the extra minari).
    """

    bags: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="BAG ...")]
    """Bags of rover-rl drive (MCAP files)."""
    out: Path
    """Folder to make, which ends in -v and a number, such as data/drives-v0."""
    world: str | None = None
    """World that the drives are in. Default: the one that the bags name, or flat ground without obstacles."""
    topics: BagTopics = field(default_factory=BagTopics)

    def __call__(self) -> int:
        if not self.bags:
            raise ValueError("name one or several bags of rover-rl drive")
        if not re.fullmatch(r"[-\w]+-v\d+", self.out.name):
            raise ValueError(f"--out must end in -v and a number, as in data/drives-v0, got {self.out}")
        if self.out.exists():
            raise FileExistsError(f"{self.out} is there already: name another --out")
        try:
            import h5py  # noqa: F401  (Minari writes with it)
            import minari
            from minari.data_collector.episode_buffer import EpisodeBuffer
        except ImportError as error:
            raise ImportError('data sets require the package minari: pip install "rover_rl[minari]"') from error
        from rover_rl.algos.deploy.recorded_drives import read_drives, transitions

        buffers, spaces = list[EpisodeBuffer](), dict[str, Any]()
        bags = [read_drives(path, self.topics, self.world) for path in self.bags]
        for env, episode in chain.from_iterable(map(transitions, bags)):
            spaces = {name: getattr(env, name) for name in ("observation_space", "action_space")}
            buffers.append(EpisodeBuffer(id=len(buffers), **episode))
        policies = ", ".join(sorted({bag.policy for bag in bags}))
        self.out.parent.mkdir(parents=True, exist_ok=True)
        os.environ["MINARI_DATASETS_PATH"] = str(self.out.parent)
        about = {"algorithm_name": policies, "description": "drives recorded by rover-rl drive"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of what is not said, such as an author
            minari.create_dataset_from_buffers(self.out.name, buffers, **spaces, **about)
        print(f"{self.out}: {len(buffers)} episodes, {sum(map(len, buffers))} steps")
        return 0
