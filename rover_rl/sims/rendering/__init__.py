"""Pictures of a rover in its world, the same for every simulator."""
