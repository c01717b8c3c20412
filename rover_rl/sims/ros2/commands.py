"""Commands of a live rover: sent, guarded by a watchdog, and compared with what others send."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import CommandPublisher, Transport, other_types
from rover_rl.sims.ros2.watchdog import Watchdog

OTHER_TIME = 0.5
"""Time since its last command for which another driver counts as one, s."""


class _Heard(NamedTuple):
    """A command of another driver: forward speed (m/s) and yaw rate (rad/s), its arrival (s), and its publisher."""

    command: tuple[float, float]
    time: float
    sender: str


class Commands:
    """Sends the commands of a rover, and hears those of other drivers.

    A watchdog process stops the rover if this process dies or hangs. Once another driver is heard, whether it sends
    from a joystick or is a second program, the commands of both would mix: :meth:`other` names it. With
    ``settings.give_way``, nothing is sent while it sends.
    """

    def __init__(self, transport: Transport, topic: str, settings: Ros2Settings) -> None:
        self._transport, self._topic, self._gives_way = transport, topic, settings.give_way
        self._publisher = CommandPublisher(transport, topic, settings.command, settings.frame_id)
        self._watchdog: Watchdog | None = None
        self._heard: _Heard | None = None
        if settings.command != "none":
            self._watchdog = Watchdog(topic, settings, listeners=1)
            transport.overhear(topic, self._publisher.message, self._hear)

    @property
    def last(self) -> tuple[float, float]:
        """Forward speed (m/s) and yaw rate (rad/s) of the command in force."""
        return self._publisher.last

    @property
    def gives_way(self) -> bool:
        """Whether another driver sends, which wins."""
        return self._gives_way and self._other() is not None

    def send(self, speed: float, yaw_rate: float) -> None:
        """Sends a forward speed (m/s) and a yaw rate (rad/s), unless it gives way to another driver."""
        other = self._other() if self._gives_way else None
        if other is not None:
            self._publisher.last = other.command
            self._rest()
        elif (speed, yaw_rate) == (0.0, 0.0):
            self._publisher.send(speed, yaw_rate)
            self._rest()
        else:
            if self._watchdog is not None:
                self._watchdog.alive()
            self._publisher.send(speed, yaw_rate)

    def stop(self) -> None:
        """Sends a stop command, several times."""
        self._publisher.stop()
        self._rest()

    def keep_alive(self) -> None:
        """Tells the watchdog that the command in force still holds."""
        if self._watchdog is not None and self.last != (0.0, 0.0) and not self.gives_way:
            self._watchdog.alive()

    def require_receiver(self) -> None:
        """Raises ``ValueError`` if the only receivers of the commands expect messages of another type."""
        message = self._publisher.message
        if self._watchdog is None or self._transport.subscribers(self._topic):
            return
        if others := other_types(self._transport, self._topic, message, receivers=True):
            choices = {"TwistStamped": "command='twist_stamped', --stamped", "Twist": "command='twist', no --stamped"}
            choice = choices.get(others.removeprefix("geometry_msgs/"), "another topic, --cmd-vel-topic")
            own = message.ros_type.replace("/msg/", "/")
            raise ValueError(
                f"the receiver of {self._topic} expects {others}, and {own} would be sent: choose {choice}"
            )

    def halt(self) -> None:
        """Stops the rover for good, whatever is sent. Any thread may call it."""
        if self._watchdog is not None:
            self._watchdog.halt()

    def other(self, since: float) -> str:
        """Returns which node has sent commands recently, but after ``since`` (s); empty if none has."""
        other = self._other()
        if other is None or other.time < since:
            return ""
        return self._transport.name_of(other.sender, self._topic)

    def close(self) -> None:
        """Stops the rover if it moves, and ends the watchdog. Idempotent."""
        if self.last != (0.0, 0.0):
            self._publisher.stop()
        if self._watchdog is not None:
            self._watchdog.close()

    def _rest(self) -> None:
        if self._watchdog is not None:
            self._watchdog.rest()

    def _other(self) -> _Heard | None:
        """Returns the last command of another driver that sends now."""
        heard = self._heard
        return heard if heard is not None and time.monotonic() - heard.time < OTHER_TIME else None

    def _hear(self, message: Any, sender: str) -> None:
        twist = getattr(message, "twist", message)
        command = twist.linear.x, twist.angular.z
        assert self._watchdog is not None
        if command != (0.0, 0.0) or not self._watchdog.may_be_stopping:
            self._heard = _Heard(command, time.monotonic(), sender)
