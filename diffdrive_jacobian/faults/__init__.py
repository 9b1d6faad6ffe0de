"""Faults that a `Lockstep` injects: of topics, nodes, and the world around them.

from diffdrive_jacobian.testing import faults

world.inject(faults.Loss('odom', probability=0.5, start=2.0, duration=1.0))
"""

from diffdrive_jacobian.faults.fault import Fault, Filter, TopicFault
from diffdrive_jacobian.faults.nodes import Hang, Kill, NodeFault, Slow, TimerJitter
from diffdrive_jacobian.faults.topics import Delay, Duplicate, Loss, RateLimit, Reorder, Stale
from diffdrive_jacobian.faults.world import ClockPause, LateService, ParameterChange, TimeJump
from diffdrive_jacobian.lockstep import FaultEvent

__all__ = [
    'ClockPause',
    'Delay',
    'Duplicate',
    'Fault',
    'FaultEvent',
    'Filter',
    'Hang',
    'Kill',
    'LateService',
    'Loss',
    'NodeFault',
    'ParameterChange',
    'RateLimit',
    'Reorder',
    'Slow',
    'Stale',
    'TimeJump',
    'TimerJitter',
    'TopicFault',
]
