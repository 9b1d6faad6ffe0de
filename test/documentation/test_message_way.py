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

"""The way of a message that doc/design.md lists: a message takes it, function by function."""

from __future__ import annotations

import re
import sys
from functools import cache
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from std_msgs.msg import String

import diffdrive_jacobian
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

PAGE = Path(__file__).parents[2] / 'doc' / 'design.md'
PACKAGE = Path(diffdrive_jacobian.__file__).parent
LINE = re.compile(r'( *)([\w/]+\.py) +([\w.]+)')
QUALIFIED = sys.version_info >= (3, 11)
"""Whether the name of a function that is called has that of its class."""


def listed(what):
    """Return level, file and function of each line of a list of the page."""
    text = PAGE.read_text(encoding='utf-8')
    (block,) = re.findall(rf'<!-- {what} -->\n```text\n(.*?)```', text, re.DOTALL)
    lines = [LINE.match(line) for line in block.splitlines()]
    assert all(lines)
    names = [one[3] if QUALIFIED else one[3].split('.')[-1] for one in lines]
    return [(len(one[1]) // 4, one[2], name) for one, name in zip(lines, names, strict=True)]


def calls_during(run):
    """Return the functions of the package that are called, each with those above it.

    They are found out afterwards: a process that is waited for would not wait for that.
    """
    found = []

    def note(frame, event, _):
        if event == 'call':
            above = []
            while frame is not None:
                above.append(frame.f_code)
                frame = frame.f_back
            found.append(above)

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    return [[*map(function_of, above)] for above in found]


@cache
def function_of(code):
    """Return file and name of a function."""
    path = Path(code.co_filename)
    file = str(path.relative_to(PACKAGE)) if PACKAGE in path.parents else ''
    return file, (code.co_qualname if QUALIFIED else code.co_name).replace('.<locals>', '')


def test_an_odometry_takes_the_way_that_the_page_lists(lockstep):
    lockstep.add(VirtualRobot())
    lockstep.add(GoToGoal())
    goal = PoseStamped()
    goal.pose.position.x = goal.pose.position.y = 5.0
    lockstep.publish('goal_pose', goal)
    lockstep.run_for(2.0)
    page = listed('way')
    functions = {(file, name) for _, file, name in page}
    taken = [
        (sum(one in functions for one in above[1:]), *above[0])
        for above in calls_during(lambda: lockstep.run_for(0.02))
        if above[0] in functions
    ]
    assert taken == page, 'the way in doc/design.md is not that of a message'


class Talker(Node):
    def __init__(self):
        super().__init__('talker')
        self.publisher = self.create_publisher(String, 'chatter', 10)
        self.create_timer(0.1, lambda: self.publisher.publish(String()))


def test_a_message_between_any_two_nodes_passes_few_functions(lockstep):
    """Those that the page lists: they end when the other node has processed it, or lead to it."""
    lockstep.add(Talker())
    listener = lockstep.add(Node('listener'))
    listener.create_subscription(String, 'chatter', lambda message: None, 10)
    lockstep.run_for(0.95)
    calls = calls_during(lambda: lockstep.run_for(0.1))
    ours = [call[0] for call in calls if call[0][0]]
    (begin,) = [index for index, one in enumerate(ours) if one[1].endswith('send')]
    (end,) = [index for index, one in enumerate(ours) if one[1].endswith('receive')]
    page = [(file, name) for _, file, name in listed('way in lockstep')]
    assert ours[begin : end + 1] == page
    assert len(page) <= 10


ECHO = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

rclpy.init()
node = Node('echo')
publisher = node.create_publisher(String, 'answer', 10)
node.create_subscription(String, 'chatter', publisher.publish, 10)
rclpy.spin(node)
"""


@pytest.mark.process
def test_a_message_to_a_process_takes_the_way_that_the_page_lists(lockstep, tmp_path):
    program = tmp_path / 'echo.py'
    program.write_text(ECHO)
    lockstep.start([sys.executable, str(program)])
    lockstep.publish('chatter', String(data='first'))
    calls = calls_during(lambda: lockstep.publish('chatter', String(data='second')))
    assert lockstep.last('answer').data == 'second'
    left = [(file, name) for _, file, name in listed('way to a process')]
    for call in calls:
        if left and call[0] == left[0]:
            del left[0]
    assert left == []
