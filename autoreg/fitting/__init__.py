"""A lattice laid on the photographed joints: measured, solved and measured again until all is still."""
