"""Exploring worlds: `explore` runs a scenario in thousands of worlds and shrinks what fails.

Internal: programs import `explore` and the strategies from `testing`. Modules that only run worlds need
no Hypothesis.
"""
