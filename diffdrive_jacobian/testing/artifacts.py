"""Names of the files that tests leave behind, after the tests."""

from __future__ import annotations

import hashlib
import re

MAX_LENGTH = 120
"""Length of the longest name. A name in a directory can have 255 bytes."""


def artifact_name(nodeid: str) -> str:
    """Return a name for the files of a test: `dir/test_a.py::Test::test_b[1.0-x]` is
    `dir.test_a.Test.test_b-1.0-x`.

    It has only letters, digits and `_ . + -`, so that shells and archives accept it. Different tests
    have different names: where something else had to be replaced, a part of a hash follows.
    """
    place, _, tests = nodeid.partition('::')
    path = re.sub(r'\.py$', '', place).replace('/', '.')
    function, bracket, parameters = tests.partition('[')
    name = path + (f'.{function.replace("::", ".")}' if function else '')
    if bracket:
        name += f'-{parameters.removesuffix("]")}'
    safe = re.sub(r'[^A-Za-z0-9_.+-]+', '_', name).lstrip('.-')
    if safe == name and len(safe) <= MAX_LENGTH:
        return safe
    digest = hashlib.sha256(nodeid.encode(errors='surrogateescape')).hexdigest()[:8]
    return f'{safe[: MAX_LENGTH - 9]}-{digest}'


def name_beside_the_file(nodeid: str) -> str:
    """Return a name for the files of a test in the directory of its module, without the directories."""
    place, separator, tests = nodeid.partition('::')
    return artifact_name(place.rpartition('/')[2] + separator + tests)
