"""The command ``rover-rl export``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rover_rl.algos.policy.names import load_policy, policy_name
from rover_rl.cli.options import Force, OptionsOfRobot
from rover_rl.envs.sensors.suite import CONTACT_TIMES, MOVERS, ROUTE, VISITS
from rover_rl.files import check_outputs
from rover_rl.robots.options import RobotOptions, with_options


@dataclass(frozen=True)
class Export:
    """Export a trained policy to a file that runs without TorchRL.

    Compares the actions of the exported and the original policy on 1,000 random observations. The file holds the
    network alone: what is computed from several scans, such as route, is an input.
    """

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY")]
    """Policy: folder of a run, checkpoint file, or pretrained:NAME."""
    format: Literal["onnx", "torch"] = "onnx"
    """File format: onnx (needs the extra onnx), or torch (a torch.export program)."""
    robot: str | None = None
    """Robot that the file is for, of a policy that was made for several: a name, a URDF file, or module:attribute.
    Default: the robot that the policy was made for."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    out: Path | None = None
    """File to write. Default: the name of the policy with the suffix .onnx or .pt2."""
    force: Force = False

    def __call__(self) -> int:
        from rover_rl.algos.deploy.export import SUFFIXES, export

        suffix = SUFFIXES[self.format]
        if self.out is not None and self.out.suffix != suffix:
            raise ValueError(f"the name of a file of the format {self.format} must end in {suffix}, got {self.out}")
        checkpoint, name = load_policy(self.policy), policy_name(self.policy)
        if self.robot is not None:
            checkpoint = checkpoint.for_robot(with_options(self.robot, self.robot_options))
        out = self.out or Path(name).with_suffix(suffix)
        check_outputs(out, inputs=[self.policy], force=self.force)
        difference = export(checkpoint, out, self.format)
        print(f"{out}: acts as {self.policy} does, with a largest difference of {difference:.1g}")
        observed = checkpoint.config.network.observation
        if computed := ", ".join(key for key in (ROUTE, MOVERS, CONTACT_TIMES, VISITS) if key in observed):
            print(f"The file reads {computed} as input, which rover-rl drive {out} computes (docs/export.md).")
        return 0
