"""The search for the paving: from a photo's segments to the lattice, or the rows, that explain it best.

All of it is done at detection scale; what it finds is measured at the photo's own resolution afterwards.
"""
