"""Colors, light and goal post of all pictures. Colors are red, green and blue, 0 to 1, as a screen shows them."""

from __future__ import annotations

GROUND = (0.66, 0.57, 0.47)
"""Color of the ground."""
OBSTACLE = (0.50, 0.57, 0.65)
"""Color of obstacles. Each is a little darker or brighter."""
GOAL = (0.10, 0.75, 0.25)
"""Color of the post of the goal."""
CLOTHES = (0.47, 0.30, 0.66)
"""Color of the trunks of people."""
LEGS = (0.20, 0.18, 0.27)
"""Color of their legs."""
SKIN = (0.76, 0.58, 0.46)
"""Color of their heads."""
MOVER = (0.80, 0.24, 0.22)
"""Color of other movers."""
UNPAINTED = (0.70, 0.70, 0.72)
"""Color of the rover's visual shapes for which neither the URDF nor the mesh file states one."""
HORIZON = (0.87, 0.88, 0.88)
"""Color of the sky at the horizon, and of the haze."""
ZENITH = (0.30, 0.52, 0.80)
"""Color of the sky overhead."""
SUN = (-0.62, 0.42, 0.66)
"""Direction to the sun in the world frame."""
GRID = 1.0
"""Distance between the lines on the ground, m."""
POST_RADIUS = 0.08
"""Radius of the post of the goal, m."""
POST_LENGTH = 1.2
"""Length of the post of the goal, m."""
