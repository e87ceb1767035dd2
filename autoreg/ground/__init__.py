"""The ground seen by a camera: where it may lie, its rectified picture, and where a lattice shows on it."""
