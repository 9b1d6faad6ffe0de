"""Cells of CSV files are numbers or empty: no text of a bag can become a formula of a spreadsheet."""

from __future__ import annotations

import csv
import io
import re

from geometry_msgs.msg import TwistStamped
from support.bags import SECOND, write_bag
from support.ros_messages import goal, joint_command, odometry

from diffdrive_jacobian.bags.run import read_run
from diffdrive_jacobian.bags.table import csv_text

NUMBER = re.compile(r'(-?\d+(\.\d+)?(e-?\d+)?)?')
HEADER = re.compile(r'[a-z][A-Za-z0-9_]*')
FORMULAS = ('=cmd|" /C calc"!A0', '+1+1', '-2+3', '@SUM(A1)', '\t=1', '"\n=1', '=1,=2')


def test_names_of_joints_and_frames_are_not_in_the_table_of_a_run(tmp_path):
    *joints, world, body, wheels_frame, goal_frame, start = FORMULAS
    sent = []
    for index in range(3):
        at = 1.0 + index / 10
        message = odometry(index / 20, 0.0, -0.1, frame=world)
        message.child_frame_id = body
        wheels = joint_command(1.0, -1.0, round(at * SECOND))
        wheels.name, wheels.header.frame_id = joints, wheels_frame
        applied = TwistStamped()
        applied.header.frame_id = body
        sent += [(at, '/odom', message), (at, '/joint_states', wheels), (at, '/cmd_vel_out', applied)]
    sent.append((1.2, '/goal_pose', goal(0.3, 0.1, frame=goal_frame)))
    robot = {'left_wheel_name': joints[0], 'right_wheel_name': joints[1], 'x': start}
    run = read_run(write_bag(tmp_path / 'bag', sent, parameters={'/virtual_robot': robot}))
    assert len(run.wheels) == 3
    (tmp_path / 'run.csv').write_text(csv_text(run))
    header, *rows = csv.reader(io.StringIO((tmp_path / 'run.csv').read_text()))
    assert len(rows) == 3
    assert [cell for cell in header if not HEADER.fullmatch(cell)] == []
    assert [cell for row in rows for cell in row if not NUMBER.fullmatch(cell)] == []
