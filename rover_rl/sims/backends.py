"""Simulators by name. Imports PyTorch and a simulator only when the simulator is built."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from inspect import isfunction, signature
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

from rover_rl.registry import Registry
from rover_rl.sims.settings import Connection, at_rate

if TYPE_CHECKING:
    import torch

    from rover_rl.robots import Robot
    from rover_rl.robots.fleet import Fleet
    from rover_rl.sims.base import Scanner, Simulator
    from rover_rl.worlds import World

BACKENDS: dict[str, str] = {
    "bullet": "rover_rl.sims.bullet:BulletSettings",
    "mujoco": "rover_rl.sims.mujoco:MujocoSettings",
    "ros2": "rover_rl.sims.ros2.settings:Ros2Settings",
    "warp": "rover_rl.sims.warp:WarpSettings",
}
"""Settings classes of the built-in backends, by name."""
_OPTIONS = {"ros2": ("connection",), "warp": ("device",)}
"""Arguments of :func:`make_simulator` that a built-in simulator takes besides the common ones."""

BackendLike: TypeAlias = Any
"""A backend: its name, its settings, or a :class:`Backend` object."""
_REGISTRY = Registry("backend", BACKENDS)
_MAKE = "make(worlds=, robot=, connection=, device=)"
_REQUIRED = "close control_dt device features live num_envs reset robot_connected state step".split()  # noqa: SIM905
"""Attributes of a simulator that every environment uses."""


@runtime_checkable
class Backend(Protocol):
    """Interface of a custom backend: an object, usually its settings, that builds the simulator.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class MySettings:
        ...     substeps: int = 20
        ...
        ...     def make(self, **arguments):
        ...         return make_simulator(BulletSettings(substeps=self.substeps), **arguments)
        >>> register_backend("mine", MySettings)
        >>> env = RoverEnv(backend="mine")
    """

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot | Fleet,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> Simulator:
        """Builds the simulator: see :func:`make_simulator`."""


def register_backend(name: str, backend: Any) -> None:
    """Registers a backend under a name, for ``RoverEnv``, ``EnvConfig`` and ``--backend``.

    The backend is a :class:`Backend` object, a class or function that makes one, or the ``"module:attribute"`` of any.
    Raises ``ValueError`` if the name is taken, or has other characters than letters, digits, ``_``, ``-`` and ``.``.
    """
    _REGISTRY.register(name, backend)


def backend_names() -> list[str]:
    """Names of all backends: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def find_settings(name: str) -> Any:
    """Returns the settings class of a backend, or a registered :class:`Backend`. Raises ``ValueError`` if unknown."""
    return _REGISTRY.find(name)


def name_of(backend: Any) -> str:
    """Name of the backend of a settings object, as :func:`find_settings` takes it."""
    path = f"{type(backend).__module__}:{type(backend).__qualname__}"
    return next((name for name, known in BACKENDS.items() if known == path), path)


def make_simulator(
    backend: BackendLike,
    *,
    worlds: Sequence[World],
    robot: Robot | Fleet,
    physics: str | None = None,
    connection: Connection | None = None,
    device: torch.device | None = None,
    control_rate: float | None = None,
) -> Simulator:
    """Builds a simulator.

    Args:
        backend: name in :func:`backend_names`, for a backend with its default settings; settings of a backend, for
            example ``BulletSettings(substeps=20)``; or a :class:`Backend`.
        worlds: world of each rover, N entries. Consecutive rovers in the same world share a simulation.
        robot: robot model, or a fleet with the robot of each rover, for backends with the feature ``"robots"``.
        physics: physics preset of a backend that is given by name. ``None``: the default settings.
        connection: topics of a real rover. ``None``: those of the contract.
        device: device of the task's tensors, on which the backend runs if it can. ``None``: the CPU.
        control_rate: control steps per second. ``None``: those of the backend's settings, 20 by default.

    Raises:
        ValueError: if the backend or the preset is unknown, it cannot simulate several robots, its settings have no
            ``control_dt`` to change, or the ``make`` of a :class:`Backend` does not take these arguments or returns
            something else than a simulator.
    """
    robots = getattr(robot, "robots", (robot,))
    if len(robots) == 1:
        (robot,) = robots
    settings = resolve_backend(backend, physics)
    if control_rate is not None:
        settings = at_rate(settings, control_rate)
    options: dict[str, Any] = {"connection": connection, "device": device}
    if isinstance(settings, Backend):
        return _make_custom(settings, {"worlds": worlds, "robot": robot, **options})
    name, simulator = name_of(settings), _simulator_of(settings)
    if len(robots) > 1 and "robots" not in simulator.features:
        problem = f"{simulator.__name__} does not have the feature 'robots'; use backend='warp', or name one robot"
        raise ValueError(f"several robots in one batch need a backend that simulates them: {problem}")
    return simulator(worlds, robot, settings, **{option: options[option] for option in _OPTIONS.get(name, ())})


def begin_loading(backend: BackendLike, physics: str | None, device: torch.device) -> None:
    """Begins to load what a simulator takes long to load, while its worlds are made, for :func:`make_simulator`."""
    settings = resolve_backend(backend, physics)
    if not isinstance(settings, Backend) and name_of(settings) == "warp":
        _simulator_of(settings).begin_loading(settings, device)


def _simulator_of(settings: Any) -> Any:
    name = name_of(settings)
    path = getattr(settings, "simulator", f"rover_rl.sims.{name}.simulator:{name.capitalize()}Simulator")
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def make_scanner(simulator: Simulator, worlds: Sequence[World], robot: Robot, beams: int) -> Scanner:
    """Creates the lidar of the rovers in a simulator: the simulator's own, or that of the Warp backend in their worlds.

    The robot carries it at its ``lidar_position``. The beams are equally spaced over a full turn.

    Example:
        >>> worlds, robot = [get_world("maze")], get_robot("rover_zero")
        >>> simulator = make_simulator("warp", worlds=worlds, robot=robot)
        >>> make_scanner(simulator, worlds, robot, beams=128).scan().shape
        torch.Size([1, 128])
    """
    if "lidar" in simulator.features:
        return simulator.scanner(beams)
    from rover_rl.sims.warp.plane_scanner import PlaneScanner
    from rover_rl.worlds.table import WorldTable

    return PlaneScanner(simulator, WorldTable.of(worlds, simulator.device), robot, beams)


def resolve_backend(backend: BackendLike, physics: str | None = None) -> Any:
    """Returns the settings of a backend, or the :class:`Backend`, without building a simulator.

    The arguments are those of :func:`make_simulator`. Raises ``ValueError`` if the backend or the preset is unknown.
    """
    if physics is not None and not isinstance(backend, str):
        raise ValueError(f"physics={physics!r} needs a backend given by name; this backend has settings of its own")
    settings = backend
    if isinstance(backend, str):
        settings = find_settings(backend)
        if physics is not None:
            if not hasattr(settings, "preset"):
                raise ValueError(f"backend {backend!r} has no presets for its physics, got physics={physics!r}")
            settings = settings.preset(physics)
        elif isinstance(settings, type) or isfunction(settings):
            settings = _REGISTRY.call(backend, settings)
    if not isinstance(settings, Backend) and name_of(settings) not in BACKENDS:
        source = f" under the name {backend!r}" if isinstance(backend, str) else ""
        wanted = (
            f"one of {backend_names()}, settings of one, or an object with a method {_MAKE} that returns a Simulator"
        )
        raise ValueError(f"backend must be {wanted}, got {settings!r}{source}")
    return settings


def _make_custom(backend: Backend, arguments: dict[str, Any]) -> Simulator:
    try:
        signature(backend.make).bind(**arguments)
    except TypeError as error:
        reason = "it is a class; pass an object of it" if isinstance(backend, type) else error
        raise ValueError(f"backend {backend!r} must have a method {_MAKE}: {reason}") from error
    simulator = backend.make(**arguments)
    if missing := ", ".join(name for name in _REQUIRED if not hasattr(simulator, name)):
        wanted = f"make() of backend {backend!r} must return a rover_rl.sims.Simulator"
        raise ValueError(f"{wanted}, got {simulator!r} without {missing}")
    return simulator
