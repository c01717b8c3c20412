"""Reads robots from URDF files."""
