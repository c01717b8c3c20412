"""Backends by name, and how a simulator is built from one. Imports no PyTorch and no simulator until one is built."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

from rover_rl.registry import Registry
from rover_rl.sims.connection import Connection

if TYPE_CHECKING:
    import torch

    from rover_rl.sims.base import Simulator
    from rover_rl.sims.robots import Robot
    from rover_rl.sims.worlds import World

BACKENDS: dict[str, str] = {
    "bullet": "rover_rl.sims.bullet.settings:BulletSettings",
    "ros2": "rover_rl.sims.ros2.settings:Ros2Settings",
    "warp": "rover_rl.sims.warp.settings:WarpSettings",
}
"""The package's backends: the class of their settings, by name."""

BackendLike: TypeAlias = Any
"""What names a backend: a name, the settings of one, or a :class:`Backend`."""

_REGISTRY = Registry("backend", BACKENDS)


@runtime_checkable
class Backend(Protocol):
    """A backend of your own: an object, usually its settings, that builds its simulator.

    Example:
        >>> @dataclass(frozen=True)
        ... class MySettings:
        ...     gravity: float = 1.62
        ...
        ...     def make(self, *, worlds, robot, lidar_beams, connection=None, device=None):
        ...         return MySimulator(worlds, robot, lidar_beams, self.gravity)
        >>> register_backend("mine", MySettings)
        >>> env = RoverEnv(backend="mine")
    """

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> Simulator:
        """Builds the simulator: see :func:`make_simulator`."""
        ...


def register_backend(name: str, backend: Any) -> None:
    """Gives a backend a name, for ``RoverEnv``, ``EnvConfig`` and ``--backend``.

    Args:
        name: its name.
        backend: a class whose instances are :class:`Backend` objects, such an object, or the ``"module:attribute"`` of
            either.

    Raises:
        ValueError: for a name that is taken, or that has other characters than letters, digits, ``_``, ``-`` and ``.``.
    """
    _REGISTRY.register(name, backend)


def backend_names() -> list[str]:
    """Names of the backends of the package, of those registered, and of those of installed packages."""
    return _REGISTRY.names()


def find_settings(name: str) -> Any:
    """The class of a backend's settings, or the :class:`Backend` registered under the name.

    Raises:
        ValueError: for an unknown name.
    """
    return _REGISTRY.find(name)


def name_of(backend: Any) -> str:
    """The name of the backend that an object belongs to: what :func:`find_settings` takes."""
    path = f"{type(backend).__module__}:{type(backend).__qualname__}"
    return next((name for name, known in BACKENDS.items() if known == path), path)


def make_simulator(
    backend: BackendLike,
    *,
    worlds: Sequence[World],
    robot: Robot,
    lidar_beams: int,
    physics: str | None = None,
    connection: Connection | None = None,
    device: torch.device | None = None,
) -> Simulator:
    """Builds a simulator.

    Args:
        backend: a name in :func:`backend_names`, for a backend with its default settings; a backend's settings, for
            example ``BulletSettings(substeps=20)``; or a :class:`Backend`.
        worlds: the world of each rover, N entries; equal ones share a simulation.
        robot: the rover.
        lidar_beams: number of beams of a raw scan over the full turn.
        physics: name of a preset of a backend that is given by its name; ``None``: its default settings.
        connection: topics of a live rover; ``None``: the contract's.
        device: device of the task's tensors; a backend that can run there does. ``None``: the CPU.

    Raises:
        ValueError: for an unknown backend or preset.
    """
    if physics is not None and not isinstance(backend, str):
        raise ValueError(f"physics={physics!r} is for a backend given by its name; this one has settings of its own")
    settings = _settings(backend, physics) if isinstance(backend, str) else backend
    build = settings.make if isinstance(settings, Backend) else _builder(settings)
    return build(worlds=worlds, robot=robot, lidar_beams=lidar_beams, connection=connection, device=device)


def _settings(name: str, physics: str | None) -> Any:
    """The settings of the backend of that name: its defaults, or a preset."""
    kind = find_settings(name)
    if physics is None:
        return kind() if isinstance(kind, type) else kind
    if not hasattr(kind, "preset"):
        raise ValueError(f"backend {name!r} has no presets of physics, got physics={physics!r}")
    return kind.preset(physics)


def _builder(settings: Any) -> Callable[..., Simulator]:
    """What builds the simulator for settings of the package's own backends."""
    name = name_of(settings)
    if name not in _BUILDERS:
        raise ValueError(
            f"backend must be one of {backend_names()}, the settings of one, or an object with a method make(), "
            f"got {settings!r}"
        )

    def build(**arguments: Any) -> Simulator:
        return _BUILDERS[name](settings, **arguments)

    return build


def _make_bullet(
    settings: Any,
    *,
    worlds: Sequence[World],
    robot: Robot,
    lidar_beams: int,
    connection: Connection | None,
    device: torch.device | None,
) -> Simulator:
    simulator = import_module("rover_rl.sims.bullet.simulator")
    return simulator.BulletSimulator(worlds, robot, lidar_beams, settings)


def _make_warp(
    settings: Any,
    *,
    worlds: Sequence[World],
    robot: Robot,
    lidar_beams: int,
    connection: Connection | None,
    device: torch.device | None,
) -> Simulator:
    simulator = import_module("rover_rl.sims.warp.simulator")
    return simulator.WarpSimulator(worlds, robot, lidar_beams, settings, device)


def _make_ros2(
    settings: Any,
    *,
    worlds: Sequence[World],
    robot: Robot,
    lidar_beams: int,
    connection: Connection | None,
    device: torch.device | None,
) -> Simulator:
    simulator = import_module("rover_rl.sims.ros2.simulator")
    return simulator.Ros2Simulator(worlds, robot, lidar_beams, settings, connection)


_BUILDERS: dict[str, Callable[..., Simulator]] = {"bullet": _make_bullet, "ros2": _make_ros2, "warp": _make_warp}
