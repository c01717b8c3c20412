"""Planar tier of the Warp backend, for level ground: three degrees of freedom, the same wheels, motors and limits.

A rover on level ground cannot tilt, so that its pose is x, y and yaw, and the load on each wheel is that of its level
stance. Obstacles are prisms, of which contacts and lidar need the outline alone. ``physics="planar"`` chooses it.

Frames, used by all modules:
    world: x, y on the ground, m. Heights are above the ground.
    body: axes ahead and to the left, origin at the center of mass.
"""
