"""Map of the obstacles that a rover's lidar has seen, and routes on it."""
