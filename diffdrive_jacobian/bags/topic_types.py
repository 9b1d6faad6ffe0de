"""Definition and hash of the type of a topic, from what is left of a bag and from what is known."""

from __future__ import annotations

from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from diffdrive_jacobian.bags.known_types import known_definition
from diffdrive_jacobian.bags.message_definitions import Definition, UnknownTypeError, definition
from diffdrive_jacobian.bags.salvage_mcap import Topic

MAX_DEFINITION = 200_000
"""Length of the longest definition of a type that is parsed; those of ROS have less than a tenth."""
_PARSE_ERRORS = (TypesysError, LookupError, ValueError, AssertionError, RecursionError)


def definition_and_hash(topic: Topic) -> tuple[str, str]:
    """Return the definition of a topic's type, and the definition's hash (RIHS01).

    Raises:
        UnknownTypeError: The file lacks one of them, and the type is not known.
    """
    try:
        known = _known(topic.type_name)
        if topic.type_hash == known.type_hash:
            # The text in the file may be damaged, or differ in comments.
            return known.text, known.type_hash
        if topic.definition and topic.type_hash:
            return topic.definition, topic.type_hash
        if topic.definition in ('', known.text) and topic.type_hash in ('', known.type_hash):
            return known.text, known.type_hash
        reason = f'{topic.type_name} is installed in another version than it was recorded'
    except UnknownTypeError as error:
        if topic.definition and topic.type_hash:
            return topic.definition, topic.type_hash
        reason = str(error)
    if not topic.definition:
        raise UnknownTypeError(reason)
    if len(topic.definition) > MAX_DEFINITION:
        raise UnknownTypeError(
            f'{reason}, and its definition has {len(topic.definition)} characters; at most '
            f'{MAX_DEFINITION} are parsed'
        )
    try:
        return topic.definition, _hash(topic.definition, topic.type_name)
    except _PARSE_ERRORS as error:
        raise UnknownTypeError(reason) from error


def _known(type_name: str) -> Definition:
    """Return the definition of an installed type, or of one that is known without ROS.

    Raises:
        UnknownTypeError: It is neither.
    """
    try:
        return definition(type_name)
    except UnknownTypeError:
        try:
            return known_definition(type_name)
        except UnknownTypeError:
            pass
        raise


def _hash(text: str, type_name: str) -> str:
    """Return the hash of a definition.

    It is only parsed. rosbags' `register` would generate code from it and execute that.
    """
    store = get_typestore(Stores.EMPTY)
    store.fielddefs.update(get_types_from_msg(text, type_name))
    return store.hash_rihs01(type_name)
