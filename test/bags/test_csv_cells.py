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

"""Cells of CSV files are numbers or empty: no text of a bag can become a formula of a spreadsheet."""

from __future__ import annotations

import csv
import io
import re

from support.bags import SECOND, write_bag
from support.ros_messages import goal, joint_command, odometry

from diffdrive_jacobian.bags.run import read_run
from diffdrive_jacobian.bags.table import csv_text

NUMBER = re.compile(r'(-?\d+(\.\d+)?(e-?\d+)?)?')
HEADER = re.compile(r'[a-z][A-Za-z0-9_]*')
FORMULAS = ('=cmd|" /C calc"!A0', '+1+1', '-2+3', '@SUM(A1)', '\t=1', '"\n=1')


def test_names_are_not_in_the_table_of_a_run(tmp_path):
    left, right, world, body, wheels_frame, goal_frame = FORMULAS
    wheels = joint_command(1.0, -1.0, SECOND)
    wheels.name, wheels.header.frame_id = [left, right], wheels_frame
    moved = odometry(0.1, 0.0, -0.1, frame=world)
    moved.child_frame_id = body
    sent = [(1.0, '/odom', moved), (1.0, '/joint_states', wheels), (1.1, '/odom', moved)]
    sent.append((1.0, '/goal_pose', goal(0.3, 0.1, frame=goal_frame)))
    robot = {'left_wheel_name': left, 'right_wheel_name': right}
    run = read_run(write_bag(tmp_path / 'bag', sent, parameters={'/virtual_robot': robot}))
    assert len(run.wheels) == 1
    header, *rows = csv.reader(io.StringIO(csv_text(run)))
    assert len(rows) == 2
    assert [cell for cell in header if not HEADER.fullmatch(cell)] == []
    assert [cell for row in rows for cell in row if not NUMBER.fullmatch(cell)] == []
