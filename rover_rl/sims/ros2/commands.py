"""Commands of a live rover: sent, guarded by a watchdog process, and compared with what others send.

:class:`Watchdog` runs in the driving process. It starts :func:`watch` as a program, which reads heartbeats from its
standard input. If they cease while the rover moves, or the driving process is gone, the program sends stop commands for
a limited time, at most until the next heartbeat. It also stops the rover for good when it is told to.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from rover_rl.sims.ros2.messages import Header, Time, Twist, TwistStamped, Vector3
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import Transport, make_transport, other_types, short

OTHER_TIME = 0.5  # time since its last command for which another driver counts as one, s
STOP_REPEATS = 3  # number of times that a stop command is sent, as a message may be lost
READY = b"ready\n"  # output of the watchdog process once it is ready
HEARTBEAT, REST, HALT, QUIT = b".", b"r", b"h", b"q"
"""Input of the watchdog process: the driving process is alive, and the rover moves; the rover was stopped, so that
there is nothing to watch until the next heartbeat; send stop commands for good; end."""
TIMEOUT = 0.3  # time without a heartbeat after which the rover is stopped, s
STOP_INTERVAL = 0.05  # time between two stop commands of the watchdog, s
STOP_DURATION = 2.0  # time for which stop commands are sent if the driving process is gone or hangs, s
STOP_DELAY = 0.5  # time after a missing heartbeat within which stop commands may still arrive, s
DISCOVERY_TIMEOUT = 3.0  # time to wait for a subscriber of the commands before the watchdog reports that it is ready, s
START_TIMEOUT, EXIT_TIMEOUT = 60.0, 5.0  # time limits for the watchdog process to start and to exit, s
STOP = (0.0, 0.0)


def command_sender(transport: Transport, topic: str, settings: Ros2Settings) -> Callable[[float, float], None]:
    """Returns a function that sends a forward speed (m/s) and a yaw rate (rad/s)."""
    if settings.command == "none":
        return lambda speed, yaw_rate: None
    stamped = settings.command == "twist_stamped"
    publish = transport.publisher(topic, TwistStamped if stamped else Twist)

    def send(speed: float, yaw_rate: float) -> None:
        twist = Twist(Vector3(x=speed), Vector3(z=yaw_rate))
        header = Header(Time.from_seconds(time.time()), settings.frame_id)
        publish(TwistStamped(header, twist) if stamped else twist)

    return send


class _Heard(NamedTuple):
    """A command of another driver: forward speed (m/s) and yaw rate (rad/s), its arrival (s), and its publisher."""

    command: tuple[float, float]
    time: float
    sender: str


class Commands:
    """Sends the commands of a rover, and hears those of other drivers.

    A watchdog process stops the rover if this process dies or hangs. Once another driver is heard, whether it sends
    from a joystick or is a second program, the commands of both would mix: :meth:`other` names it. With
    ``settings.give_way``, nothing is sent while it sends. ``last`` is the command in force.
    """

    def __init__(self, transport: Transport, topic: str, settings: Ros2Settings) -> None:
        self.last = STOP
        self._transport, self._topic, self._gives_way = transport, topic, settings.give_way
        self._message = TwistStamped if settings.command == "twist_stamped" else Twist
        self._send = command_sender(transport, topic, settings)
        self._heard: _Heard | None = None
        self._watchdog: Watchdog | None = None
        if settings.command != "none":
            self._watchdog = Watchdog(topic, settings, listeners=1)
            transport.overhear(topic, self._message, self._hear)

    @property
    def gives_way(self) -> bool:
        """Whether another driver sends, which wins."""
        return self._gives_way and self._other() is not None

    def send(self, speed: float, yaw_rate: float) -> None:
        """Sends a forward speed (m/s) and a yaw rate (rad/s), unless it gives way to another driver."""
        other = self._other() if self._gives_way else None
        self.last = (speed, yaw_rate) if other is None else other.command
        if other is None:
            if self.last != STOP:
                self.keep_alive()
            self._send(speed, yaw_rate)
        if other is not None or self.last == STOP:
            self._rest()

    def stop(self) -> None:
        """Sends a stop command, several times."""
        self.last = STOP
        for _ in range(STOP_REPEATS):
            self._send(*STOP)
        self._rest()

    def keep_alive(self) -> None:
        """Tells the watchdog that the command in force still holds."""
        if self._watchdog is not None and self.last != STOP and not self.gives_way:
            self._watchdog.alive()

    def require_receiver(self) -> None:
        """Raises ``ValueError`` if the only receivers of the commands expect messages of another type."""
        if self._watchdog is None or self._transport.subscribers(self._topic):
            return
        if others := other_types(self._transport, self._topic, self._message, receivers=True):
            choices = {"TwistStamped": "command='twist_stamped', --command", "Twist": "command='twist', --command"}
            choice = choices.get(others.removeprefix("geometry_msgs/"), "another topic, --cmd-vel-topic")
            text = f"expects {others}, and {short(self._message.ros_type)} would be sent: choose {choice}"
            raise ValueError(f"the receiver of {self._topic} {text}")

    def halt(self) -> None:
        """Stops the rover for good, whatever is sent. Any thread may call it."""
        if self._watchdog is not None:
            self._watchdog.halt()

    def other(self, since: float) -> str:
        """Returns which node has sent commands recently, but after ``since`` (s); empty if none has."""
        other = self._other()
        return "" if other is None or other.time < since else self._transport.name_of(other.sender, self._topic)

    def close(self) -> None:
        """Stops the rover if it moves, and ends the watchdog and the connection. Idempotent."""
        if self.last != STOP:
            self.stop()
        if self._watchdog is not None:
            self._watchdog.close()
        self._transport.close()

    def _rest(self) -> None:
        if self._watchdog is not None:
            self._watchdog.rest()

    def _other(self) -> _Heard | None:
        heard = self._heard
        return heard if heard is not None and time.monotonic() - heard.time < OTHER_TIME else None

    def _hear(self, message: Any, sender: str) -> None:
        twist = getattr(message, "twist", message)
        command = twist.linear.x, twist.angular.z
        assert self._watchdog is not None
        if command != STOP or not self._watchdog.may_be_stopping:
            self._heard = _Heard(command, time.monotonic(), sender)


class Watchdog:
    """Process that sends stop commands on ``topic`` after ``timeout`` (s) without a heartbeat.

    The first heartbeat waits until the process is ready. ``listeners`` is the number of subscribers of the topic
    besides the rover. :meth:`alive` and :meth:`halt` raise ``ChildProcessError`` if the process does not start, is
    gone, or hangs.
    """

    def __init__(self, topic: str, settings: Ros2Settings, timeout: float = TIMEOUT, listeners: int = 0) -> None:
        arguments = pickle.dumps((topic, settings, timeout, listeners))
        program = f"import pickle, sys; sys.path[:] = {sys.path!r}; from {__name__} import watch; "
        started = [sys.executable, "-c", program + f"watch(*pickle.loads({arguments!r}))"]
        # A new session, so that Ctrl-C does not end the watchdog before the driving process.
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(started, stdin=pipe, stdout=pipe, start_new_session=True)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        # A full pipe means that the watchdog hangs. It must not block the driving process.
        os.set_blocking(self._input.fileno(), False)
        self._timeout, self._is_ready, self._is_halted = timeout, False, False
        self._last, self._missed = math.inf, -math.inf  # times of the last heartbeat, and of one that came late

    @property
    def may_be_stopping(self) -> bool:
        """Whether stop commands of the process may arrive."""
        now = time.monotonic()
        return self._is_halted or now - self._missed < STOP_DELAY or now - self._last > 0.8 * self._timeout

    def wait_until_ready(self) -> None:
        ready, _, _ = select.select([self._output], [], [], START_TIMEOUT)
        if not ready or self._output.readline() != READY:
            self.close()
            raise ChildProcessError("the watchdog did not start, so the rover is not driven")
        self._is_ready = True

    def alive(self) -> None:
        """Sends a heartbeat. Call it with every command that moves the rover, and while it is in force."""
        if not self._is_ready:
            self.wait_until_ready()
        if self.may_be_stopping:
            self._missed = time.monotonic()
        self._write(HEARTBEAT)
        self._last = time.monotonic()

    def rest(self) -> None:
        """Reports that the rover was stopped: until the next heartbeat, there is nothing to watch."""
        self._last = math.inf
        with contextlib.suppress(ChildProcessError):  # the next heartbeat reports it
            if self._is_ready:
                self._write(REST)

    def halt(self) -> None:
        """Stops the rover for good: the process sends stop commands until :meth:`close`. Any thread may call it."""
        self._is_halted = True
        self._write(HALT)

    def close(self) -> None:
        """Ends the watchdog process. Idempotent."""
        if self._process.poll() is None:
            with contextlib.suppress(ChildProcessError):
                self._write(QUIT)
            try:
                # A process that is not ready yet has nothing to stop.
                self._process.wait(EXIT_TIMEOUT if self._is_ready else 0.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._input.close()
        self._output.close()

    def _write(self, data: bytes) -> None:
        try:
            os.write(self._input.fileno(), data)
        except (OSError, ValueError) as error:
            raise ChildProcessError("the watchdog is gone, so the rover is no longer driven") from error


def watch(topic: str, settings: Ros2Settings, timeout: float, listeners: int) -> None:
    """Reads heartbeats from standard input, and stops the rover ``timeout`` (s) after the last one.

    Runs until the driving process ends.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # as a service manager sends them to all processes at once
        signal.signal(number, signal.SIG_IGN)
    transport = make_transport(settings.transport, f"{settings.node}_watchdog")
    send = command_sender(transport, topic, settings)

    def stop() -> None:
        for _ in range(STOP_REPEATS):
            send(*STOP)

    deadline, received = time.monotonic() + DISCOVERY_TIMEOUT, False
    while transport.subscribers(topic) <= listeners and time.monotonic() < deadline and not received:
        received = bool(select.select([sys.stdin], [], [], STOP_INTERVAL)[0])
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()
    patience: float | None = None  # before the first heartbeat there is nothing to stop
    halted, stops = False, 0
    while True:
        if not select.select([sys.stdin], [], [], patience)[0]:
            stop()
            stops += 1
            patience = STOP_INTERVAL if halted or stops * STOP_INTERVAL < STOP_DURATION else None
            continue
        data = os.read(sys.stdin.fileno(), 4096)
        if not data:  # the driving process is gone
            for _ in range(round(STOP_DURATION / STOP_INTERVAL)):
                stop()
                time.sleep(STOP_INTERVAL)
        if not data or QUIT in data:
            break
        if halted := halted or HALT in data:
            stop()
        stops = 0
        patience = STOP_INTERVAL if halted else timeout if data.endswith(HEARTBEAT) else None
    transport.close()
