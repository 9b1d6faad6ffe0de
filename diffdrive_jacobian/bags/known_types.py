"""The types of ROS 2 Jazzy, where no ROS is installed.

rosbags generates Python code from definitions of message types, and executes it. So only the definitions
that come with rosbags, and the one in this module, are given to it, and never a definition in a bag.
Where a bag has the hash of a type (RIHS01, REP 2011), it is compared with that of the known definition.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache

from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from diffdrive_jacobian.bags.message_definitions import Definition, UnknownTypeError
from diffdrive_jacobian.messages.structure import Structure, defined
from diffdrive_jacobian.text import printable

GOALS = 'nav_msgs/msg/Goals'
GOALS_DEFINITION = """std_msgs/Header header
geometry_msgs/PoseStamped[] goals
"""
"""The only type of ROS 2 Jazzy that is read here and that rosbags lacks."""
_HASH = re.compile('RIHS01_[0-9a-f]{64}')


@cache
def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(GOALS_DEFINITION, GOALS))
    return store


def is_known(type_name: str) -> bool:
    """Return whether a type (`package/msg/Name`) is known without ROS."""
    return type_name in _typestore().fielddefs


@cache
def known_definition(type_name: str) -> Definition:
    """Return the definition of a type that is known without ROS.

    Args:
        type_name: `package/msg/Name`.

    Raises:
        UnknownTypeError: It is not known.
    """
    if not is_known(type_name):
        raise UnknownTypeError(f'{printable(type_name)} is not a type of ROS 2 Jazzy')
    store = _typestore()
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return Definition(name=type_name, text=text, type_hash=store.hash_rihs01(type_name))


@cache
def known_structure(type_name: str) -> Structure:
    """Return the types of the fields of a type that is known without ROS.

    Raises:
        UnknownTypeError: It is not known.
    """
    return defined(type_name, known_definition(type_name).text)


def recorded_definition_differs(type_name: str, type_hashes: Iterable[str]) -> bool:
    """Return whether a type was recorded with another definition than the known one.

    Args:
        type_name: `package/msg/Name`; it is known.
        type_hashes: Hashes that a bag has for it. Those that are empty or no RIHS01 hash do not count.
    """
    known = _typestore().hash_rihs01(type_name)
    return any(_HASH.fullmatch(one) and one != known for one in type_hashes)


def type_hashes(connection: Connection, stored: Iterable[Connection]) -> list[str]:
    """Return what a bag says about the hash of a topic's type: in metadata.yaml and in its data files.

    Args:
        connection: The topic, as metadata.yaml has it.
        stored: The topics of the data files.
    """
    alike = (one for one in stored if (one.topic, one.msgtype) == (connection.topic, connection.msgtype))
    return [str(one.digest) for one in (connection, *alike)]
