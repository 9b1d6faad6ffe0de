"""Faults that a `Lockstep` injects: of topics, nodes, the world around them, and the robot.

With `from diffdrive_jacobian import faults`, a test calls
`lockstep.inject(faults.Loss('odom', probability=0.5, start=2.0, duration=1.0))`.
"""

from diffdrive_jacobian.faults.fault import Fault, Filter, TopicFault
from diffdrive_jacobian.faults.robot import (
    ActuatorLag,
    DeadWheel,
    EncoderSteps,
    Push,
    RobotFault,
    SaturatedWheel,
    Slip,
    WrongGeometry,
)
from diffdrive_jacobian.faults.topics import Corrupt, Delay, Duplicate, Loss, RateLimit, Reorder, Stale
from diffdrive_jacobian.faults.world import (
    ClockPause,
    Hang,
    Kill,
    LateService,
    NodeFault,
    ParameterChange,
    Slow,
    TimeJump,
    TimerJitter,
)
from diffdrive_jacobian.lockstep._fault_log import FaultEvent
from diffdrive_jacobian.lockstep._injection import Injection

__all__ = [
    'ActuatorLag',
    'ClockPause',
    'Corrupt',
    'DeadWheel',
    'Delay',
    'Duplicate',
    'EncoderSteps',
    'Fault',
    'FaultEvent',
    'Filter',
    'Hang',
    'Injection',
    'Kill',
    'LateService',
    'Loss',
    'NodeFault',
    'ParameterChange',
    'Push',
    'RateLimit',
    'Reorder',
    'RobotFault',
    'SaturatedWheel',
    'Slip',
    'Slow',
    'Stale',
    'TimeJump',
    'TimerJitter',
    'TopicFault',
    'WrongGeometry',
]
