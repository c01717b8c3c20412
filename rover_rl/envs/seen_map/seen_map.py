"""``SeenMap``: what the lidars of a batch of rovers have seen, and the routes to their goals on it."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from rover_rl.envs.config import SCAN_POSE, LidarConfig
from rover_rl.envs.seen_map import scans
from rover_rl.envs.seen_map.scans import CELL, HALF, NUMBERS, SIZE, STATE
from rover_rl.envs.sensors.movers import belong_to_movers, movers_in_world
from rover_rl.envs.sensors.standard import WHOLE, Entries, seen_from_now, taken_at
from rover_rl.envs.sensors.suite import LIDAR_MASK, MOVERS
from rover_rl.robots.fleet import Fleet

# Distance from the body within which the ground is known to be free, as the rover stands there, m.
KNOWN = 0.2
MOVER_MARGIN = 0.1  # free distance between the side of the robot and a mover on a route, m
NO_BOUNDS = (-1e6, -1e6, 1e6, 1e6)  # area without bounds
ROWS_PER_THREAD = 16  # least number of rows for which a CPU thread pays


class SeenMap:
    """Maps of the obstacles that rovers have seen in their episodes, and the shortest routes on them.

    Each row has its own map: a window of 19.2 m around the rover, in cells of 0.15 m, which moves with it. The end of a
    beam marks a cell as occupied, and beams that pass through a cell clear it. What has not been seen counts as free,
    so that routes lead into the unknown if that may be shorter. Once its end has been seen, no route leads into a dead
    end any more.

    What the lidar does not see is found out by driving. Where the rover tilts by more than 24 degrees, the ground ahead
    uphill counts as occupied. If the rover does not get farther than half a meter in 8 s, the place 0.45 m ahead on its
    route does.

    The lidar scans in one plane, so that a gentle slope ahead looks like a wall. On rough ground, that is once the
    rover has tilted by more than 3 degrees in the episode, the end of a beam therefore marks a cell only if the ground
    rises to it by more than 24 degrees: on a level rover with the lidar at 0.32 m, within 0.72 m. At other ends, an
    obstacle is suspected: a route crosses them only if the detour around them is much longer. The rover itself and the
    ends of beams up to 3 m away also tell how high the ground is. Where two heights differ by more than a slope of 24
    degrees allows, the place between them counts as occupied for the rest of the episode.

    These lengths are for Rover Zero. For a robot that needs generated worlds with wider passages, all but the 24 and 3
    degrees grow by their scale: see :func:`~rover_rl.sims.free_space.fitting.passage_scale`.

    Directions that the lidar does not cover stay as they were: those outside of the robot's ``lidar_view``, and those
    that the observation's ``lidar_mask`` names, if it has one.

    What moves marks no cells, if the observation has ``movers``: see :class:`~rover_rl.envs.sensors.movers.Movers`. A
    cell is closed for one plan if a mover at constant velocity is there within 0.75 s of the time at which the rover
    could be, in the coming 4 s.

    The map needs a pose that does not jump, such as that of odometry. A scan that is older than the pose is added where
    it was taken, if the observation has ``scan_pose``: see :class:`~rover_rl.envs.sensors.standard.ScanPose`.

    Args:
        fleet: robots of the N rows, for their width and the position of their lidars. Its device is that of the
            observations.
        lidar: settings of the lidar.
        interval: time from one scan that is added to the next, s.

    Raises:
        ValueError: if the lidar is mounted too far from the robot's center.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> SeenMap(env.fleet, env.config.lidar)(env.reset()).shape
        torch.Size([2, 5])
    """

    def __init__(self, fleet: Fleet, lidar: LidarConfig, interval: float = 0.2) -> None:
        rows, device, cells = len(fleet), fleet.index.device, SIZE * SIZE
        self._fleet, self._points = fleet, lidar.points
        self._directions = scans.reading_directions(lidar).to(device)
        self._offset = 0.5 * lidar.points / lidar.beams  # half of a beam, in readings
        self._units = fleet.table(lambda robot: [scans.map_unit(robot)])
        self._readings = fleet.table(lambda robot: scans.reading_of(lidar, robot, interval))
        self._limits = fleet.table(scans.limits_of, torch.int32)
        # Distance from movers that robots keep, m, their speed, in cells per second, and the distance of the farthest
        # corner of the body from its center, m.
        self._sides = fleet.table(lambda robot: [robot.footprint.half_width + MOVER_MARGIN])
        self._speeds = fleet.table(lambda robot: [robot.drive.max_speed / (CELL * scans.map_unit(robot))])
        self._outer = fleet.table(lambda robot: [robot.footprint.corner])
        self._every = torch.ones(rows, dtype=torch.bool, device=device)
        self._unbounded = torch.tensor(NO_BOUNDS, device=device).repeat(rows, 1)
        self._state = torch.zeros(rows, sum(STATE), device=device)
        self._evidence = torch.zeros(rows, cells, dtype=torch.uint8, device=device)
        self._levels = torch.full_like(self._evidence, scans.OPEN)
        self._doubts = torch.zeros(rows, cells, dtype=torch.int16, device=device)
        self._boxes = torch.zeros(rows, cells, 4, dtype=torch.uint8, device=device)
        self._heights = torch.full((rows, cells), scans.UNSEEN, device=device)
        self._passed = torch.zeros_like(self._evidence)
        # What is in the cells, and the distances to that, in cells, once they are asked for.
        self._found, self._distances = self._passed[:, :0], self._heights[:, :0]
        # x and y of two corners, and of those along the whole route if they are kept, and the length.
        self._corners, self._path = torch.zeros(rows, 2, 2, device=device), torch.zeros(rows, 0, 2, device=device)
        self._lengths = torch.zeros(rows, device=device)
        self._memory: list[list[Tensor]] = []  # of searches for a route, one for each CPU thread

    def __call__(
        self,
        observation: Entries,
        rows: Tensor | None = None,
        renewed: Tensor | None = None,
        bounds: Tensor | None = None,
    ) -> Tensor:
        """Adds the scans of an observation to the maps and plans the routes to the goals.

        Args:
            observation: observation, ``[N]`` each, with ``lidar``, ``pose``, ``imu`` and ``target``, and with
                ``scan_pose`` if scans can be late, and ``lidar_mask`` if beams can be hidden.
            rows: rows whose scan is added, bool ``[N]``; ``None``: all. The maps of the others stay as they are.
            renewed: rows whose episode begins, bool ``[N]``. Their maps are cleared before.
            bounds: area that the routes stay in: lower x and y and upper x and y, ``[N, 4]``, m; ``None``: no bounds.

        Returns:
            Routes, float32 ``[N, 5]``: distance (m) and angle (rad, relative to the rover's heading) of the first and
            the second corner, and the length (m). The goal counts as a corner. In the length, a meter beside an
            obstacle counts more, up to ten. Without a path, both corners are the goal, and the length is -1.
        """
        rows = self._every if rows is None else rows.contiguous()
        if renewed is not None:
            self._state = self._state.masked_fill(renewed[:, None], 0.0)
        lidar, pose, imu, target = (observation[key] for key in ("lidar", "pose", "imu", "target"))
        if lidar.shape[-1] != self._points:
            raise ValueError(f"the map is made for {self._points} lidar readings, got {lidar.shape[-1]}")
        late, movers, unit = observation.get(SCAN_POSE, None), observation.get(MOVERS, None), self._unit
        at, attitude = taken_at(observation)
        place, goal = pose / unit, scans.goal_positions(pose / unit, imu, target[:, :1] / unit, target[:, 1:])
        readings, mask = self._readings[self._fleet.index], observation.get(LIDAR_MASK, None)
        scan, state = scans.read_scans(
            self._state, lidar / unit, place, imu, (at / unit, attitude), readings, self._directions, mask
        )
        ways = []
        if movers is not None:
            scan = scan._replace(hits=scan.hits & ~belong_to_movers(*self._points_of(lidar, late), movers))
            ways = [(place[:, :2] / CELL).contiguous(), self._ways_of(movers_in_world(movers, pose, imu))]
        bounds = self._unbounded if bounds is None else bounds.contiguous() / unit
        self._launch(scan, goal, bounds, rows, ways)
        self._state = torch.where(rows[:, None], torch.cat((state, self._corners[:, 0]), -1), self._state)
        return scans.relative_route(self._corners, self._lengths, place, imu, unit)

    @property
    def _unit(self) -> Tensor:
        return self._units[self._fleet.index]

    @property
    def cell(self) -> Tensor:
        """Size of a cell of each row's map, ``[N, 1]``, m."""
        return CELL * self._unit

    def corners(self) -> Tensor:
        """Returns the first and the second corner of the last routes in the frame of the pose, ``[N, 2, 2]``, m."""
        return self._corners * self._unit[..., None]

    def keep_paths(self, corners: int = 128) -> None:
        """Keeps the first corners of all routes from now on, for :meth:`paths`."""
        self._path = self._path.new_zeros(len(self._path), corners, 2)

    def paths(self) -> Tensor:
        """Returns the corners of the last routes in the frame of the pose, ``[N, corners, 2]``, m; then the goals."""
        return self._path * self._unit[..., None]

    def levels(self) -> tuple[Tensor, Tensor]:
        """Returns how far the cells are from obstacles.

        Returns:
            Levels, uint8 ``[N, rows, columns]``: 0 in cells with an obstacle or closed ones, 1 where the rover does not
            fit, 2 where it hardly fits or an obstacle is suspected, 3 where it should be slow, and 4 elsewhere. And x,
            y of the lower corner of cell ``[0, 0]`` of each row's window, float32 ``[N, 2]``, m.
        """
        levels = torch.where(self._doubts > 0, self._levels.clamp(max=scans.DOUBTFUL), self._levels)
        return self._in_window(levels), (self._state[:, :2].int() - HALF) * self.cell

    def known(self) -> Tensor:
        """Returns whether cells are free or occupied, bool ``[N, rows, columns]``; the others are unknown.

        They are if a beam has ended in them, or passed them or a cell beside them in the episode.
        """
        # Beams pass between the middles of cells.
        passed = max_pool2d(self._in_window(self._passed).float(), 3, 1, 1) > 0
        return passed | (self._in_window(self._evidence) > 0)

    def _in_window(self, values: Tensor) -> Tensor:
        """Returns values of cells by row and column of the window, ``[N, SIZE, SIZE]``."""
        lowest = self._state[:, :2].int() - HALF
        # A cell is stored at its number modulo the size.
        columns, rows = ((lowest[:, axis, None] + torch.arange(SIZE, device=lowest.device)) % SIZE for axis in range(2))
        address = rows[:, :, None] * SIZE + columns[:, None]
        return values.gather(1, address.flatten(1).long()).reshape(address.shape)

    def distances(
        self, observation: Entries, bounds: Tensor | None = None, rows: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Returns the distances to what has been seen until the ``observation`` that was added last.

        ``bounds`` and ``rows`` are those of a call. The distances of other rows stay as they are.

        Where the lidar does not see now, as behind a rover whose lidar sees ahead, a cell that no beam has passed in
        the episode counts as an obstacle, but for those within 0.2 m of the body, which stands there. So does what is
        out of bounds.

        Returns:
            Distances of the middles of the cells to the nearest obstacle, row by row, float32 ``[N, SIZE * SIZE]``, m,
            at most five cells. And x and y of the first of these points, and the spacing, float32 ``[N, 3]``, m.
        """
        from rover_rl.envs.seen_map.distance_kernels import find_distances, find_obstacles
        from rover_rl.native.warp import BLOCK_SIZE, launch_rows, wp

        if not self._found.shape[-1]:
            self._found, self._distances = torch.zeros_like(self._passed), torch.zeros_like(self._heights)
        center, readings, imu = self._state[:, :2].int(), self._readings[self._fleet.index], observation["imu"]
        mask, is_seen = observation.get(LIDAR_MASK, None), readings[:, NUMBERS:] > 0
        if mask is not None:
            is_seen = is_seen & (mask > WHOLE)
        mount = readings[:, :2] * self._unit
        lidar = observation["pose"][:, :2] + scans.in_world(mount[:, None], imu)[:, 0]
        near = (mount.norm(dim=-1, keepdim=True) + self._outer[self._fleet.index] + KNOWN) / self.cell
        places = torch.cat((lidar / self.cell, imu[:, 2:], near), -1)
        area = ((self._unbounded if bounds is None else bounds) / self.cell).contiguous()
        rows, split = self._every if rows is None else rows.contiguous(), (center.device, ROWS_PER_THREAD, BLOCK_SIZE)
        inputs = [rows, center, self._evidence, *(wp.from_torch(value, dtype=wp.vec4) for value in (area, places))]
        inputs += [is_seen, is_seen.all(-1), self._offset, self._passed, self._found]
        launch_rows(find_obstacles, self._found.shape, inputs, *split)
        inputs = [rows, center, self._boxes, self._found, self._found.view(torch.int64), self._distances]
        launch_rows(find_distances, (len(rows), SIZE), inputs, *split)
        return self._distances * self.cell, torch.cat(((center - HALF + 0.5) * self.cell, self.cell), -1)

    def _points_of(self, lidar: Tensor, scan_pose: Tensor | None) -> tuple[Tensor, Tensor]:
        ahead, left = (self._readings[:, :2] * self._units)[self._fleet.index].split(1, -1)
        return seen_from_now(ahead + lidar * self._directions[:, 0], left + lidar * self._directions[:, 1], scan_pose)

    def _ways_of(self, movers: Tensor) -> Tensor:
        """Returns position, velocity and radius of movers in the world (m) in cells, ``[N, COUNT, NUMBERS]``.

        Half of the robot's width and a margin are added to the radius, which is negative where there is no mover.
        """
        radius = torch.where(movers[..., 4] > 0, movers[..., 4] + self._sides[self._fleet.index], -1.0)
        return torch.cat((movers[..., :4], radius[..., None]), -1) / self.cell[..., None]

    def _launch(self, scan: scans.Scan, goals: Tensor, bounds: Tensor, rows: Tensor, ways: list[Tensor]) -> None:
        from rover_rl.envs.seen_map.route_kernels import close_ways, plan_routes
        from rover_rl.envs.seen_map.scan_kernels import add_scans
        from rover_rl.native.warp import launch_options, loading, run_together, shares_of, wp

        options = launch_options(rows.device)
        before, center = self._state[:, :2].int(), scan.center.int()
        limits = self._limits[self._fleet.index]
        limits, reaches = limits[:, :4].contiguous(), limits[:, 4].contiguous()
        inputs = [rows, before, center, *scan[1:], wp.from_torch(limits, dtype=wp.vec4i), reaches]
        inputs += [self._evidence, self._boxes, self._heights, self._levels, self._doubts, self._passed]
        crossed = [rows, center, *ways, self._speeds[self._fleet.index, 0], self._levels]
        plans = [goals, bounds, rows, center, self._levels, self._doubts]

        def launch(share: tuple[int, int], memory: list[Tensor]) -> None:
            first, last = share
            wp.launch(add_scans, last - first, [*inputs, first], **options)
            # Movers close cells for one plan only.
            if ways:
                wp.launch(close_ways, (last - first, ways[1].shape[1]), [*crossed, True, first], **options)
            planned = [*plans, *memory, self._corners, self._path, self._lengths, first, last]
            wp.launch(plan_routes, len(memory[0]), planned, **options)
            if ways:
                wp.launch(close_ways, (last - first, ways[1].shape[1]), [*crossed, False, first], **options)

        shares = shares_of(len(rows), rows.device, ROWS_PER_THREAD)
        if len(shares) > 1:
            # Else, each thread would compile the kernels.
            loading((str(options["device"]), None, (add_scans.module, plan_routes.module)))[0].result()
        self._memory += [self._new_memory() for _ in shares[len(self._memory) :]]
        run_together([partial(launch, *part) for part in zip(shares, self._memory[: len(shares)], strict=True)])

    def _new_memory(self) -> list[Tensor]:
        """Returns the memory of a CPU thread, which plans for one row after the other, or on a GPU that of all rows."""
        from rover_rl.envs.seen_map.route_kernels import BUCKETS, UNKNOWN_COST

        device, cells = self._levels.device, SIZE * SIZE
        rows, unknown = len(self._levels) if device.type == "cuda" else 1, int(UNKNOWN_COST)
        sizes = (cells, BUCKETS, cells, cells, cells)
        return [torch.full((rows, size), unknown, dtype=torch.int32, device=device) for size in sizes]
