"""A virtual differential-drive robot for ROS 2, driven through the mobile-robot Jacobian.

`__all__` names the public packages and modules. A package or module that a public one names in its
`__all__` is public, too. Everything else is internal and may change without notice.
"""

__all__ = [
    'bags',
    'calibration',
    'control',
    'drives',
    'errors',
    'faults',
    'grading',
    'kinematics',
    'nodes',
    'numerics',
    'plots',
    'properties',
    'recording',
    'relations',
    'simulation',
    'testing',
]

__version__ = '0.1.0'
