"""Sweeps of gains: thousands of closed loops simulated together."""

from diffdrive_jacobian.sweeps.sweep import Setup, Sweep, describe, sweep, table

__all__ = ['Setup', 'Sweep', 'describe', 'sweep', 'table']
