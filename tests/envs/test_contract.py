"""Helpers that tests of the backends import from here. The tests of the contract are in ``tests/envs/contract``."""

from __future__ import annotations

from tests.envs.contract.witness import check_witnessed, witness

__all__ = ["check_witnessed", "witness"]
