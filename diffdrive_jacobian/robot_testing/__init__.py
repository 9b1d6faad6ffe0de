# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What tests of a differential drive have besides: its faults, properties, poses and goals, a picture.

Internal: its names are public in `testing`, `faults` and `properties`.

The packages `testing`, `faults`, `properties` and `exploration` know of it only under which names of
theirs it is found. The entry points of
this distribution name what is here, as those of another one may name what tests of its robots need:

- `pytest11`: `fixtures`.
- `diffdrive_jacobian.fault_kinds`: what `fault_schedules(robots=...)` draws from.
- `diffdrive_jacobian.pictures`: the picture of a bag.
"""
