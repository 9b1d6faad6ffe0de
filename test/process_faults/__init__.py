"""Faults that a simulation cannot inject, in real processes. `promises.py` runs them and counts."""
