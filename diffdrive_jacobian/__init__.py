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
