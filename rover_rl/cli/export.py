"""``rover-rl export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass(frozen=True)
class Export:
    """Export a trained policy for machines without TorchRL, and compare it with the original on 1,000 observations."""

    policy: tyro.conf.Positional[str]
    """Folder of a run, a checkpoint, or pretrained:NAME."""
    format: Literal["onnx", "torch"] = "onnx"
    """Format: onnx, or torch (a torch.export program)."""
    out: Path | None = None
    """File to write. Default: the policy's name with .onnx or .pt2."""

    def __call__(self) -> int:
        """Exports, and prints the largest difference."""
        from rover_rl.algos.deploy.export import SUFFIXES, export
        from rover_rl.cli.policies import load_checkpoint

        checkpoint, name = load_checkpoint(self.policy)
        out = self.out or Path(name).with_suffix(SUFFIXES[self.format])
        difference = export(checkpoint, out, self.format)
        print(f"{out}: acts as {self.policy} does, to {difference:.1g}, on 1,000 observations")
        return 0
