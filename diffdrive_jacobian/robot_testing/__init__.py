"""What tests of a differential drive have besides: its faults, properties, poses and goals, a picture.

Internal: its names are public in `testing`, `faults` and `properties`.

The packages `testing`, `faults`, `properties` and `exploration` know of it only under which names of
theirs it is found. The entry points of
this distribution name what is here, as those of another one may name what tests of its robots need:

- `pytest11`: `fixtures`.
- `diffdrive_jacobian.fault_kinds`: what `fault_schedules(robots=...)` draws from.
- `diffdrive_jacobian.pictures`: the picture of a bag.
"""
