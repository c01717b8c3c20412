"""Planar lidar in a level world: the edges in view shorten the beams that they cross, from near to far."""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.warp.kernels.lidar import clip_beams, scan_of
from rover_rl.sims.warp.kernels.scan_plane import Scan
from rover_rl.sims.warp.kernels.types import RoverArrays
from rover_rl.sims.warp.planar.contacts import unturned
from rover_rl.sims.warp.planar.plan import Plan, cell_at
from rover_rl.sims.warp.planar.robots import PlanarRobot


@wp.func
def clip_edges(plan: Plan, scan: Scan, height: float):
    """Shortens the beams that meet every ``lanes``-th edge in view of a lidar at a height, m."""
    at = wp.vec2(scan.origin[0], scan.origin[1])
    ahead = wp.vec2(scan.ahead[0], scan.ahead[1])
    # Outside of the grid, all edges may be in view.
    cell = cell_at(plan.view, at[0], at[1])
    first = int(0)
    count = plan.edges.shape[0]
    if cell >= 0:
        first = plan.view_starts[cell]
        count = plan.view_starts[cell + 1] - first
    for k in range(scan.lane, count, scan.lanes):
        number = int(k)
        if cell >= 0:
            number = plan.view_edges[first + k]
        edge = plan.edges[number]
        span = plan.spans[number]
        a = unturned(wp.vec2(edge[0], edge[1]) - at, ahead)
        b = unturned(wp.vec2(edge[2], edge[3]) - at, ahead)
        # Seen from its free side, an edge goes clockwise.
        if a[0] * b[1] - a[1] * b[0] < 0.0 and span[0] < height and height < span[1]:
            clip_beams(scan, a, b)


@wp.kernel
def scan_planar(
    plans: wp.array[Plan],
    robots: wp.array[PlanarRobot],
    rovers: RoverArrays,
    beams: wp.array[wp.vec2],
    first: int,
    lanes: int,
):
    """One scan per rover that scans: see :func:`rover_rl.sims.warp.kernels.lidar.scan`."""
    t, lane = wp.tid()
    row = first + t
    if not rovers.scanned[row]:
        return
    if lanes == 1:
        for beam in range(beams.shape[0]):
            rovers.ranges[row, beam] = wp.inf
    plan = plans[rovers.scene[row]]
    share = scan_of(rovers, robots[rovers.robot[row]].model, beams, row, lane, lanes)
    clip_edges(plan, share, share.origin[2] - plan.ground)
