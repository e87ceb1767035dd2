"""Paving with unbroken joints in one direction only: rows of slabs, and what is none."""
