"""Types that are known without ROS, and foreign definitions in bags."""

from __future__ import annotations

import pytest
from action_msgs.msg import GoalStatus
from rclpy.serialization import serialize_message
from support.bags import SECOND, odom, write_bag

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Channel, Message
from diffdrive_jacobian.bags.message_definitions import (
    UnknownTypeError,
    definition,
    known_definition,
    known_structure,
    recorded_definition_differs,
)
from diffdrive_jacobian.bags.salvage_mcap import Topic
from diffdrive_jacobian.bags.topic_types import definition_and_hash
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.messages.topics import TOPICS

TYPES = sorted({kind for topic in TOPICS.values() for kind in topic.types})


def test_a_type_that_is_not_known_is_refused():
    with pytest.raises(UnknownTypeError, match='my_msgs/msg/Mine is not a type of ROS 2 Jazzy'):
        known_definition('my_msgs/msg/Mine')


# --- Definitions


@pytest.mark.parametrize('name', TYPES)
def test_known_definitions_are_those_of_the_installed_packages(name):
    """An rosbags or ROS release that changes a type fails here."""
    assert known_definition(name).type_hash == definition(name).type_hash


def other_hash():
    return 'RIHS01_' + '0' * 64


def test_only_a_valid_hash_tells_another_definition():
    name = 'nav_msgs/msg/Odometry'
    own = definition(name).type_hash
    assert recorded_definition_differs(name, [own, other_hash()])
    assert not recorded_definition_differs(name, [own, '', 'INVALID', 'RIHS02_' + '0' * 64, 'RIHS01_'])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_messages_of_another_definition_are_reported_and_not_misread(tmp_path, storage):
    channels = [
        Channel(
            id=index,
            topic=topic,
            type_name='nav_msgs/msg/Odometry',
            definition='float64 x\n',
            type_hash=type_hash,
        )
        for index, (topic, type_hash) in enumerate(
            [('/odom', other_hash()), ('/other', definition('nav_msgs/msg/Odometry').type_hash)]
        )
    ]
    data = [Message(0, SECOND, serialize_message(odom(1.0, 2.0, 0.5)))]
    build_bag(channels, data, tmp_path / 'bag', storage)
    run = read_run(tmp_path / 'bag')
    assert len(run.odometry) == 0
    assert run.skipped == {'/odom': 1}
    assert run.notes == (
        '1 of 1 messages on /odom were recorded with another definition of nav_msgs/msg/Odometry '
        'and were skipped',
    )


def test_definitions_of_a_bag_never_become_code(tmp_path, monkeypatch):
    """Neither reading nor recovery hands a stranger's definition to rosbags' code generator."""
    write_bag(tmp_path / 'bag', [(1.0, '/odom', odom(1.0, 2.0, 0.5))])
    known_structure('nav_msgs/msg/Odometry')

    def generated(*_, **__):
        raise AssertionError('code was generated from a definition')

    monkeypatch.setattr('rosbags.typesys.store.generate_python_code', generated)
    assert len(read_run(tmp_path / 'bag').odometry) == 1
    foreign = Topic(1, '/x', 'evil_msgs/msg/Evil', 'cdr', '', '', 'int32 a\nint32 class\n')
    text, type_hash = definition_and_hash(foreign)
    assert text == foreign.definition
    assert type_hash.startswith('RIHS01_')


@pytest.mark.parametrize('name', [*TYPES, 'tf2_msgs/msg/TFMessage'])
def test_a_parsed_definition_has_the_hash_of_the_type(name):
    known = known_definition(name)
    other = Topic(1, '/x', name.replace('/msg/', '/msg/X'), 'cdr', '', '', known.text)
    assert definition_and_hash(Topic(1, '/x', name, 'cdr', '', '', ''))[1] == known.type_hash
    assert definition_and_hash(other)[1] != known.type_hash


@pytest.mark.parametrize('text', ['evil_msgs/Evil a\n', 'x' * 1000, '%', '\0'])
def test_a_definition_that_cannot_be_parsed_leaves_the_topic_out(text):
    with pytest.raises(UnknownTypeError):
        definition_and_hash(Topic(1, '/x', 'evil_msgs/msg/Evil', 'cdr', '', '', text))


# --- States of goals


def test_states_of_goals_are_those_of_action_msgs():
    for state in GoalState:
        assert getattr(GoalStatus, f'STATUS_{state.name}') == state
    assert len(GoalState) == sum(name.startswith('STATUS_') for name in dir(GoalStatus))
