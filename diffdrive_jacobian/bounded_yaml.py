"""YAML of unknown origin: loaded only if it is of moderate size, depth and expansion.

A file of a few kilobytes can stand for billions of values, through aliases (``*a``) of lists of aliases.
So the events of the parser, of which there are no more than characters, are counted before any value
is created.
"""

from __future__ import annotations

import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    NodeEvent,
    ScalarEvent,
)

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import format_size

MAX_SIZE = 2_000_000
"""Characters of a text."""
MAX_VALUES = 200_000
"""Values, each as often as aliases repeat it."""
MAX_DEPTH = 50
"""Collections within each other."""
MAX_NUMBER = 1000
"""Characters of a scalar that is not quoted and may be a number."""

YAML_ERRORS = (YAMLError, ValueError, RecursionError, OverflowError)
"""What `load_yaml` raises. `TooLargeError` is a ValueError."""


class TooLargeError(DiffdriveError, ValueError):
    """A file asks for more memory or time than is allowed; the message gives the limit."""


def load_yaml(source: Path | str) -> Any:
    """Load YAML from a file or a text.

    Args:
        source: A path, or the text itself.

    Returns:
        Dictionaries, lists, strings, numbers, dates and None.

    Raises:
        TooLargeError: The text, its nesting, or what its aliases stand for is too large.
        YAMLError, ValueError, RecursionError, OverflowError: It is not valid YAML.
        OSError: The file cannot be read.
    """
    text = _read(source) if isinstance(source, Path) else source
    check_yaml(text)
    return pickle.loads(_pickled(text))


def check_yaml(source: Path | str) -> None:
    """Check that YAML is of moderate size, depth and expansion; arguments and errors of `load_yaml`."""
    _check_text(_read(source) if isinstance(source, Path) else source)


@lru_cache(maxsize=8)  # Opening a bag checks metadata.yaml several times.
def _check_text(text: str) -> None:
    if len(text) > MAX_SIZE:
        raise TooLargeError(
            f'the YAML text has {format_size(len(text))}; at most {format_size(MAX_SIZE)} are read'
        )
    expansion = _Expansion()
    for event in YAML(typ='safe').parse(text):
        expansion.count(event)


@lru_cache(maxsize=4)  # As above. YAML takes fifty times as long to load as a pickle.
def _pickled(text: str) -> bytes:
    return pickle.dumps(YAML(typ='safe').load(text))


def _read(path: Path) -> str:
    with open(path, encoding='utf-8') as file:
        return file.read(MAX_SIZE + 1)


class _Expansion:
    """Counts the values of a document, each as often as aliases repeat it."""

    def __init__(self) -> None:
        self._values = 0
        self._sizes: dict[str, int | None] = {}  # None: the anchor's value is not complete yet.
        self._open: list[tuple[str | None, int]] = []

    def count(self, event: Any) -> None:
        if isinstance(event, AliasEvent):
            size = self._sizes.get(event.anchor, 0)
            if size is None:
                raise TooLargeError(f'the YAML alias *{event.anchor} is part of its own value')
            self._values += size
        elif isinstance(event, CollectionEndEvent):
            anchor, before = self._open.pop()
            if anchor is not None:
                self._sizes[anchor] = self._values - before
        elif isinstance(event, NodeEvent):
            self._values += 1
            if isinstance(event, CollectionStartEvent):
                self._open.append((event.anchor, self._values - 1))
                size = None
            else:
                size = 1
            if event.anchor is not None:
                self._sizes[event.anchor] = size
            if isinstance(event, ScalarEvent):
                self._check_scalar(event)
        if self._values > MAX_VALUES:
            raise TooLargeError(f'the YAML text stands for more than {MAX_VALUES} values')
        if len(self._open) > MAX_DEPTH:
            raise TooLargeError(f'the YAML text is nested more than {MAX_DEPTH} deep')

    @staticmethod
    def _check_scalar(event: ScalarEvent) -> None:
        # Numbers take time that grows with the square of their digits. The style of a scalar without
        # quotes is None, or '' from the parser in C.
        may_be_number = not event.style and event.value[:1] in tuple('+-.0123456789')
        if (may_be_number or event.tag is not None) and len(event.value) > MAX_NUMBER:
            raise TooLargeError(f'a YAML number has more than {MAX_NUMBER} characters')
