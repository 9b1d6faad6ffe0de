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

"""Faults of a recorded lockstep world, marked in the figure."""

from __future__ import annotations

import json

import numpy as np
import pytest
from geometry_msgs.msg import Twist, Vector3
from std_msgs.msg import String
from support.bags import write_bag
from support.ros_messages import goal
from support.runs import run_of, sample

from diffdrive_jacobian.bags.run import read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.faults import Push, TimeJump
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.run_lines import commanded, measured
from diffdrive_jacobian.plots.run_panels import NAMED, ViolationMark, fault_spans
from diffdrive_jacobian.testing.recorded_run import RecordedRun


def event(at, fault, what):
    return at, '/fault_events', String(data=json.dumps({'time': at, 'fault': fault, 'what': what}))


def labels(drawing):
    """Return what the legend says of faults, which is Python."""
    texts = (text.get_text() for legend in drawing.legends for text in legend.get_texts())
    return [one for one in texts if one.endswith((')', 'more faults'))]


def test_faults_are_bands_over_time_and_many_are_counted(tmp_path):
    loss, kill = "Loss('odom', start=1.0, duration=0.5)", "Kill('robot', start=2.0)"
    events = [
        event(11.0, loss, 'begins'),
        event(11.2, loss, 'messages 1 to 9 of /odom to /controller lost'),
        event(11.5, loss, 'ends: 25 of 25 messages of /odom to /controller'),
        event(12.0, kill, 'begins'),
        event(12.0, kill, '/robot is killed'),
    ]
    # It begins at 10 s and takes four seconds.
    run = run_of(tmp_path, events)
    spans = fault_spans(timeline(run))
    assert [span.fault for span in spans] == [loss, kill]
    # The second one is until the end of the run.
    assert np.array([span[1:] for span in spans]) == pytest.approx(np.array([[1.0, 1.5], [2.0, 3.98]]))
    drawing = run_figure([run])
    assert labels(drawing) == [f'1.0 to 1.5 s: {loss}', f'2.0 to 4.0 s: {kill}']
    plane, *panels = drawing.axes
    assert not plane.patches
    for panel in panels:
        assert [patch.get_x() for patch in panel.patches] == pytest.approx([1.0, 2.0])
    # Times count from the goal, also those of violations.
    (tmp_path / 'goal').mkdir()
    begun = run_of(tmp_path / 'goal', [*events, (10.5, '/goal_pose', goal(3.0, 0.0))])
    violated = run_figure(begun, [ViolationMark(round(11.5e9), 'Reaches(3)')])
    words = {text.get_text() for legend in violated.legends for text in legend.get_texts()}
    assert {f'0.5 to 1.0 s: {loss}', '1.0 s: Reaches(3)'} <= words
    # Several runs are compared without them.
    assert labels(run_figure([run, run])) == []
    # Long ones stay in the picture.
    events = [event(11 + 0.1 * k, f"Loss('{60 * 'w'}{k}')", 'begins') for k in range(NAMED + 3)]
    made = run_figure(read_run(write_bag(tmp_path / 'many', sample(events))))
    assert labels(made)[-1] == 'and 4 more faults'
    made.draw_without_rendering()
    (legend,) = (one.get_window_extent() for one in made.legends)
    assert 0.0 <= legend.x0 < legend.x1 <= made.bbox.x1
    assert 0.0 <= legend.y0 < legend.y1 <= made.bbox.y1


def test_lines_are_broken_where_time_goes_back_and_a_push_is_a_line(lockstep, robot_at, tmp_path):
    robot_at(cmd_vel_timeout=0.0)
    recorded = RecordedRun(lockstep, tmp_path)
    push, jump = Push(0.1, start=0.2), TimeJump(-0.3, start=0.5)
    lockstep.inject(push, jump)
    for _ in range(8):
        lockstep.publish('cmd_vel', Twist(linear=Vector3(x=0.1)))
        lockstep.run_for(0.1)
    run = read_run(recorded.finish())
    one = timeline(run)
    # Recorded in the order in which it happened.
    assert len(one.breaks) == 1
    (back,) = one.breaks
    assert one.time[back] < one.time[back - 1] - 0.25
    assert (np.diff(run.odometry.received) > 0).all()
    for lines in (measured(one, 'v'), measured(one, 'left'), commanded(one, 'v')):
        gaps = np.flatnonzero(np.isnan(lines[:, 0]))
        assert len(gaps)
        assert not (np.diff(lines[:, 0]) < 0.0).any(), 'a line leads back in time'
    spans = {span.fault: span for span in fault_spans(one)}
    # The axis begins with the first odometry.
    assert spans[repr(push)][1:] == pytest.approx((0.18, 0.18))
    assert spans[repr(jump)].end > spans[repr(jump)].begin
