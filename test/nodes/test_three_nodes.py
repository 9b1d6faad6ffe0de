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

"""All three nodes together, in lockstep: the whole Jacobian chain, several robots, and lost nodes."""

from __future__ import annotations

import math

from geometry_msgs.msg import Twist
from support.lockstep_nodes import (
    ACCEPTED,
    EXECUTING,
    QUICK,
    SUCCEEDED,
    Topics,
    add_team,
    arrives,
)
from support.ros_messages import at_rest, goal, pose_of, twists

from diffdrive_jacobian.testing import Lockstep


def test_golden_case_of_document_a_through_the_topics(lockstep):
    topics = Topics(lockstep)
    add_team(lockstep)
    lockstep.publish('goal_pose', goal(1.0, 1.0))
    lockstep.step()
    (command,) = twists(topics.commands)
    assert (round(command[0], 3), round(command[1], 3)) == (0.500, 2.356)
    assert list(topics.states[-1].velocity) == [0.0, 0.0]
    lockstep.step()
    left, right = topics.states[-1].velocity
    assert (round(right, 3), round(left, 3)) == (20.864, 9.440)


def test_robot_arrives_and_stands(lockstep):
    topics, start, target = Topics(lockstep), (-1.0, 0.5, -2.0), (-1.0, -1.0)
    add_team(lockstep, pose=start, **QUICK)
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    arrives(lockstep, topics)
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    # Each odometry on the way is answered by one command; only the last of them is zero.
    along = [math.dist(pose_of(one)[:2], target) for one in topics.odom]
    there = next(i for i, distance in enumerate(along) if distance <= 0.02)
    assert len(topics.commands) == there + 1
    assert [i for i, command in enumerate(topics.commands) if command == Twist()] == [there]
    # And there it stands.
    assert all(one.pose == topics.odom[there].pose for one in topics.odom[there:])
    assert all(map(at_rest, topics.odom[there + 1 :]))
    assert len(topics.odom) > there + 3


def driven(names, targets):
    """Drive teams in a world of their own; return all that they publish."""
    with Lockstep() as world:
        topics = [Topics(world, name) for name in names]
        for name in names:
            add_team(world, name, **QUICK)
        for name, target in zip(names, targets, strict=True):
            world.publish(f'{name}/goal_pose', goal(*target))
        world.run_for(0.6)
        return [(one.odom, one.states, one.applied, one.commands, one.statuses) for one in topics]


def test_robots_in_company_drive_as_each_drives_alone_to_the_last_bit():
    names, targets = ['robot_0', 'robot_1'], [(0.3, 0.1), (-0.2, 0.3)]
    together = driven(names, targets)
    assert [one[-1][-1] for one in together] == [SUCCEEDED] * 2
    assert len(together[0][0]) == 31
    assert together[0][0][-1].pose != together[1][0][-1].pose
    for name, target, published in zip(names, targets, together, strict=True):
        assert driven([name], [target]) == [published]
