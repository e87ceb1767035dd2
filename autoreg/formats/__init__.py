"""Files and texts of cameras: what other programs write, and what photos say of theirs."""
