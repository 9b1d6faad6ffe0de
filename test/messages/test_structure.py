"""Types of the fields of messages: the same from a class and from a definition."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

import geometry_msgs.msg
import pytest
import rcl_interfaces.msg
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Goals, Odometry
from unique_identifier_msgs.msg import UUID

from diffdrive_jacobian.bags.message_definitions import definition, is_known, known_definition
from diffdrive_jacobian.messages.structure import (
    Array,
    DefinitionError,
    Number,
    Sequence,
    Structure,
    Text,
    defined,
    is_identifier,
    is_stamp,
    structure,
    walk,
)


def installed_types():
    """Return all classes of messages of the installed packages of interfaces, by their names."""
    found = {}
    for module in pkgutil.iter_modules():
        if not (module.ispkg and module.name.endswith(('_msgs', '_interfaces'))):
            continue
        try:
            messages = importlib.import_module(f'{module.name}.msg')
        except ModuleNotFoundError:
            continue
        for name, kind in inspect.getmembers(messages, inspect.isclass):
            found[f'{module.name}/msg/{name}'] = kind
    return found


def test_installed_types_are_the_same_by_their_classes_and_by_their_definitions():
    types = installed_types()
    assert len(types) > 100
    # Each third: all of them take a second and a half.
    for name, kind in sorted(types.items())[::3]:
        assert defined(name, definition(name).text) == structure(kind), name
        if is_known(name) and known_definition(name).type_hash == definition(name).type_hash:
            assert defined(name, known_definition(name).text) == structure(kind), name


def test_everything_that_a_definition_can_have():
    text = (
        'int8 ONE=1  # a constant\r\n'
        'string NAME = "a=b"\n'
        '# a comment\n\n'
        '  bool flag true\n'
        'byte b\nchar c\nuint64 n 3\nfloat32 x # its comment\n'
        'string<=10 short "a#b"\nwstring wide\n'
        'float64[3] three\nfloat64[] any\nfloat64[<=4] few\nstring<=5[<=2] names\n'
        'Two two\nother_msgs/Three[] threes\n'
        '================\nMSG: a_msgs/Two\nother_msgs/Three three\n'
        '================\nMSG: other_msgs/msg/Three\n'
    )
    three = Structure('other_msgs/Three', ())
    double = Number('d')
    assert defined('a_msgs/msg/One', text) == Structure(
        'a_msgs/One',
        (
            *(('flag', Number('?')), ('b', Number('c')), ('c', Number('B')), ('n', Number('Q'))),
            *(('x', Number('f')), ('short', Text(most=10)), ('wide', Text(wide=True))),
            *(('three', Array(double, 3)), ('any', Sequence(double)), ('few', Sequence(double, 4))),
            ('names', Sequence(Text(most=5), 2)),
            ('two', Structure('a_msgs/Two', (('three', three),))),
            ('threes', Sequence(three)),
        ),
    )


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('Other other', 'the definition of a_msgs/Other is missing'),
        ('One[] ones', 'a_msgs/One contains itself'),
        ('Two two\n===\nMSG: a_msgs/Two\nOne one', 'a_msgs/One contains itself'),
        ('int8', "a_msgs/One has the line 'int8', which is no field"),
        ('int8 8x', "'int8 8x', which is no field"),
        ('int8[0] none', 'an array must have at least 1 element'),
        (f'int8[{"9" * 5000}] many', 'which is no field'),
        ('int8[\N{ARABIC-INDIC DIGIT THREE}] three', 'which is no field'),
        (
            'T0 t\n' + ''.join(f'===\nMSG: a_msgs/T{one}\nT{one + 1} t\n' for one in range(2000)),
            'nested too deep',
        ),
    ],
)
def test_an_invalid_definition_is_an_error(text, error):
    with pytest.raises(DefinitionError) as caught:
        defined('a_msgs/msg/One', text)
    assert error in str(caught.value)


def test_a_message_is_walked_through_in_order():
    message = Goals(goals=[PoseStamped(), PoseStamped()])
    message.goals[1].pose.position.x = 2.5
    fields = list(walk(structure(Goals), message, whole=is_stamp))
    assert [path for path, _, _ in fields[:5]] == [
        *('header.stamp', 'header.frame_id', 'len(goals)', 'goals[0].header.stamp'),
        'goals[0].header.frame_id',
    ]
    assert ('goals[1].pose.position.x', Number('d'), 2.5) in fields
    paths = {path: value for path, _, value in walk(structure(Odometry), Odometry())}
    assert len(paths['pose.covariance']) == 36
    assert is_identifier(structure(UUID))
    assert not is_identifier(structure(geometry_msgs.msg.Pose))


def test_integers_have_limits():
    limits = {name: kind.limits for name, kind in structure(rcl_interfaces.msg.IntegerRange).fields}
    assert limits == {
        'from_value': (-(2**63), 2**63 - 1),
        'to_value': (-(2**63), 2**63 - 1),
        'step': (0, 2**64 - 1),
    }
    assert Number('?').limits is Number('d').limits is None
