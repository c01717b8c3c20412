"""Default control rate. Does not import PyTorch."""

from __future__ import annotations

CONTROL_DT = 0.05
"""Default duration of a control step, s: the control rate of the contract, 20 Hz.

``Simulator.control_dt`` is the value that a simulator uses.
"""
