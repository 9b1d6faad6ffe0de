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

"""Names that do not exist, or are public elsewhere. The type checker must refuse each.

Comments that it does not need are errors.
"""

from diffdrive_jacobian import (
    exploration,
    kinematics,
    lockstep,
    properties,
    simulation,
    testing,
)

NAMES = [
    kinematics.se3,  # type: ignore[attr-defined]
    simulation.close_loops,  # type: ignore[attr-defined]
    testing.explor,  # type: ignore[attr-defined]
    # Public in testing, and in the package itself.
    exploration.explore,  # type: ignore[attr-defined]
    lockstep.Lockstep,  # type: ignore[attr-defined]
    properties.PropertyViolation,  # type: ignore[attr-defined]
    kinematics.PlanarChain,  # type: ignore[attr-defined]
    testing.faults,  # type: ignore[attr-defined]
]
