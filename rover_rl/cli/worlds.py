"""The command ``rover-rl worlds``."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import tyro

from rover_rl.checks import check_seed
from rover_rl.cli.options import Force, OptionsOfRobot
from rover_rl.files import check_outputs, written_whole
from rover_rl.option_names import options_of_command
from rover_rl.robots.options import RobotOptions, with_options

if TYPE_CHECKING:
    from rover_rl.worlds import World

MANY_MOVERS = 5.0  # number of movers per 100 m^2 above which many episodes end in a contact, in rooms with doors


@dataclass(frozen=True)
class ImportWorld:
    """Import a world from a file, tell what was understood, and save it as a world file.

    FILE is an SDF world or model (.sdf, .world), a mesh (.obj, .stl, .dae, .glb, .gltf, .ply), a ROS map (.yaml), or
    an elevation model (.tif, .png, .npy). docs/world_files.md describes the options.
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """File to import."""
    out: Path | None = None
    """World file to write, whose name ends in .world.npz. Default: FILE's name with this ending, in this folder."""
    force: Force = False
    name: str | None = None
    """Name of the world. Default: that in the file, else the file's name."""
    spawn: tuple[float, ...] | None = None
    """Area of starts: x y (the ground there), x_low x_high y_low y_high, or corners of a polygon, m. Default: found."""
    goal: tuple[float, ...] | None = None
    """Area of the goals, in the same forms. Default: the spawn area."""
    bounds: tuple[float, float, float, float] | None = None
    """Area whose exit ends the episode: x_low x_high y_low y_high, m. Default: automatic."""
    cell: float | None = None
    """Spacing of the ground's grid, m. Default: that of the data; for meshes, as fine as 1 cm of error takes."""
    missing: Literal["error", "skip"] = "error"
    """What happens with models and meshes that are not found."""
    model_paths: tuple[str, ...] = ()
    """Folders with models, before those of GZ_SIM_RESOURCE_PATH and GAZEBO_MODEL_PATH."""
    visuals: bool = True
    """Take the visual geometry of links that have no collision geometry."""
    ground: str = "auto"
    """Parts of a mesh or SDF file that are ground: auto, none, or patterns such as "terrain*,floor"."""
    up: Literal["auto", "x", "y", "z"] = "auto"
    """Axis of a mesh file that points up. Default: that of the format (glTF: y, COLLADA: in the file, else z)."""
    scale: float = 1.0
    """Factor from the lengths of a mesh file to meters."""
    obstacle_error: float = 0.02
    """Accepted distance between an obstacle and the convex solids in its place, m."""
    pixel: float | None = None
    """Size of a pixel of an elevation image or array, m. Default: that of the GeoTIFF."""
    height: float | None = None
    """Elevation of white in an 8 or 16 bit image, m."""
    unknown: Literal["open", "wall", "free"] = "open"
    """Meaning of the unknown cells of a map: no wall, but not in the automatic areas; wall; or free."""
    wall_height: float = 2.0
    """Height of the walls of a map, m."""

    def __call__(self) -> int:
        from rover_rl.worlds import World

        out = self.out or Path(f"{self.file.name.partition('.')[0]}.world.npz")
        check_outputs(out, inputs=[self.file], force=self.force)
        with warnings.catch_warnings(), options_of_command(""):
            # The notes of the world say the same.
            warnings.simplefilter("ignore", UserWarning)
            world = World.from_file(self.file, **self._options())
        world.save(out)
        print(_description(world))
        print(f"saved as {out}; look at it with: rover-rl worlds show {out}")
        return 0

    def _options(self) -> dict[str, Any]:
        options = {
            item.name: getattr(self, item.name) for item in fields(self) if item.name not in ("file", "out", "force")
        }
        for name, argument in {"spawn": "spawn_range", "goal": "goal_range", "bounds": "bounds"}.items():
            options[argument] = _place(name, options.pop(name))
        return options


@dataclass(frozen=True)
class ShowWorld:
    """Draw a world: ground, obstacles, free space, and a start and a goal with the shortest path."""

    file: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WORLD")]
    """World to draw: a file, a name, or module:attribute."""
    out: Path | None = None
    """Picture to write. Default: the world's name with .world.png, in this folder."""
    force: Force = False
    robot: str = "rover_zero"
    """Robot whose free space is drawn: a name, a URDF file, or module:attribute."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    seed: int = 0
    """Seed of the start and the goal."""

    def __call__(self) -> int:
        from rover_rl.robots import get_robot
        from rover_rl.sims.free_space.draw import draw_task
        from rover_rl.worlds import get_world

        # A map is often a pair of files such as lab.yaml and lab.png.
        out = self.out or Path(f"{Path(self.file).name.partition('.')[0].replace(':', '-')}.world.png")
        check_outputs(out, inputs=[self.file, self.robot], force=self.force)
        robot, world = get_robot(with_options(self.robot, self.robot_options)), get_world(self.file)
        with written_whole(out) as temporary:
            length = draw_task(world, robot, check_seed(self.seed), temporary)
        print(_description(world))
        way = f"{length:.1f} m" if math.isfinite(length) else "none"
        print(f"shortest path from a start to a goal: {way}; drawn in {out}")
        return 0


@dataclass(frozen=True)
class Worlds:
    """List the worlds and draw a map of each. Subcommands import a world from a file, and show it."""

    world: tuple[str, ...] = ()
    """Worlds to draw, by name, as module:attribute, or as a file. Default: all registered worlds."""
    robot: str = "rover_zero"
    """Robot whose free space is drawn: a name, a URDF file, or module:attribute."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    out: Path = Path("worlds")
    """Folder to write the maps to."""
    force: Force = False
    action: Annotated[
        Union[  # noqa: UP007
            Annotated[None, tyro.conf.subcommand("list", prefix_name=False)],
            Annotated[ImportWorld, tyro.conf.subcommand("import", prefix_name=False)],
            Annotated[ShowWorld, tyro.conf.subcommand("show", prefix_name=False)],
        ],
        tyro.conf.arg(name=""),
    ] = field(default=None)
    """Import a world from a file, or show it. Default: list and draw worlds."""

    def __call__(self) -> int:
        if self.action is not None:
            return self.action()
        from rover_rl.robots import get_robot
        from rover_rl.sims.free_space.draw import draw_world
        from rover_rl.sims.free_space.fitting import fitting_worlds
        from rover_rl.worlds import get_world, world_names

        robot = get_robot(with_options(self.robot, self.robot_options))
        names = [*dict.fromkeys(fitting_worlds(name, robot) for name in self.world or world_names())]
        files = [Path(name).name.removesuffix(".npz").replace(":", "-").replace("*", "x") for name in names]
        paths = [self.out / f"{file}.png" for file in files]
        check_outputs(*paths, inputs=[*names, self.robot], force=self.force)
        for name, path in zip(names, paths, strict=True):
            world = get_world(name)
            with written_whole(path) as temporary:
                draw_world(world, robot, temporary)
            width, depth = (f"{high - low:.0f}" for low, high in world.spawn_range)
            print(f"{name:8} {len(world.obstacles):3} obstacles, start area {width} x {depth} m: {path}")
        return 0


def _place(name: str, numbers: tuple[float, ...] | None) -> Any:
    if numbers is None:
        return None
    if len(numbers) < 2 or len(numbers) % 2:
        raise ValueError(f"--{name} takes 2 numbers (a point), 4 (a rectangle) or an even number from 6 (a polygon)")
    pairs = [*zip(numbers[::2], numbers[1::2], strict=True)]
    return pairs[0] if len(pairs) == 1 else pairs


def _description(world: World) -> str:
    from rover_rl.envs.sensors.standard import clipped_pose
    from rover_rl.worlds.generators.crowds import ground_of_episodes

    terrain = world.terrain
    (x_low, x_high), (y_low, y_high) = world.bounds
    lowest, highest = (float(end) for end in terrain.heights.aminmax())
    density = 100 * len(world.movers) / ground_of_episodes(world)
    many = ", which is many (docs/movers.md)" if density > MANY_MOVERS else ""
    dense = f" ({density:.1f} per 100 m^2 where episodes start and end{many})" if world.movers else ""
    lines = [
        f"{world.name}: {len(world.obstacles)} obstacles, {len(world.movers)} movers{dense}",
        f"  ground: {lowest:.2f} to {highest:.2f} m high, cell {terrain.cell:.3g} m",
        f"  bounds: x {x_low:.1f} to {x_high:.1f} m, y {y_low:.1f} to {y_high:.1f} m",
    ]
    areas = (("start", world.spawn_range, world.spawn_region), ("goal", world.goal_range, world.goal_region))
    for name, ((left, right), (bottom, top)), region in areas:
        part = f", of which {region.area:.0f} m^2" if region else ""
        lines.append(f"  {name} area: x {left:.1f} to {right:.1f} m, y {bottom:.1f} to {top:.1f} m{part}")
    return "\n".join([*lines, *(f"  {note}" for note in (*world.notes, *clipped_pose(world)))])
