"""What a rover is told to do."""

from __future__ import annotations

import time

from rover_rl.sims.ros2.messages import Header, Message, Time, Twist, TwistStamped, Vector3
from rover_rl.sims.ros2.settings import Command
from rover_rl.sims.ros2.transport import Publisher, Transport

STOPS = 3
"""Times that a stop is sent: one may be lost."""


class Commands:
    """Sends forward speed and yaw rate, and remembers them.

    Args:
        transport: to send over.
        topic: that the rover listens on.
        kind: of message; ``"none"`` sends nothing.
        frame_id: of stamped messages.

    Attributes:
        last: what was sent last, m/s and rad/s.
    """

    def __init__(self, transport: Transport, topic: str, kind: Command, frame_id: str) -> None:
        self.last = (0.0, 0.0)
        self._frame_id = frame_id
        self._stamped = kind == "twist_stamped"
        self._publish: Publisher[Message] | None = None
        if kind != "none":
            message: type[Message] = TwistStamped if self._stamped else Twist
            self._publish = transport.publisher(topic, message, reliable=True)

    def send(self, speed: float, turn: float) -> None:
        """Forward speed, m/s, and yaw rate, rad/s."""
        self.last = (speed, turn)
        if self._publish is not None:
            twist = Twist(Vector3(x=speed), Vector3(z=turn))
            stamp = Time.of(time.time())
            self._publish(TwistStamped(Header(stamp, self._frame_id), twist) if self._stamped else twist)

    def stop(self) -> None:
        """Neither forwards nor round, more than once."""
        for _ in range(STOPS):
            self.send(0.0, 0.0)
