"""The benchmark suite: accuracy against what is possible, speed against one LSD pass, and peers beside both.

`python -m benchmarks` runs it; `metrics` holds the one list that the report and the gate read.
"""
