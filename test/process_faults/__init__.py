"""Faults that a simulation cannot inject, in real processes. `test/promises.py` runs them and counts."""
