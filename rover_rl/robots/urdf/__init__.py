"""Reads robots from URDF files.

- ``description``: links and joints of a file; ``expressions``: what xacro left; ``meshes``: mesh files.
- ``wheels``: finds the wheels; ``layout`` decides by them which drive a robot has; ``motion``: its limits.
- ``body``: mass and boxes of the body; ``read``: reads a robot with all of these.
"""
