"""What shortens the start of a program. It changes the process, so only programs use it, not the library."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_GENERATOR = 'rosidl_generator_py.generate_py_impl'


def without_message_generator() -> None:
    """Let message classes be loaded without the generator that wrote them.

    A message class imports rosidl_generator_py for one function. That package also imports its generator
    and the parser of message definitions, which takes longer than to create a node with its topics. It
    does without them where they cannot be imported, as after `None` in `sys.modules`.
    """
    if 'rosidl_generator_py' not in sys.modules:
        sys.modules[_GENERATOR] = None  # type: ignore[assignment]


@contextmanager
def long_lived() -> Iterator[None]:
    """Create objects that last as long as the process, such as modules and nodes.

    The garbage collector would visit all of them again and again, and find nothing. It pauses here, and
    never visits them later.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
