"""Exercises of a course, each a file of tests for pytest. doc/course.md has the tasks.

`grade_hand_ins wheels alice.py` grades a hand-in by the exercise of that name.

Internal: it may change without notice.
"""
