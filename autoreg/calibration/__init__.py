"""Calibrate a camera from photos of a board, and say how far to trust it.

The order of the modules is the flow of the data: board, synthetic; corners, detection, photos, grouping;
models, observations, unknowns, normal_equations, adjustment; starting, bad_views, precision, model_choice,
mixture, flatness; projection_map, coverage, verdict; result, refusals, pipeline; record, plots,
html_report. Beside it, printing makes boards, and focal, claims and inspection judge a camera without its
photos.
"""
