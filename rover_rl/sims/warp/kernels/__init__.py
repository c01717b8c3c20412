"""Warp kernels: physics and lidar of one rover per thread, or on a GPU the lidar of one rover by several threads.

Every thread reads and writes only the rows of its own rover, so that a result depends neither on the other rovers of a
batch nor on the number of threads, to the last bit.

Frames, used by all modules:
    world: z up, m.
    base: base link of the URDF; x forward, y left, z up.
    body: axes of the base frame, origin at the center of mass of the whole rover. The solver works in this frame.
    wheel: axes of the body frame, origin at the hub; the axle points along +y.
    contact: ``normal`` (from the other surface to the rover), ``longitudinal`` and ``lateral``, orthonormal vectors
        in the body frame.
"""
