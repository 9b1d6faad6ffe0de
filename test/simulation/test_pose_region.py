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

"""The region that holds the robot: its level, its coverage, its limits, and how plot_run draws it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.moments_reference import DRIVES, noisy_runs, reported_path
from support.runs import built_run, series

from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.uncertainty import ELLIPSE, ELLIPSE_LABEL, REGION_LABEL, uncertainties
from diffdrive_jacobian.simulation import Robot, RobotModel
from diffdrive_jacobian.simulation.exact_moments import gaussian, propagate_moments
from diffdrive_jacobian.simulation.pose_region import (
    ELLIPSE_LEVEL,
    Region,
    log_about,
    region_distance,
    region_of,
    sampled_errors,
)

L, K = 0.16, 1e-5
NONE = np.zeros((3, 3))
SECOND = 10**9


def share_within(region, drive, covariance=NONE):
    """Of 2,000 noisy robots; its standard error is 0.5 %."""
    errors = noisy_runs(np.random.default_rng(5), drive, covariance, 2000, L, K)
    return np.mean(region_distance(region, region.pose[:2] + errors[:, :2]) <= region.level)


@pytest.mark.parametrize(('name', 'duration'), [('straight', 60.0), ('stop and go', 10.0)])
def test_the_region_holds_95_percent_of_two_thousand_other_runs(name, duration):
    drive = DRIVES[name](duration)
    poses, noise = reported_path(drive, L, K)
    *_, errors = sampled_errors(poses, noise, NONE)
    assert 0.94 <= share_within(region_of(poses[-1], errors), drive) <= 0.96
    # The runs that are drawn have the exact second moment.
    moments, pose = gaussian(NONE), np.zeros(3)
    for twist, seconds in drive:
        moments = propagate_moments(moments, pose, twist, seconds, L, K)
        pose = se2.integrate(pose, twist, seconds)
    deviations = np.sqrt(np.diag(moments.second_moment))
    error = errors.T @ errors / len(errors) - moments.second_moment
    # The standard error of an entry is sqrt(2 / 4000) of the deviations' product.
    assert np.all(np.abs(error) < 0.1 * np.outer(deviations, deviations))


def test_exponential_coordinates_are_those_of_log():
    rng = np.random.default_rng(1)
    pose, errors = np.array([3.0, -2.0, 2.5]), rng.normal(0.0, [1.0, 1.0, 0.7], (50, 3))
    expected = se2.log(se2.compose(se2.inverse(pose), pose + errors))
    np.testing.assert_allclose(log_about(pose, errors), expected, atol=1e-12)


def test_a_distance_is_the_least_over_all_headings():
    """A region with an unsure heading, by brute force."""
    covariance = np.array([[0.01, 0.0, 0.0], [0.0, 0.3, 0.2], [0.0, 0.2, 0.25]])
    region = Region(np.array([1.0, 2.0, 0.6]), covariance, ELLIPSE_LEVEL)
    inverted = np.linalg.inv(covariance)
    for position in np.random.default_rng(3).normal([1.0, 2.0], 0.4, (8, 2)):
        turned = np.linspace(-2.0, 2.0, 10_001)
        errors = np.column_stack([np.tile(position - region.pose[:2], (len(turned), 1)), turned])
        xi = log_about(region.pose, errors)
        least = np.einsum('ni,ij,nj->n', xi, inverted, xi).min()
        assert region_distance(region, position) == pytest.approx(least, rel=0.01, abs=1e-3)


def test_without_any_uncertainty_only_the_pose_is_inside():
    region = region_of(np.array([1.0, 2.0, 0.3]), np.zeros((10, 3)))
    assert region_distance(region, [[1.0, 2.0], [1.0, 2.1]]).tolist() == [0.0, math.inf]


def test_a_wrong_argument_is_named():
    for poses, noise, covariance, words in (
        (np.zeros((3, 3)), np.zeros((3, 3)), NONE, 'poses and noise must have shapes'),
        (np.zeros((3, 3)), -np.ones((2, 3)), NONE, 'noise must have variances'),
        (np.zeros((3, 3)), np.zeros((2, 3)), -np.eye(3), 'covariance must be symmetric'),
        (np.full((3, 3), np.nan), np.zeros((2, 3)), NONE, 'poses must be finite'),
    ):
        with pytest.raises(ValueError, match=words):
            list(sampled_errors(poses, noise, covariance))


# --- In the figure


def driven(drive, rate=20, covariance=NONE):
    """Return a run as read from a bag of a virtual robot."""
    robot, stamp = Robot(model=RobotModel(), stamp=0, pose=np.zeros(3), covariance=covariance), 0
    rows, covariances, stamps = [], [], []
    for twist, duration in drive:
        robot = robot.commanded(twist, stamp)
        for _ in range(int(duration * rate)):
            stamp += SECOND // rate
            now = robot.at(stamp)
            rows.append([*now.pose_tuple, *now.twist])
            of_twist = now.twist_covariance_tuple(1.0 / rate)
            covariances.append([*now.moments[:6], *of_twist[:2], of_twist[3]])
            stamps.append(stamp)
    run = built_run(odometry=series('odometry', stamps, rows))
    return replace(run, odometry_covariances=np.array(covariances))


def test_the_regions_along_a_path_hold_95_percent_of_the_robots():
    covariance = np.diag([0.01, 0.01, 0.04])
    drive = [((0.22, 0.3), 6.0), ((0.0, 0.0), 1.0), ((0.22, -0.1), 10.0)]
    found = uncertainties(timeline(driven(drive, covariance=covariance)), places=2)
    assert len(found) == 2
    last = found[-1]
    assert 0.94 <= share_within(last.region, drive, covariance) <= 0.96
    assert np.all(last.extent[0] < last.region.pose[:2])
    assert np.all(last.region.pose[:2] < last.extent[1])


def test_the_figure_has_the_region_and_the_ellipse():
    drawn = run_figure(driven([((0.22, 0.0), 2.0)], rate=5))
    labels = [text.get_text() for text in drawn.legends[0].get_texts()]
    assert REGION_LABEL in labels
    # Where it says the same it is not drawn.
    assert ELLIPSE_LABEL not in labels
    assert not [one for one in drawn.axes[0].lines if one.get_color() == ELLIPSE]
    far = run_figure(driven([((0.22, 0.0), 10.0)], rate=5))
    assert ELLIPSE_LABEL in [text.get_text() for text in far.legends[0].get_texts()]
    assert [one for one in far.axes[0].lines if one.get_color() == ELLIPSE]


def test_covariances_that_are_not_of_wheels_are_not_drawn():
    run = driven([((0.22, 0.0), 1.0)], rate=10)
    assert uncertainties(timeline(run))
    constant = np.tile(run.odometry_covariances[-1], (len(run.odometry), 1))
    not_of_wheels = [constant, np.empty((0, 9))]
    for entry, columns in ((math.nan, (0, 3, 5, 6, 8)), (-1.0, (0, 3, 5, 6, 8)), (0.0, (5, 8))):
        for column in columns:
            changed = run.odometry_covariances.copy()
            changed[:, column] = entry
            not_of_wheels.append(changed)
    for covariances in not_of_wheels:
        assert not uncertainties(timeline(replace(run, odometry_covariances=covariances)))
