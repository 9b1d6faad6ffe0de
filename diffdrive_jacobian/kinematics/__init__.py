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

"""Jacobians and motions of wheeled robots and arms: pure functions over NumPy arrays, no ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.kinematics import (
        contact,
        diff_drive,
        differentiation,
        inverse_kinematics,
        inverse_velocity,
        mobile_manipulator,
        planar_arm,
        rigid_body,
        se2,
        spatial,
        spatial_arm,
    )
    from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator as MobileManipulator
    from diffdrive_jacobian.kinematics.planar_arm import PlanarArm as PlanarArm
    from diffdrive_jacobian.kinematics.spatial_arm import SpatialArm as SpatialArm

__all__ = [
    'contact',
    'diff_drive',
    'differentiation',
    'inverse_kinematics',
    'inverse_velocity',
    'mobile_manipulator',
    'planar_arm',
    'rigid_body',
    'se2',
    'spatial',
    'spatial_arm',
]
if not TYPE_CHECKING:
    # Nodes, which need few of them, start faster than with all.
    _MODULES = {name: f'kinematics.{name}' for name in __all__}
    # Short paths of the classes, which are listed under their modules.
    _CLASSES = {
        'MobileManipulator': 'kinematics.mobile_manipulator',
        'PlanarArm': 'kinematics.planar_arm',
        'SpatialArm': 'kinematics.spatial_arm',
    }
    __getattr__, __dir__ = lazy.attach(__name__, _MODULES | _CLASSES)
