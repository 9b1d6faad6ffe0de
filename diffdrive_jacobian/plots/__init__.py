"""Figures and tables of runs and sweeps, their style and their files. No ROS is needed.

`run_figure.draw` draws runs, `run_table.write_csv` writes a run as CSV, `sweep_figure` draws sweeps.
"""

__all__ = ['run_figure', 'run_table', 'sweep_figure']
