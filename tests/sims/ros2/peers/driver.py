"""Drives through ``transport="rclpy"`` until an error. Tells it, threads that are left, types, and parameters."""

from __future__ import annotations

import importlib
import json
import threading

import rclpy
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from rover_rl.sims.ros2.transport import make_transport
from tests.sims.ros2.processes import drive_a_curve, until


def asked(node: str, *names: str) -> list[object]:
    """Values of the parameters of a node, and whether the first one can be changed, as another node is told."""
    rclpy.init()
    asker = rclpy.create_node("asker")
    client, answers = AsyncParameterClient(asker, node), []
    assert client.wait_for_services(10)
    for request in (client.get_parameters([*names]), client.set_parameters([Parameter(names[0], value="wheels")])):
        rclpy.spin_until_future_complete(asker, request, timeout_sec=10)
        answers.append(request.result())
    rclpy.shutdown()
    values, changed = answers
    return [*map(parameter_value_to_python, values.values), changed.results[0].successful]


if __name__ == "__main__":
    importlib.import_module("rover_rl.sims.ros2.simulator")  # takes a while, which the test allows until "up"
    print('"up"', flush=True)
    error = drive_a_curve("rclpy", reset="topic")
    threads = [thread.name for thread in threading.enumerate() if "spins rclpy" in thread.name]
    transport = make_transport("rclpy", "listener", {"pose": "tf", "max_age": 0.5, "max_speed": None})
    until(lambda: transport.types("/scan"))
    types = [sorted(transport.types("/cmd_vel", receivers=True)), sorted(transport.types("/nothing"))]
    parameters = asked("listener", "pose", "max_age")
    transport.close()
    transport.close()
    print(json.dumps({"error": error, "threads": threads, "types": types, "parameters": parameters}), flush=True)
