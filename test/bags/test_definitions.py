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

"""Message types named by a bag, known without ROS or installed, and the definitions in bags.

Only packages whose share directory has the .msg are imported.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from unittest import mock

import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from support.bags import SECOND, odom, write_bag, write_sqlite
from support.raw_bags import channel

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.bags.message_definitions import (
    UnknownTypeError,
    definition,
    definition_and_hash,
    known_definition,
    message_class,
    recorded_definition_differs,
)
from diffdrive_jacobian.messages.topics import TOPICS

TYPES = sorted({kind for topic in TOPICS.values() for kind in topic.types})
both = pytest.mark.parametrize('find', [definition, message_class])

# --- Installed types


@both
def test_names_of_no_message_are_refused_without_an_import(find, monkeypatch, capsys):
    for package in ('this', 'antigravity'):
        monkeypatch.delitem(sys.modules, package, raising=False)
    for name in (
        *('', 'std_msgs', 'std_msgs/String', 'std_msgs/srv/String', 'std_msgs/msg/string'),
        *('std_msgs/msg/String\n', 'std_msgs/msg/../String', 'std_msgs/msg/Strıng', 'this/msg/'),
        *('../std_msgs/msg/String', 'std_msgs.msg/msg/String', '_this/msg/X', 'a/b/msg/X'),
    ):
        with pytest.raises(UnknownTypeError, match='must be named package/msg/Name'):
            find(name)
    for name in ('this/msg/X', 'antigravity/msg/Zen', 'std_msgs/msg/Nothing', 'sys/msg/X'):
        with pytest.raises(UnknownTypeError, match=f'no installed package defines {name}'):
            find(name)
    assert capsys.readouterr().out == ''
    assert not {'this', 'antigravity'} & set(sys.modules)


@both
@pytest.mark.parametrize(('entry', 'place'), [('', '.'), ('.', 'lib'), ('CWD', 'lib')])
def test_code_beside_a_bag_is_not_imported(tmp_path, monkeypatch, find, entry, place):
    """Not even if a share directory is there, too, and also not later from another directory."""
    folder, share = tmp_path / place, tmp_path / 'share' / 'evil_msgs' / 'msg'
    for path in (folder / 'evil_msgs' / 'msg', share, tmp_path / 'elsewhere'):
        path.mkdir(parents=True)
    (folder / 'evil_msgs' / '__init__.py').write_text('raise SystemExit("imported")')
    (folder / 'evil_msgs' / 'msg' / '__init__.py').write_text('class X: pass')
    for ending in ('msg', 'json'):
        (share / f'X.{ending}').touch()
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder) if entry == 'CWD' else entry)
    for directory in (folder, *([tmp_path / 'elsewhere'] if entry != 'CWD' else [])):
        # A relative entry goes on to mean the directory in which it was first searched.
        monkeypatch.chdir(directory)
        with pytest.raises(UnknownTypeError, match='no installed package defines evil_msgs/msg/X'):
            find('evil_msgs/msg/X')
    assert 'evil_msgs' not in sys.modules


def test_a_module_that_hides_a_message_package_is_not_imported(tmp_path, monkeypatch):
    """The .msg file is installed, but `import` would find other code of that name first."""
    (tmp_path / 'shape_msgs.py').write_text('raise SystemExit("imported")')
    library = tmp_path / 'opt' / 'lib' / 'python3' / 'site-packages'
    share = tmp_path / 'opt' / 'share' / 'shape_msgs' / 'msg'
    share.mkdir(parents=True)
    (share / 'Plane.msg').write_text('float64[4] coef\n')
    (library / 'shape_msgs').mkdir(parents=True)
    (library / 'shape_msgs' / '__init__.py').touch()
    monkeypatch.syspath_prepend(str(library))
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UnknownTypeError):
        message_class('shape_msgs/msg/Plane')
    assert 'shape_msgs' not in sys.modules


GENERATED = """\
class Metaclass(type):
    _TYPE_SUPPORT = None

    @classmethod
    def __import_type_support__(cls):
        {statement}


class Mine(metaclass=Metaclass):
    pass
"""
"""Python code of a message type, reduced from what rosidl_generator_py generates."""


@pytest.fixture
def overlay(tmp_path, monkeypatch):
    """A function that installs `my_msgs/msg/Mine`, from its Python code and its description in JSON."""

    def install(code, described='{}'):
        library = tmp_path / 'lib' / 'python3.12' / 'site-packages'
        (library / 'my_msgs' / 'msg').mkdir(parents=True)
        (library / 'my_msgs' / '__init__.py').write_text('')
        (library / 'my_msgs' / 'msg' / '__init__.py').write_text(code)
        share = tmp_path / 'share' / 'my_msgs' / 'msg'
        share.mkdir(parents=True)
        (share / 'Mine.msg').write_text('int32 x\n')
        (share / 'Mine.json').write_text(described)
        monkeypatch.syspath_prepend(str(library))

    yield install
    for name in ('my_msgs', 'my_msgs.msg'):
        sys.modules.pop(name, None)
    for find in (definition, message_class):
        find.cache_clear()


def test_an_installed_type_is_found_also_in_an_overlay(overlay):
    assert message_class('std_msgs/msg/String') is String
    assert definition('std_msgs/msg/String').text.splitlines()[-1] == 'string data'
    overlay(GENERATED.format(statement='cls._TYPE_SUPPORT = object()'))
    assert message_class('my_msgs/msg/Mine').__name__ == 'Mine'


@pytest.mark.parametrize(
    ('code', 'reason'),
    [
        (GENERATED.format(statement='raise Exception'), 'type support of .* cannot be loaded'),
        (GENERATED.format(statement='pass'), 'type support of .* is not installed'),
        ('class Mine: pass', 'type support of .* cannot be loaded: AttributeError'),
        ('invalid code', 'Python code of .* cannot be imported: SyntaxError'),
        ('', 'Python code of .* is not installed'),
    ],
)
def test_a_type_without_usable_python_code_is_unknown(overlay, code, reason):
    overlay(code)
    with pytest.raises(UnknownTypeError, match=reason):
        message_class('my_msgs/msg/Mine')


@pytest.mark.parametrize('described', ['{', '[]', '{}', '{"type_hashes": [1]}', '[' * 100_000])
def test_a_type_with_an_invalid_description_is_unknown(overlay, described):
    overlay('', described)
    with pytest.raises(UnknownTypeError, match='definition of my_msgs/msg/Mine is invalid'):
        definition('my_msgs/msg/Mine')


# --- Definitions in bags


def test_known_definitions_are_those_of_the_installed_packages():
    """An rosbags or ROS release that changes a type fails here."""
    for name in TYPES:
        assert known_definition(name).type_hash == definition(name).type_hash
    with pytest.raises(UnknownTypeError, match='my_msgs/msg/Mine is not a type of ROS 2 Jazzy'):
        known_definition('my_msgs/msg/Mine')


OTHER_HASH = 'RIHS01_' + '0' * 64


def test_only_a_valid_hash_tells_another_definition():
    name = 'nav_msgs/msg/Odometry'
    own = definition(name).type_hash
    assert recorded_definition_differs(name, [own, OTHER_HASH])
    assert not recorded_definition_differs(name, [own, '', 'INVALID', 'RIHS02_' + '0' * 64, 'RIHS01_'])


@pytest.mark.parametrize('write', [build_bag, write_sqlite])
def test_messages_of_another_definition_are_not_misread(tmp_path, write):
    odometry, other = (channel(index, f'/{index}', 'nav_msgs/msg/Odometry') for index in (0, 1))
    odometry = replace(odometry, topic='/odom', definition='float64 x\n', type_hash=OTHER_HASH)
    data = [Message(0, SECOND, serialize_message(odom(1.0, 2.0, 0.5)))]
    write([odometry, other], data, tmp_path / 'bag')
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
    read_run(tmp_path / 'bag')
    generated = mock.Mock(side_effect=AssertionError('code was generated from a definition'))
    monkeypatch.setattr('rosbags.typesys.store.generate_python_code', generated)
    assert len(read_run(tmp_path / 'bag').odometry) == 1
    text, type_hash = definition_and_hash('evil_msgs/msg/Evil', 'int32 a\nint32 class\n', '')
    assert text == 'int32 a\nint32 class\n'
    assert type_hash.startswith('RIHS01_')


def test_a_parsed_definition_has_the_hash_of_the_type():
    for name in (*TYPES, 'tf2_msgs/msg/TFMessage'):
        known = known_definition(name)
        other = name.replace('/msg/', '/msg/X')
        assert definition_and_hash(name, '', '')[1] == known.type_hash
        assert definition_and_hash(other, known.text, '')[1] != known.type_hash
        # Recorded with another definition, which is kept.
        assert definition_and_hash(name, 'float64 x\n', OTHER_HASH) == ('float64 x\n', OTHER_HASH)
    for text in ('evil_msgs/Evil a\n', 'x' * 1000, '%', '\0'):
        with pytest.raises(UnknownTypeError):
            definition_and_hash('evil_msgs/msg/Evil', text, '')
