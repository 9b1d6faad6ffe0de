"""What a tester requires of a controller who does not know its defects: the same of all of them."""

from __future__ import annotations

import math

from defective_controllers import CONTROLLERS, MAX_OMEGA, MAX_V
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from diffdrive_jacobian.messages.conversion import set_time
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import (
    AccelerationWithin,
    ArrivesOnceFaultsEnd,
    KeepsDriving,
    NeverFasterThan,
    NoCommandAfterCancel,
    NoStaleGoals,
    PoseFinite,
    StatusProtocol,
    StaysWithin,
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    StopsOnShutdown,
    end_of_faults,
)

LAST_EVENT = 6.0
"""Time at which all faults have ended, and all goals were sent (s)."""
DRIVE = 10.0
"""Longest time to reach a goal (s)."""
PROPERTIES = (
    NeverFasterThan(MAX_V, MAX_OMEGA),
    AccelerationWithin(1.2, 9.6, slack=0.15),
    StopsAfterLostOdometry(0.7),
    StopsAfterLastCommand(0.6),
    StopsOnShutdown(),
    NoCommandAfterCancel(),
    StatusProtocol(),
    NoStaleGoals(),
    ArrivesOnceFaultsEnd(DRIVE, tolerance=0.1),
    KeepsDriving(2.0, tolerance=0.1),
    PoseFinite(),
    StaysWithin((-10.0, 10.0), (-10.0, 10.0)),
)


def drive(world, case):
    """Send goals to a controller, cancel them, and shut it down.

    The case has the name of the `controller`, the `start` of the robot, `goals` as a list of a time and
    a position each, and the times of `cancel` and `shutdown`, or None.
    """
    x, y, theta = case['start']
    values = {'x': x, 'y': y, 'theta': theta, 'publish_rate': 20.0}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    world.create(lambda: VirtualRobot(parameter_overrides=overrides))
    world.create(CONTROLLERS[case['controller']])
    goals = world.node.create_publisher(PoseStamped, 'goal_pose', 10)
    cancel = world.node.create_client(Trigger, 'cancel_goal')

    def send(position):
        message = PoseStamped()
        message.pose.position.x, message.pose.position.y = position
        message.pose.orientation.w = 1.0
        set_time(message.header.stamp, world.now)
        goals.publish(message)

    def shut_down():
        for node in world.nodes:
            if node.get_name() == 'controller':
                node.destroy_node()

    events = [(time, lambda position=position: send(position)) for time, position in case['goals']]
    if case['cancel'] is not None:
        events.append((case['cancel'], lambda: cancel.call_async(Trigger.Request())))
    if case['shutdown'] is not None:
        events.append((case['shutdown'], shut_down))
    for time, act in sorted(events, key=lambda event: event[0]):
        run_to(world, time)
        act()
        world.settle()
    end = max(LAST_EVENT, end_of_faults(world))
    if end == math.inf:
        # Nothing is due then.
        end = LAST_EVENT
    run_to(world, LAST_EVENT + 1.0 if case['shutdown'] is not None else end + DRIVE + 0.2)


def run_to(world, time):
    """Advance to a world time (s)."""
    if (left := time - world.world_time / 1e9) > 0.0:
        world.run_for(left)
