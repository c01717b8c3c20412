"""Physics tests specific to Bullet. Tests for every simulator are in ``tests/sims/test_physics.py``."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World

ROVER = get_robot("rover_zero")


def test_a_link_with_several_collision_shapes_raises(tmp_path):
    shape = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"
    urdf = tmp_path / "rover.urdf"
    urdf.write_text(ROVER.urdf.read_text().replace("</link>", f"{shape}</link>", 1))
    with pytest.raises(ValueError, match=r"rover\.urdf: a link may have one collision shape, link -1 has 2"):
        make_simulator("bullet", worlds=[World("flat", Terrain.flat((40, 40)))], robot=replace(ROVER, urdf=urdf))
