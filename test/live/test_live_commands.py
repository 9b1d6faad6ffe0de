"""Commands of the live page: what is taken, and what is refused."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.live.commands import (
    CommandError,
    DriveByHand,
    Pause,
    Seek,
    SendGoal,
    SetParameter,
    SetSpeed,
    Step,
    parse,
)

GOAL = {'do': 'goal', 'robot': '/', 'x': 1, 'y': -2.5, 'theta': None, 'append': False}
DRIVE = {'do': 'drive', 'robot': '/a', 'v': 0.2, 'omega': -1.0}
SET = {'do': 'set', 'robot': '/', 'parameter': 'controller/controller', 'value': 'pose'}


@pytest.mark.parametrize(
    ('content', 'command'),
    [
        (GOAL, SendGoal('/', 1.0, -2.5, None, append=False)),
        ({**GOAL, 'theta': 3.0, 'append': True}, SendGoal('/', 1.0, -2.5, 3.0, append=True)),
        (DRIVE, DriveByHand('/a', 0.2, -1.0)),
        ({'do': 'pause', 'paused': True}, Pause(paused=True)),
        ({'do': 'step'}, Step()),
        ({'do': 'speed', 'speed': 5}, SetSpeed(5.0)),
        ({'do': 'seek', 'time': 0}, Seek(0.0)),
        (
            {'do': 'set', 'robot': '/', 'parameter': 'robot/x', 'value': None},
            SetParameter('/', 'robot/x', None),
        ),
        (
            {'do': 'set', 'robot': '/', 'parameter': 'c/kp', 'value': 3},
            SetParameter('/', 'c/kp', 3.0),
        ),
    ],
)
def test_commands(content, command):
    assert parse(json.dumps(content)) == command


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (b'{}', 'must be text'),
        ('', 'must be JSON'),
        ('{"do": "step"', 'must be JSON'),
        ('[' * 3000, 'must be JSON'),
        ('[]', 'must be a JSON object'),
        ('{}', 'do must be one of goal'),
        ('{"do": ["goal"]}', 'do must be one of'),
        ('{"do": "shutdown"}', "do must be one of .*, got 'shutdown'"),
        (json.dumps({**DRIVE, 'more': 1}), 'drive must have the keys robot, v, omega'),
        (json.dumps({'do': 'drive', 'robot': '/'}), 'drive must have the keys'),
        (json.dumps({**DRIVE, 'v': True}), 'v must be a number'),
        (json.dumps({**DRIVE, 'v': '1'}), "v must be a number, got '1'"),
        (json.dumps({**DRIVE, 'v': 1e9}), r'v must be in \[-1000, 1000\], got 1000000000'),
        (json.dumps({**DRIVE, 'v': 10**400}), r'v must be in \[-1000, 1000\], got 1000000'),
        (json.dumps(DRIVE).replace('0.2', 'NaN'), 'must be JSON'),
        (json.dumps(DRIVE).replace('0.2', 'Infinity'), 'must be JSON'),
        (json.dumps(DRIVE).replace('0.2', '1e999'), r'v must be in \[-1000, 1000\], got inf'),
        (json.dumps({**DRIVE, 'robot': 7}), 'robot must be a text'),
        (json.dumps({**DRIVE, 'robot': 'x' * 300}), 'at most 256 printable characters'),
        (json.dumps({**GOAL, 'append': 0}), 'append must be True or False, got 0'),
        (json.dumps({**GOAL, 'theta': 99.0}), r'theta must be in \[-6.28319, 6.28319\] rad, got 99.0'),
        (json.dumps({**GOAL, 'x': 1e7}), r'x must be in \[-1e\+06, 1e\+06\] m, got 10000000.0'),
        (json.dumps({'do': 'place', 'robot': '/', 'x': 0, 'y': 0, 'theta': None}), 'theta must be'),
        (json.dumps({'do': 'speed', 'speed': 0}), r'speed must be in \[0.01, 1000\], got 0'),
        (json.dumps({'do': 'set', 'robot': '/', 'parameter': 'a', 'value': [1]}), 'value must be'),
        *(
            (
                json.dumps({**SET, key: f'pose{character}x'}),
                f'{key} must be a text of at most 256 printable',
            )
            for key in SET
            if key != 'do'
            for character in ('\ud800', '\0', '\x1b', '\n')
        ),
    ],
)
def test_what_is_refused(text, message):
    with pytest.raises(CommandError, match=message):
        parse(text)


KEYS = ('robot', 'x', 'y', 'theta', 'v', 'omega', 'append', 'time', 'paused')
JSON = st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5) | st.just([{}])


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(['goal', 'drive', 'place', 'set', 'seek', 'pause']),
    st.dictionaries(st.sampled_from(KEYS), JSON, max_size=5),
)
def test_nothing_else_than_a_command_or_an_error(name, values):
    said = ''
    try:
        parse(json.dumps({'do': name, **values}))
    except CommandError as error:
        said = str(error)
    assert said.isprintable()
