"""Joints measured: grey-level profiles across them, and the strips and edges fitted to these."""
