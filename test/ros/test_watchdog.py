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

"""The timeout of a node where lockstep cannot show it. The other tests are those of the nodes."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from support.lockstep_nodes import SECOND

from diffdrive_jacobian.ros.watchdog import Watchdog


def test_a_change_to_earlier_times_is_a_timeout(ros):
    """It is no jump of the clock: what the node was fed last is in the future."""
    node, barks = ros.add(Node, node_name='watched'), []
    clock = node.get_clock()
    watchdog = Watchdog(node, lambda: barks.append(clock.now().nanoseconds))
    watchdog.start(60 * SECOND)
    assert node.set_parameters([Parameter('use_sim_time', value=True)])[0].successful
    source = ros.talk(Clock, '/clock')
    for seconds in (5, 100):
        message = Clock()
        message.clock.sec = seconds
        source.publish(message)
        ros.until(lambda at=seconds: clock.now().nanoseconds == at * SECOND, 'the time')
    ros.until(lambda: barks, 'the timeout')
    assert barks == [100 * SECOND]
