"""Calibration: finds the numbers of a robot from a recording of a drive (``rover-rl calibrate``)."""
