"""ROS nodes in simulated time, which advances only when every node has processed its inputs.

from diffdrive_jacobian.lockstep import Lockstep, LockstepError
"""

from diffdrive_jacobian.lockstep._errors import IneffectiveFaultsError, LockstepError, PropertyViolation
from diffdrive_jacobian.lockstep._fault_log import FaultEvent
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.lockstep.external.expectations import Answers, Every, Idle
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.lockstep.world import Lockstep

__all__ = [
    'Answers',
    'Every',
    'ExternalProcess',
    'FaultEvent',
    'Idle',
    'IneffectiveFaultsError',
    'Injection',
    'Lockstep',
    'LockstepError',
    'PropertyViolation',
]
