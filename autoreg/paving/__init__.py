"""From combs of parallel joints to the slab lattice that explains a photo: spacing, phase and bond."""
