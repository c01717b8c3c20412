"""Publisher of a rover's velocity commands."""

from __future__ import annotations

import time

from rover_rl.sims.ros2.messages import Header, Message, Time, Twist, TwistStamped, Vector3
from rover_rl.sims.ros2.settings import Command
from rover_rl.sims.ros2.transport import Publisher, Transport

STOP_REPEATS = 3
"""Number of times that a stop command is sent, as a message may be lost."""


class CommandPublisher:
    """Publishes velocity commands and keeps the last one.

    Args:
        transport: transport to publish on.
        topic: topic of the commands.
        kind: message type of the commands; ``"none"`` sends nothing.
        frame_id: frame of stamped commands.

    Attributes:
        last: forward speed (m/s) and yaw rate (rad/s) of the last command.
    """

    def __init__(self, transport: Transport, topic: str, kind: Command, frame_id: str) -> None:
        self.last = (0.0, 0.0)
        self._frame_id = frame_id
        self._stamped = kind == "twist_stamped"
        self._publish: Publisher[Message] | None = None
        if kind != "none":
            message: type[Message] = TwistStamped if self._stamped else Twist
            self._publish = transport.publisher(topic, message, reliable=True)

    def send(self, speed: float, yaw_rate: float) -> None:
        """Sends a forward speed (m/s) and a yaw rate (rad/s)."""
        self.last = (speed, yaw_rate)
        if self._publish is not None:
            twist = Twist(Vector3(x=speed), Vector3(z=yaw_rate))
            stamp = Time.from_seconds(time.time())
            self._publish(TwistStamped(Header(stamp, self._frame_id), twist) if self._stamped else twist)

    def stop(self) -> None:
        """Sends zero velocity, several times."""
        for _ in range(STOP_REPEATS):
            self.send(0.0, 0.0)
