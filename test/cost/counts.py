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

"""Count what is executed for one message: calls, bytecodes, functions and files.

`python counts.py WHAT` prints JSON. It is a process of its own: pytest rewrites assertions of the
package. Counts do not depend on the speed of the machine. Only what nodes do once a second of wall time,
the checks of the graph, is left out.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import diffdrive_jacobian

# Its folder, not its name: that of the clone is often the same, and environments are below it.
PACKAGE = os.path.dirname(diffdrive_jacobian.__file__) + os.sep
QUIET = ['--ros-args', '--log-level', 'error']


class Counted:
    """Counts of one thread, without the checks of the graph."""

    def __init__(self) -> None:
        self.counts: Counter[Any] = Counter()
        self._left_out = 0

    def calls(self, work: Callable[[], object]) -> Counter[Any]:
        """Return how often each function of Python is called."""
        sys.setprofile(self._on_call)
        work()
        sys.setprofile(None)
        return self.counts

    def bytecodes(self, work: Callable[[], object]) -> Counter[Any]:
        """Return how many bytecodes each function executes."""
        # Python 3.12 asks the frame in which the tracing begins.
        sys._getframe().f_trace_opcodes = True
        sys.settrace(self._on_frame)
        work()
        sys.settrace(None)
        return self.counts

    def _on_call(self, frame: FrameType, event: str, _: Any) -> None:
        if frame.f_code.co_name == '_check_graph':
            self._left_out += {'call': 1, 'return': -1}.get(event, 0)
        elif event == 'call' and not self._left_out:
            self.counts[frame.f_code] += 1

    def _on_frame(self, frame: FrameType, event: str, _: Any) -> Any:
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if frame.f_code.co_name == '_check_graph':
            self._left_out += {'call': 1, 'return': -1}.get(event, 0)
        elif event == 'opcode' and not self._left_out:
            self.counts[frame.f_code] += 1
        return self._on_frame


def per_message(count: Callable[[str], Counter[Any]], messages: int) -> dict[str, float]:
    """Return the figures of a table for `messages` messages, counted once for each figure."""
    calls, bytecodes = count('calls'), count('bytecodes')
    with_each = [
        code
        for code, number in calls.items()
        if code.co_filename.startswith(PACKAGE) and number >= 0.9 * messages
    ]
    return {
        'calls': sum(calls.values()) / messages,
        'bytecodes': sum(bytecodes.values()) / messages,
        'functions': len(with_each),
        'files': len({code.co_filename for code in with_each}),
    }


def _nodes() -> tuple[Any, Any, Any]:
    """Return robot and controller, and a goal that is not reached."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.parameter import Parameter

    from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
    from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

    goal = PoseStamped()
    goal.pose.position.x = goal.pose.position.y = 5e5
    limit = Parameter('linear.x.max_velocity', value=0.2)
    robot = VirtualRobot(parameter_overrides=[Parameter('publish_rate', value=50.0)])
    return robot, GoToGoal(parameter_overrides=[limit]), goal


def lockstep() -> dict[str, float]:
    """Return the figures for one odometry message of robot and controller in lockstep."""
    from diffdrive_jacobian.testing import Lockstep

    with Lockstep(QUIET) as world:
        robot, controller, goal = _nodes()
        world.add(robot)
        world.add(controller)
        world.publish('goal_pose', goal)
        world.run_for(2.0)
        return per_message(lambda what: getattr(Counted(), what)(lambda: world.run_for(2.0)), 100)


def executor() -> dict[str, float]:
    """Return the figures for one odometry message of both nodes on the executor of their programs.

    Here time passes by itself: only what is executed in callbacks is counted.
    """
    from diffdrive_jacobian.messages.codecs import Route
    from diffdrive_jacobian.ros.runner import make_executor, ros_context

    with ros_context(['counts', *QUIET], default=True) as context:
        robot, controller, _ = _nodes()
        spinner: Any = make_executor(context, isolated=False)
        for node in (robot, controller):
            spinner.add_node(node)
        # As if a client had sent it.
        controller._on_pose(Route((0, 0), '', ((5e5, 5e5, 0.0),)))
        ticks, tick = 0, robot._timer.callback

        def counting() -> None:
            nonlocal ticks
            ticks += 1
            tick()

        robot._timer.callback = counting

        def spin(until: int) -> None:
            nonlocal ticks
            ticks = 0
            while ticks < until:
                spinner.spin_once(timeout_sec=0.1)

        spin(20)
        figures = per_message(lambda what: _own(getattr(Counted(), what)(lambda: spin(50))), 50)
        spinner.shutdown()
        for node in (robot, controller):
            node.destroy_node()
        return figures


def _own(counts: Counter[Any]) -> Counter[Any]:
    """Return the counts of functions of the package, without those that wait."""
    waiting = f'ros{os.sep}guarded_executor.py'
    return Counter(
        {
            code: number
            for code, number in counts.items()
            if code.co_filename.startswith(PACKAGE) and not code.co_filename.endswith(waiting)
        }
    )


def batch() -> dict[str, float]:
    """Return the figures for one step of a batch of closed loops."""
    import numpy as np

    from diffdrive_jacobian.control import VelocityLimits, go_to_goal
    from diffdrive_jacobian.simulation import closed_loops

    def drive(seconds: float) -> None:
        starts = np.zeros((100, 3))
        limits = VelocityLimits(max_v=0.2)
        closed_loops(go_to_goal, starts, [5e5, 5e5], 3.0, 0.5, duration=seconds, limits=limits)

    def count(what: str) -> Counter[Any]:
        longer, shorter = (getattr(Counted(), what)(lambda s=s: drive(s)) for s in (3.0, 1.0))
        return longer - shorter

    drive(1.0)
    return per_message(count, 100)


def imports() -> dict[str, float]:
    """Return how many modules of the package and in all the start of a program imports."""
    program, before = os.environ['PROGRAM'], set(sys.modules)
    from diffdrive_jacobian.ros.runner import ros_context
    from diffdrive_jacobian.tools.run_node import NODES

    module = importlib.import_module(f'diffdrive_jacobian.nodes.{program}')
    with ros_context(['counts', *QUIET], default=True):
        getattr(module, NODES[program].class_name)().destroy_node()
    own = [name for name in sys.modules if name.partition('.')[0] == 'diffdrive_jacobian']
    return {'own modules': len(own), 'modules': len(set(sys.modules) - before)}


if __name__ == '__main__':
    print(json.dumps(globals()[sys.argv[1]]()))
    sys.stdout.flush()
    os._exit(0)
