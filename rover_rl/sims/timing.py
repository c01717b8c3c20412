"""The rate of control. Imports no PyTorch."""

from __future__ import annotations

CONTROL_DT = 0.05
"""Duration of a control step by default, s: the contract controls at 20 Hz. A simulator's own is ``control_dt``."""
