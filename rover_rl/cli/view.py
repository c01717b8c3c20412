"""The command ``rover-rl view``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rover_rl.algos.policy.names import RANDOM, resolve_policy
from rover_rl.checks import MAX_ROVERS, check_at_least, check_seed
from rover_rl.cli.options import BACKEND, ONE_POLICY, EnvOptions, Host, Port, is_bag
from rover_rl.cli.replays import drives_of_bag, drives_of_evaluation
from rover_rl.sims.ros2.settings import BAG, BagTopics

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.evaluate import Policy
    from rover_rl.view.replay import ReplayPage
    from rover_rl.view.viewer import Viewer

_HELP = f"{ONE_POLICY} A run may still be training. Or a bag ({BAG}), of rover-rl drive or ROS 2, to replay."
_POLICY = tyro.conf.arg(metavar="POLICY", help=_HELP)


@dataclass(frozen=True)
class View:
    """Show rovers in a page of the browser: watch a policy, take the wheel, look inside, watch a run learn.

    The page is at the printed address, on this machine alone unless --host says otherwise. Over SSH, forward the port:
    ssh -L 8080:localhost:8080 MACHINE.
    """

    policy: Annotated[tyro.conf.Positional[str], _POLICY] = "pretrained:anywhere"
    world: str | None = None
    """World to drive in. Default: the one that the policy was trained in, or moon."""
    evaluation: Path | None = None
    """evaluation.json, or its folder: replays the episodes of the policy's evaluation, failures first."""
    rovers: int = 1
    """Number of rovers."""
    agents: int = 1
    """Number of rovers that share a world, in which they meet."""
    seed: int = 0
    """Seed of starts and goals."""
    host: Host = "127.0.0.1"
    port: Port = 8080
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = field(default_factory=EnvOptions)
    backend: Annotated[str | None, tyro.conf.arg(help=BACKEND.replace("bullet.", "warp."))] = None
    topics: BagTopics = field(default_factory=BagTopics)

    def __call__(self) -> int:
        check_at_least(1, MAX_ROVERS, rovers=self.rovers, agents=self.agents)
        check_seed(self.seed)
        # Says first if the extra is missing.
        from rover_rl.view.page import check_address

        check_address(self.host, self.port)
        viewer = self._open_replay() if is_bag(self.policy) or self.evaluation else self._open()
        print(f"Page: {viewer.address} (Ctrl-C ends it)", flush=True)
        try:
            viewer.wait()
        except KeyboardInterrupt:
            print("The viewer has ended.")
        finally:
            viewer.close()
        return 0

    def _open_replay(self) -> ReplayPage:
        from rover_rl.algos.evaluation.results import read_evaluation
        from rover_rl.view.replay import ReplayPage

        if is_bag(self.policy):
            from rover_rl.algos.deploy.recorded_drives import read_drives

            bag = read_drives(Path(self.policy), self.topics, self.world, self.environment.given_robot)
            drives = dict(drives_of_bag(bag))
        else:
            assert self.evaluation is not None
            policy = resolve_policy(self.policy, (), self.environment.robot)
            stored = read_evaluation(self.evaluation, policy.name, self.world, self.backend)
            drives = dict(drives_of_evaluation(policy, stored))
        return ReplayPage(drives, self.host, self.port)

    def _open(self) -> Viewer:
        from rover_rl.algos.experiments.runs import RunFiles
        from rover_rl.envs.make import make_env
        from rover_rl.view.viewer import Viewer

        run = RunFiles.find(Path(self.policy))
        word = self.policy if run is None else next(map(str, reversed(run.policies())), RANDOM)
        policy = resolve_policy(word, () if self.world is None else (self.world,), self.environment.robot)
        backend = self.backend or ("warp" if self.environment.env is None else None)
        described = self.environment.description(policy.module, backend)
        world = policy.worlds[0] if policy.worlds else "moon"
        config = replace(described, world=world, num_envs=self.rovers, agents=self.agents, seed=self.seed)
        page: dict[str, Any] = {"name": self.policy, "host": self.host, "port": self.port}
        return Viewer(
            make_env(replace(config, end_on_goal=False)), policy.module, find_policy=self._find, run=run, **page
        )

    def _find(self, name: str) -> Policy | None:
        return resolve_policy(name, (), self.environment.robot).module
