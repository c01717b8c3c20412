"""Drives through ``transport="rclpy"`` until an error. Tells it, threads that are left, and the types of topics."""

from __future__ import annotations

import importlib
import json
import threading

from rover_rl.sims.ros2.transport import make_transport
from tests.sims.ros2.processes import drive_a_curve, until

if __name__ == "__main__":
    importlib.import_module("rover_rl.sims.ros2.simulator")  # takes a while, which the test allows until "up"
    print('"up"', flush=True)
    error = drive_a_curve("rclpy", reset="topic")
    threads = [thread.name for thread in threading.enumerate() if "spins rclpy" in thread.name]
    transport = make_transport("rclpy", "listener")
    until(lambda: transport.types("/scan"))
    types = [sorted(transport.types("/cmd_vel", receivers=True)), sorted(transport.types("/nothing"))]
    transport.close()
    transport.close()
    print(json.dumps({"error": error, "threads": threads, "types": types}), flush=True)
