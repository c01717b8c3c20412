"""Sends random and truncated bytes on a rover's topics, under the names of the correct types.

Each length is a DDS type of its own: an array of bytes. Its type description differs from the message's, so both sides
must ignore type descriptions: see :data:`IGNORE_TYPES`.

    python raw_payloads.py DOMAIN COUNT
"""

from __future__ import annotations

import random
import sys
import time

IGNORE_TYPES = "<Compatibility><IgnoreTypeInformation>1.15,1.16</IgnoreTypeInformation></Compatibility>"
"""``CYCLONEDDS_URI`` that matches types by name only, also between Cyclone DDS peers (vendor 1.16)."""
LENGTHS = (1, 3, 4, 8, 17, 40, 47, 48, 100, 300)


def main(domain: int, count: int) -> None:
    """Sends ``count`` payloads on each topic, once it has a subscriber."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct, make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.topic import Topic

    from rover_rl.sims.ros2.dds import DdsTransport
    from rover_rl.sims.ros2.messages import Imu, LaserScan, Odometry, PoseArray, Twist, encode

    class Raw(IdlStruct):
        data = b""

        def serialize(self, *_: object, **__: object) -> bytes:
            return self.data

    qos = Qos(
        Policy.Reliability.BestEffort,
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )
    transport = DdsTransport("raw")
    topics = {
        "/scan": LaserScan,
        "/imu/data": Imu,
        "/odometry/wheels": Odometry,
        "/rover/pose_array": PoseArray,
        "/cmd_vel": Twist,
    }
    rng = random.Random(0)
    for length in LENGTHS:
        participant = DomainParticipant(domain)
        writers = {}
        for name, message in topics.items():
            package, folder, kind = message.ros_type.split("/")
            struct = make_idl_struct(
                kind, f"{package}.{folder}.dds_.{kind}_", {"bytes": types.array[types.uint8, length]}, bases=(Raw,)
            )
            writer = DataWriter(participant, Topic(participant, "rt" + name, struct), qos)
            deadline = time.monotonic() + 20
            while not writer.get_publication_matched_status().current_count:
                assert time.monotonic() < deadline, f"{name} has no subscriber"
                time.sleep(0.01)
            writers[name] = (writer, struct, encode(message())[4:])
        for number in range(count // len(LENGTHS)):
            for writer, struct, payload in writers.values():
                sample = struct.__new__(struct)
                truncated = payload[:length].ljust(length, b"\x00")
                sample.data = b"\x00\x01\x00\x00" + (truncated if number % 4 == 0 else rng.randbytes(length))
                writer.write(sample)
            time.sleep(0.002)
    transport.close()
    print("sent", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
