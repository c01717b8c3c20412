from __future__ import annotations

from benchmarks.stored import stored_policies, stored_worlds
from rover_rl.algos.pretrained import pretrained_names
from rover_rl.envs.config import EnvConfig


def test_ranges_count_as_the_stored_world_of_their_kind() -> None:
    assert stored_worlds(EnvConfig(world=("maze:0-99@0.2-0.8", "rooms:0-99", "moon", "maze:*"))) == ["maze", "moon"]
    # A world with a seed is another one than the stored one.
    assert stored_worlds(EnvConfig(world="maze:7")) == []


def test_every_pretrained_policy_but_that_for_hills_has_one() -> None:
    assert {*pretrained_names()} - {*stored_policies()} == {"hills-heights"}
