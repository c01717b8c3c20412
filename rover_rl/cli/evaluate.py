"""The command ``rover-rl evaluate``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from rover_rl.algos.config_files import experiments
from rover_rl.algos.policy.names import NO_POLICY, PRETRAINED, ResolvedPolicy, resolve_policies
from rover_rl.cli.options import SEVERAL_POLICIES, EnvOptions, Force, Workers, is_bag
from rover_rl.cli.replays import check_page, write_worst
from rover_rl.envs.imperfections import check_imperfections, imperfect
from rover_rl.envs.parts import TASKS
from rover_rl.files import check_outputs
from rover_rl.registry import is_path
from rover_rl.robots import get_robots
from rover_rl.sims.backends import name_of
from rover_rl.sims.ros2.settings import BAG, BagTopics
from rover_rl.tasks.task import Task

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.episodes import EpisodeSet
    from rover_rl.algos.evaluation.evaluate import Request
    from rover_rl.algos.evaluation.results import Evaluation
    from rover_rl.algos.policy.runner import Policy
    from rover_rl.envs.config import EnvConfig

_OF_TASK = "The name of a task before them (rover-rl tasks) judges them in its test."
EXACT = "exact"  # name of exact sensors beside those of imperfections


class _Run(NamedTuple):
    """What is evaluated, with which imperfection, and in which picture its paths are drawn."""

    request: Request
    imperfection: str
    picture: Path | None = None


@dataclass(frozen=True)
class Evaluate:
    """Evaluate policies side by side on fixed start-goal pairs.

    Writes evaluation.json, evaluation.csv (a row for each episode), evaluation-summary.csv and plots of the paths.
    """

    policies: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="[TASK] POLICY ...", help=f"{SEVERAL_POLICIES} Also bags of drives ({BAG}). {_OF_TASK}"),
    ]
    world: tuple[str, ...] = ()
    """Worlds to drive in, or ranges of worlds such as maze:10000-10063. Seeds from 10000 up are for evaluation.
    Default: for each policy, the worlds that it was trained in; after training in a range, one that was not in it.
    Bags: the world that they name; the first one here for those that name none, and if no policy is named."""
    count: Annotated[int | None, tyro.conf.arg(aliases=["--episodes"])] = None
    """Number of episodes in each world. Of inspect, moon and maze, up to 256 are stored; others are newly drawn.
    Default: 256 in one world, 4 in each world of a range."""
    seed: int | None = None
    """Seed of newly drawn starts and goals. Default: use the stored ones."""
    seconds: float | None = None
    """Time limit of each episode, s. Default: 60, or 4 for each meter of the longest shortest path if that is more; and
    longer for a robot that is slower than 1 m/s or needs wider worlds."""
    action_repeat: int | None = None
    """Number of steps (50 ms) that each action is held for. Default: 1, for policies with memory that of training."""
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = field(default_factory=EnvOptions)
    backend: tuple[str, ...] = ()
    """Simulators: bullet, warp, mujoco (an extra), or module:attribute. Several are compared on the same episodes.
    Default: that of --env, else bullet."""
    imperfect: tuple[str, ...] = ()
    """Imperfections of sensors to drive with, too: late, jumps, odometry, noise, all (of these at half), typical or
    harsh (docs/randomization.md). They are compared with exact sensors on the same episodes."""
    agents: int | None = None
    """Number of rovers that drive at once in the same world, in which they see and push one another.
    Default: that of --env, else 1."""
    endless: bool = False
    """Also evaluate in endless mode: 32 episodes of 2,000 steps, as in the original environment."""
    jam: bool = True
    """In endless mode, end an episode after a long collision, as in the contract. The original never does."""
    columns: tuple[str, ...] = ()
    """Columns of the table: all, or names of metrics such as spl jerk (docs/evaluation.md).
    Default: success, clean, SPL, time, touched, where something moves also contacts with it and the least distance to
    it, and the endings that occur."""
    workers: Workers = None
    out: Path | None = None
    """Folder to write to. Default: the folder of the first checkpoint, or runs/evaluation."""
    html: Path | None = None
    """Page to write: up to 12 drives, the worst of each policy and usual ones, with a time slider, in one file that
    opens offline (needs the extra view)."""
    force: Force = False
    topics: BagTopics = field(default_factory=BagTopics)
    task: tyro.conf.Suppress[Any] = None
    """Task whose test it is."""

    def __call__(self) -> int:
        task, policies = split_task(self.policies)
        return self._evaluate() if task is None else self._of_task(task, policies)._evaluate()

    def _of_task(self, task: Task, policies: tuple[str, ...]) -> Evaluate:
        """Returns the command for the test of a task, whose settings are the defaults of the options."""
        if self.environment.env is not None:
            raise ValueError(f"--env is another environment than that of the task {task.name}: give one of them")
        return replace(
            self,
            task=task,
            policies=policies,
            world=self.world or task.test_env.world_names,
            count=self.count or task.episodes,
            seconds=self.seconds or task.seconds,
        )

    def _evaluate(self) -> int:
        from rover_rl.algos.evaluation.evaluate import check_options, evaluate_all, for_task
        from rover_rl.algos.evaluation.plots import draw_paths
        from rover_rl.algos.evaluation.report import check_columns, print_table, write_evaluation

        if self.html is not None:
            check_page(self.html)
            # Says first if the extra is missing.
            import_module("rover_rl.view")
        check_columns(self.columns)
        check_imperfections(self.imperfect)
        given = {"seconds": self.seconds, "action_repeat": self.action_repeat}
        check_options(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
        words = [word for word in self.policies if not is_bag(word)]
        driven = self._of_bags([Path(word) for word in self.policies if is_bag(word)], are_alone=not words)
        if not self.policies:
            raise ValueError(NO_POLICY)
        if self.html is not None and not words:
            raise ValueError(f"--html shows drives of policies; of a bag: rover-rl film BAG{BAG} --html {self.html}")
        robot = self.environment.given_robot or (self.task and self.task.test_env.robot)
        policies = resolve_policies(words, self.world, robot) if words else []
        if self.task is not None:
            policies = [replace(one, module=for_task(self.task, one.module)) for one in policies]
        backends = self._backends(policies)
        sets = self._episode_sets(policies)
        out = self.out or next((policy.folder for policy in policies if policy.folder), Path("runs/evaluation"))
        runs = self._runs(policies, sets, backends, out)
        of_bags = {out / f"paths-drives{f'-{k}' if k else ''}.png": [drives] for k, drives in enumerate(driven)}
        tables = [out / f"evaluation{part}" for part in (".json", ".csv", "-summary.csv", "-worlds.csv")]
        pictures = dict.fromkeys(run.picture for run in runs if run.picture is not None)
        written = [*tables, *pictures, *of_bags, *([self.html] if self.html else [])]
        # Fails before the evaluation, which can take minutes.
        check_outputs(*written, inputs=[*self.policies, *self.world], force=self.force)
        out.mkdir(parents=True, exist_ok=True)
        results = evaluate_all([run.request for run in runs], self.workers)
        results = [replace(result, imperfection=run.imperfection) for run, result in zip(runs, results, strict=True)]
        drawn: dict[Path, list[Evaluation]] = {}
        for run, result in zip(runs, results, strict=True):
            if run.picture is not None:
                drawn.setdefault(run.picture, []).append(result)
        drawn |= of_bags
        results += driven
        trained = {policy.name: policy.config for policy in policies if policy.config}
        try:
            write_evaluation(out / "evaluation.json", results)
            for picture, shown in drawn.items():
                draw_paths(shown, picture)
        finally:
            # Prints the results even if a file could not be written.
            groups = dict(zip(trained, experiments([*trained.values()]), strict=True))
            print_table(results, groups=groups, columns=self.columns)
        by_world = ", evaluation-worlds.csv" if any(episodes.several_worlds for episodes in sets.values()) else ""
        print(f"Results: {out / 'evaluation.json'}, evaluation.csv (episodes), evaluation-summary.csv{by_world}")
        print("Paths driven: " + ", ".join(map(str, drawn)))
        if self.html is not None:
            shown = [result for result in results if not result.endless and result.backend != "ros2"]
            count = write_worst(shown, policies, out / "evaluation.json", self.html)
            print(f"Replay of {count} drives: {self.html}")
        return 0

    def _of_bags(self, paths: list[Path], are_alone: bool) -> list[Evaluation]:
        if not paths:
            return []
        from rover_rl.algos.deploy.recorded_drives import evaluate_drives, read_drives

        world, robot = next(iter(self.world), None), self.environment.given_robot
        bags = [read_drives(path, self.topics, world if are_alone else None, robot) for path in paths]
        return evaluate_drives([bag._replace(world=bag.world or world) for bag in bags])

    def _backends(self, policies: list[ResolvedPolicy]) -> list[str | None]:
        """Returns the names of the backends to drive in; ``None`` is that of the environment.

        Tries several backends before the evaluation, which can take minutes in the first of them.
        """
        import torch

        from rover_rl.robots.fleet import Fleet
        from rover_rl.sims import make_simulator
        from rover_rl.worlds import Terrain, World

        names = [*dict.fromkeys(self.backend)]
        if len(names) > 1:
            world = World("flat", Terrain.flat((4.0, 4.0)))
            for name in names:
                env = self.environment.description(None, name)
                fleet = Fleet(get_robots(env.robot), torch.zeros(1, dtype=torch.int64))
                make_simulator(name, worlds=[world], robot=fleet, physics=env.preset).close()
                for policy in policies:
                    self.environment.description(policy.module, name)
        return [*names] or [None]

    def _env(self, policy: Policy | None, backend: str | None, imperfection: str = "") -> EnvConfig:
        from rover_rl.algos.evaluation.evaluate import test_env

        env = self.environment.description(policy, backend, self.task and test_env(self.task, policy))
        env = imperfect(env, imperfection) if imperfection else env
        return env if self.agents is None else replace(env, agents=self.agents)

    def _episode_sets(self, policies: list[ResolvedPolicy]) -> dict[str, EpisodeSet]:
        from rover_rl.algos.evaluation.episodes import choose_episodes
        from rover_rl.worlds import get_world
        from rover_rl.worlds.pool import WorldPool

        worlds = dict.fromkeys(world for policy in policies for world in policy.worlds)
        if not worlds and policies:
            raise ValueError("say which --world to drive in; these policies were trained in none")
        for world in worlds:
            get_world(WorldPool(world).source(0))
        trained = next((policy.module for policy in policies if policy.config), None)
        env = self._env(trained, next(iter(self.backend), None))
        choose = partial(choose_episodes, robot=env.robot, workers=self.workers, agents=env.agents)
        return {world: choose(world, self.count, self.seed) for world in worlds}

    def _runs(
        self, policies: list[ResolvedPolicy], sets: dict[str, EpisodeSet], backends: list[str | None], out: Path
    ) -> list[_Run]:
        from rover_rl.algos.evaluation.episodes import endless_episodes
        from rover_rl.algos.evaluation.evaluate import Request
        from rover_rl.algos.evaluation.plots import TRACE

        runs = []
        for world, episodes in sets.items():
            endless = []
            for policy, backend, name in product(policies, backends, ("", *dict.fromkeys(self.imperfect))):
                if world not in (policy.worlds or sets):
                    continue
                env = self._env(policy.module, backend, name)
                settings = {"name": policy.name, "action_repeat": self.action_repeat, "env": env}
                # The name of an environment with exact sensors is needed only beside others.
                imperfection = name or EXACT if self.imperfect else ""
                simulator = env.backend if isinstance(env.backend, str) else name_of(env.backend)
                parts = ("paths", len(sets) > 1 and world, len(backends) > 1 and simulator, imperfection)
                picture = "-".join(part for part in parts if part).replace(":", "-").replace("*", "x")
                options = {**settings, "seconds": self.seconds, "track_movers": TRACE}
                runs.append(_Run(Request(policy.module, episodes, options), imperfection, out / f"{picture}.png"))
                if self.endless:
                    again = endless_episodes(world, robot=env.robot)
                    endless.append(_Run(Request(policy.module, again, {**settings, "jam": self.jam}), imperfection))
            runs += endless
        return runs


def split_task(words: tuple[str, ...]) -> tuple[Task | None, tuple[str, ...]]:
    """Returns the task that the first word names, if it names one, and the other words.

    A word that is a file or folder is none, nor is the ``"module:attribute"`` of something else.
    """
    if not words or words[0].startswith(PRETRAINED) or Path(words[0]).exists():
        return None, words
    if words[0] in TASKS.names() or is_path(words[0]):
        found = TASKS.find(words[0])
        if isinstance(found, Task):
            return found, words[1:]
    return None, words
