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

"""Every Jacobian and gradient of the library against central differences of the motion it describes."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from functools import cache

import numpy as np
import pytest

from diffdrive_jacobian import kinematics
from diffdrive_jacobian.kinematics import contact, diff_drive, se2, spatial
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.differentiation import numerical_jacobian
from diffdrive_jacobian.kinematics.inverse_kinematics import pose_difference
from diffdrive_jacobian.kinematics.mobile_manipulator import (
    MobileManipulator,
    mobile_manipulator_jacobian,
)
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm, arm_forward_kinematics, arm_jacobian
from diffdrive_jacobian.kinematics.spatial_arm import PANDA, SpatialArm

COUNT = 100
STEP = 1e-5


def differences(function, at=None):
    """Differentiate a function of (..., n) that gives (..., m); its third entry is an angle."""
    at = np.zeros((COUNT, 2)) if at is None else at
    steps, around = STEP * np.eye(at.shape[-1]), at[..., np.newaxis, :]
    change = function(around + steps) - function(around - steps)
    change[..., 2:] = se2.wrap_angle(change[..., 2:])
    return np.swapaxes(change, -1, -2) / (2.0 * STEP)


def gradient(function, at):
    return differences(lambda q: function(q)[..., np.newaxis], at)[:, 0]


# Each function yields derivatives: the name, what the library returns, and what differences give.


def of_a_drive(rng):
    pose = rng.uniform([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi], (COUNT, 3))
    theta = pose[:, 2]
    r, L = 10.0 ** rng.uniform([-2.0, -1.5], [0.0, 0.5], (COUNT, 2)).T
    d = rng.choice([-1.0, 1.0], COUNT) * 10.0 ** rng.uniform(-2.0, 0.0, COUNT)

    def steered(u):
        return se2.integrate(pose[:, np.newaxis], u, 1.0)

    def rolled(angles):
        """Turn the wheels by angles, right and left."""
        right, left = np.moveaxis(r[:, np.newaxis, np.newaxis] * angles, -1, 0)
        return steered(np.stack([(right + left) / 2.0, (right - left) / L[:, np.newaxis]], axis=-1))

    def twist(angles):
        return se2.log(se2.compose(se2.inverse(pose)[:, np.newaxis], rolled(angles)))[..., ::2]

    def one_wheel(angles):
        return steered(angles * np.stack([r, np.ones(COUNT)], axis=-1)[:, np.newaxis])

    def offset_point(angles):
        return diff_drive.offset_point(rolled(angles), d[:, np.newaxis])

    def position(angles):
        return rolled(angles)[..., :2]

    for name, arguments, numeric in (
        ('unicycle_jacobian', (theta,), differences(steered)),
        ('wheel_to_body_jacobian', (r, L), differences(twist)),
        ('body_to_wheel_jacobian', (r, L), np.linalg.inv(differences(twist))),
        ('wheel_to_world_jacobian', (theta, r, L), differences(rolled)),
        ('wheel_to_position_jacobian', (theta, r, L), differences(position)),
        ('single_wheel_jacobian', (theta, r), differences(one_wheel)),
        ('offset_point_jacobian', (theta, r, L, d), differences(offset_point)),
    ):
        yield f'diff_drive.{name}', getattr(diff_drive, name)(*arguments), numeric


def of_a_wheel(rng):
    r, q = 10.0 ** rng.uniform(-2.0, 0.0, COUNT), rng.uniform(-4.0, 4.0, (COUNT, 2))

    def point(q):
        return contact.wheel_contact_position(q[..., 0], q[..., 1], r[:, np.newaxis])

    jacobian = contact.wheel_contact_jacobian(q[:, 1], r)
    yield 'contact.wheel_contact_jacobian', jacobian, differences(point, q)


def of_exp(rng):
    t = rng.uniform(-4.0, 4.0, (COUNT, 3))
    back = se2.inverse(se2.exp(t))[:, np.newaxis]

    def before(d):
        return se2.log(se2.compose(se2.exp(t[:, np.newaxis] + d), back))

    def behind(d):
        return se2.log(se2.compose(back, se2.exp(t[:, np.newaxis] + d)))

    yield 'se2.left_jacobian', se2.left_jacobian(t), differences(before, np.zeros((COUNT, 3)))
    yield 'se2.right_jacobian', se2.right_jacobian(t), differences(behind, np.zeros((COUNT, 3)))


def of_arms(rng):
    for links in (1, 2, 5):
        arm, q = PlanarArm(rng.uniform(0.1, 1.0, links)), rng.uniform(-4.0, 4.0, (COUNT, links))
        J, numeric = arm.jacobian(q, heading=True), differences(arm.forward_kinematics, q)
        yield 'planar_arm.PlanarArm.jacobian', J, numeric
        parallel = SpatialArm(arm.lengths, 0.0, 0.0).jacobian(q)[:, [0, 1, 5]]
        yield 'spatial_arm.SpatialArm.jacobian', parallel, numeric
        yield 'planar_arm.PlanarArm.jacobian', arm.jacobian(q), numeric[:, :2]
        other = differences(lambda q, arm=arm: arm_forward_kinematics(arm.lengths, q), q)
        yield 'planar_arm.arm_jacobian', arm_jacobian(arm.lengths, q), other[:, :2]
        found = numerical_jacobian(arm.forward_kinematics, q[:10], difference=pose_difference)
        yield 'differentiation.numerical_jacobian', found, J[:10]


def of_errors_in_space(rng):
    q = rng.uniform(-1.5, 1.5, (COUNT, 7))
    # The rotations that are left are up to half a turn.
    target = spatial.pose_vector(PANDA.forward_kinematics(q + rng.uniform(-1.2, 1.2, (COUNT, 7))))
    for frame, of, jacobian in (
        ('base', spatial.pose_vector_difference, spatial.pose_vector_difference_jacobian),
        ('end', spatial.pose_vector_displacement, spatial.spatial_displacement_jacobian),
    ):

        def error(q, target=target[:, np.newaxis], of=of):
            return of(target, spatial.pose_vector(PANDA.forward_kinematics(q)))

        found = jacobian(error(q[:, np.newaxis])[:, 0], PANDA.jacobian(q, frame))
        yield f'spatial.{jacobian.__name__}', found, -differences(error, q)


def of_mobile_manipulators(rng):
    for links, mount in ((1, (0.0, 0.0)), (3, (0.12, -0.07))):
        arm = PlanarArm(rng.uniform(0.1, 1.0, links))
        robot = MobileManipulator(r=0.05, L=0.3, arm=arm, mount=mount)
        q = rng.uniform(-3.0, 3.0, (COUNT, 3 + links))

        def moved(q_dot, robot=robot, q=q):
            return robot.integrate(q[:, np.newaxis], q_dot, 1.0)

        def tip(q_dot, robot=robot, moved=moved):
            return robot.forward_kinematics(moved(q_dot))

        still = np.zeros((COUNT, 2 + links))
        numeric, name = differences(tip, still), 'mobile_manipulator.MobileManipulator'
        yield f'{name}.jacobian', robot.jacobian(q, heading=True), numeric
        yield f'{name}.jacobian', robot.jacobian(q), numeric[:, :2]
        yield (
            f'{name}.configuration_jacobian',
            robot.configuration_jacobian(q),
            differences(moved, still),
        )
        jacobian = mobile_manipulator_jacobian(arm.lengths, q[:, 2], q[:, 3:], mount, 0.05, 0.3)
        yield 'mobile_manipulator.mobile_manipulator_jacobian', jacobian, numeric


def of_secondary_tasks(rng):
    for links, heading in ((2, False), (3, False), (4, True)):
        arm, q = PlanarArm(rng.uniform(0.3, 1.0, links)), rng.uniform(-4.0, 4.0, (COUNT, links))
        if links == 2:  # The measure has an edge where the arm is singular.
            q[:, 1] = rng.choice([-1.0, 1.0], COUNT) * rng.uniform(0.1, 3.0, COUNT)

        def jacobian(q, arm=arm, heading=heading):
            return arm.jacobian(q, heading=heading)

        def manipulability(q, jacobian=jacobian):
            J = jacobian(q)
            return np.sqrt(np.linalg.det(J @ np.swapaxes(J, -1, -2)))

        found = iv.manipulability_gradient(jacobian, q)
        yield 'inverse_velocity.manipulability_gradient', found, gradient(manipulability, q)
    q, lower = rng.uniform(-4.0, 4.0, (2, COUNT, 5))
    upper = lower + rng.uniform(0.1, 6.0, (COUNT, 5))
    limits = lower[:, np.newaxis], upper[:, np.newaxis]
    numeric = gradient(lambda q: iv.joint_limit_cost(q, *limits), q)
    yield 'inverse_velocity.joint_limit_gradient', iv.joint_limit_gradient(q, lower, upper), numeric
    # Not folded, and obstacles beside elbows and tip: no joint moves the base.
    arm, q = PlanarArm(rng.uniform(0.3, 1.0, 3)), rng.uniform(-0.8, 0.8, (COUNT, 3))
    obstacle = arm.joint_positions(q)[range(COUNT), rng.integers(1, 4, COUNT)]
    obstacle += rng.uniform(-0.1, 0.1, (COUNT, 2))
    numeric = gradient(lambda q: arm.clearance(q, obstacle[:, np.newaxis]), q)
    yield 'planar_arm.PlanarArm.clearance_gradient', arm.clearance_gradient(q, obstacle), numeric


MODELS = (
    of_a_drive,
    of_a_wheel,
    of_exp,
    of_arms,
    of_errors_in_space,
    of_mobile_manipulators,
    of_secondary_tasks,
)


@cache
def derivatives(model):
    return list(model(np.random.default_rng(1)))


@pytest.mark.parametrize('model', MODELS)
def test_it_is_the_derivative_of_the_motion(model):
    for name, found, numeric in derivatives(model):
        assert found.shape == numeric.shape, name
        rows, error = (one.reshape(len(found), -1) for one in (found, found - numeric))
        assert np.all(np.linalg.norm(error, axis=1) < 1e-6 * np.linalg.norm(rows, axis=1)), name


def derivatives_of_the_library():
    """Find every public function and method that is named as a derivative."""
    for info in pkgutil.walk_packages(kinematics.__path__, f'{kinematics.__name__}.'):
        members = vars(importlib.import_module(info.name))
        own = {name: m for name, m in members.items() if getattr(m, '__module__', None) == info.name}
        for name, member in list(own.items()):
            if inspect.isclass(member):
                own.update({f'{name}.{method}': m for method, m in vars(member).items()})
        for name in own:
            public = not any(part.startswith('_') for part in name.split('.'))
            if public and ('jacobian' in name.lower() or 'gradient' in name.lower()):
                yield f'{info.name.removeprefix(kinematics.__name__)}.{name}'[1:]


def test_no_jacobian_and_no_gradient_is_missing_here():
    tested = {name for model in MODELS for name, _, _ in derivatives(model)}
    assert set(derivatives_of_the_library()) == tested


@pytest.mark.parametrize(
    ('r', 'q', 'message'),
    [
        (lambda q: q, 0.0, r'^q must have shape'),
        (lambda q: q * np.nan, [1.0], r'^r\(q\) must be finite'),
        (lambda q: [q], [1.0], r'^r\(q\) must have one shape \(m,\), got \(1, 1\)'),
        (lambda q: np.ones(1 + (q[0] > 0.0)), [0.0], r'^r\(q\) must have one shape'),
    ],
)
def test_only_functions_from_vectors_to_vectors_are_differentiated(r, q, message):
    with pytest.raises(ValueError, match=message):
        numerical_jacobian(r, q)
