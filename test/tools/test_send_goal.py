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

"""send_goal reports what became of its goal, by its exit code and in words."""

from __future__ import annotations

import pytest
from support import commands

from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes import remote_goal
from diffdrive_jacobian.nodes.remote_goal import GoalResult, Result

CANCELED = {'status': GoalState.CANCELED, 'distance': 1.5}


@pytest.mark.parametrize(
    ('result', 'more', 'code', 'words'),
    [
        (Result.NOT_SENT, {'reason': 'no node'}, 1, 'not sent within 3 s: no node'),
        (Result.UNCONFIRMED, {}, 1, 'not acknowledged'),
        (Result.SENT, {}, 0, 'sent: goal (1, 2) on /goal_pose'),
        (Result.NO_ANSWER, {}, 1, 'no answer'),
        (Result.ENDED, {'status': GoalState.SUCCEEDED, 'distance': 0.01}, 0, 'arrived, 0.010 m from'),
        (Result.ENDED, {'status': GoalState.ABORTED}, 1, 'aborted'),
        (Result.LOST, {'reason': 'it was killed'}, 1, 'lost: it was killed'),
        (Result.TIMEOUT, {**CANCELED, 'canceled': True}, 1, 'not arrived within --timeout 5 s'),
        (Result.TIMEOUT, {**CANCELED, 'canceled': True}, 1, 'canceled: the robot was stopped'),
        (Result.INTERRUPTED, {}, 130, 'nothing was sent'),
        (Result.INTERRUPTED, {**CANCELED, 'canceled': True}, 130, 'canceled: the robot was stopped'),
        (Result.INTERRUPTED, {**CANCELED, 'canceled': False}, 130, 'the robot may still drive'),
    ],
)
def test_what_became_of_the_goal(monkeypatch, result, more, code, words):
    def send(goal, *, frame, patience, timeout, follow, heading_matters, **_):
        assert goal == [1.0, 2.0, 0.5]
        assert (frame, patience, timeout, follow, heading_matters) == ('map', 3.0, 5.0, True, True)
        return GoalResult(result=result, topic='/goal_pose', **more)

    monkeypatch.setattr(remote_goal, 'send_goal', send)
    options = ('--heading', 0.5, '--frame', 'map', '--wait', 3, '--timeout', 5)
    ended = commands.run('send_goal', 1, 2, *options)
    assert (ended.code, ended.err) == (code, '')
    assert words in ended.out
