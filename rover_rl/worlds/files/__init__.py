"""Importers of worlds: SDF, meshes, elevation models, occupancy grids, and the project's own world files."""
