"""Sends, receives and drives a rover through ``transport="rclpy"``. Tells what came of it, a part after each line."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from rover_rl import RoverEnv
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.messages import Header, LaserScan, Point, Pose, PoseArray, Time, Twist, Vector3
from rover_rl.sims.ros2.transport import make_transport


def tell(value: Any) -> None:
    print(json.dumps(value), flush=True)
    sys.stdin.readline()


def until(condition: Callable[[], object]) -> None:
    while not condition():
        time.sleep(0.01)


transport = make_transport("rclpy", "rover")
received: list[Any] = []
transport.subscribe("/own/given", LaserScan, received.append)
transport.subscribe("/own/set_pose", PoseArray, received.append, reliable=True)
publish = {
    kind: transport.publisher(topic, kind, reliable=kind is Twist)
    for topic, kind in (("/own/twist", Twist), ("/own/scan", LaserScan), ("/own/poses", PoseArray))
}
tell("up")
until(lambda: all(transport.subscribers(topic) for topic in ("/own/twist", "/own/scan", "/own/poses")))
scan = LaserScan(Header(Time(1, 2), "lidar"), range_max=10.0, ranges=np.arange(640, dtype=np.float32))
# More than once: the other side may not know this one yet.
for _ in range(20):
    for message in (Twist(Vector3(x=0.5)), scan, PoseArray(poses=[Pose(Point(1.0, 2.0))])):
        publish[type(message)](message)
    time.sleep(0.05)
until(lambda: received)
tell(
    {
        "subscribers": transport.subscribers("/own/twist"),
        "types": [sorted(transport.types(topic)) for topic in ("/own/given", "/own/nothing")],
        "class": type(received[0]).__module__.split(".")[0],
        "ranges": list(received[0].ranges),
    }
)
transport.close()
transport.close()
threads = [thread.name for thread in threading.enumerate() if "spins rclpy" in thread.name]

settings = Ros2Settings(transport="rclpy", reset="topic", reset_timeout=20.0, step_timeout=20.0)
env = RoverEnv(world_n="maze", backend=settings, seed=0, connection_check_timeout=60)
start = env.reset()["pose"][0, :2]
for _ in range(20):
    now = env.step(env.rand_action().set("action", torch.tensor([[1.0, 0.0]])))["next"]
moved = torch.dist(start, now["pose"][0, :2]).item()
env.close()
tell({"threads": threads, "moved": moved, "speed": now["velocities"][0, 0].item()})
