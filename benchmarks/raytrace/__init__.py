"""Paving scenes ray-traced by POV-Ray, whose own camera is the truth."""
