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

"""The picture of a run of a robot, for failed tests and findings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.plots.rendering import write
from diffdrive_jacobian.plots.run_panels import ViolationMark
from diffdrive_jacobian.plots.run_pictures import run_figure


def draw_run(bag: Path, picture: Path, marks: Sequence[tuple[int, str]]) -> str | None:
    """Draw a bag with odometry. Return why not; '': it is drawn, None: it has no odometry."""
    try:
        run = read_run(bag)
        if not len(run.odometry.values):
            return None
        write(run_figure(run, [ViolationMark(*mark) for mark in marks]), picture)
    except (BagError, ModuleNotFoundError, OSError) as error:
        return str(error)
    return ''
