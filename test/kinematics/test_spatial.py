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

"""The displacement between two poses in space."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.spatial import spatial_displacement


def transform(p, vector):
    """Return homogeneous transforms from positions and rotation vectors, by Rodrigues' formula."""
    theta = np.linalg.norm(vector, axis=-1)[..., np.newaxis, np.newaxis]
    K = np.cross(np.eye(3), (vector / np.where(theta > 0.0, theta, 1.0)[..., 0])[..., np.newaxis, :])
    T = np.zeros((*theta.shape[:-2], 4, 4))
    T[..., :3, :3] = np.eye(3) + np.sin(theta) * K + (1.0 - np.cos(theta)) * K @ K
    T[..., :3, 3], T[..., 3, 3] = p, 1.0
    return T


@pytest.mark.parametrize('theta', [0.0, 1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-9, np.pi])
def test_the_displacement_leads_from_one_pose_to_the_other(theta):
    rng = np.random.default_rng(1)
    t, axis = rng.normal(size=(2, 200, 3))
    vector = theta * axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    here = transform(rng.normal(size=(200, 3)), rng.normal(size=(200, 3)))
    delta = spatial_displacement(here, here @ transform(t, vector))
    np.testing.assert_allclose(delta[:, :3], t, atol=1e-14)
    # Half a turn one way or the other is the same.
    side = np.sign(np.sum(delta[:, 3:] * vector, axis=-1, keepdims=True)) if theta == np.pi else 1.0
    np.testing.assert_allclose(side * delta[:, 3:], vector, atol=1e-14)


def test_in_the_plane_it_is_that_of_se2():
    here, there = np.random.default_rng(2).uniform(-3.0, 3.0, (2, 100, 3))
    delta = spatial_displacement(se2.homogeneous_3d(here), se2.homogeneous_3d(there))
    plane = se2.compose(se2.inverse(here), there)
    np.testing.assert_allclose(delta[:, [0, 1, 5]], plane, atol=1e-13)
    assert not delta[:, 2:5].any()


@pytest.mark.parametrize('bad', [np.zeros((4, 4)), 2.0 * np.eye(4), np.diag([1.0, 1, -1, 1]), [[1.0]]])
def test_what_is_no_rigid_motion_is_refused(bad):
    with pytest.raises(ValueError, match=r'^T_desired must (be \[\[R, p\]|have shape)'):
        spatial_displacement(np.eye(4), bad)
