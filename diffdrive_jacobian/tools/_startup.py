"""What shortens the start of a program. It affects the whole process, so the library does not use it."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_GENERATOR = 'rosidl_generator_py.generate_py_impl'


def without_message_generator() -> None:
    """Skip the import of the message generator when message classes are loaded.

    A message class imports rosidl_generator_py for one function. That package also imports its generator
    and the parser of message definitions, which takes longer than to create a node. It does without them
    where they cannot be imported, as after `None` in `sys.modules`.
    """
    if 'rosidl_generator_py' not in sys.modules:
        sys.modules[_GENERATOR] = None  # type: ignore[assignment]


def without_blas_threads() -> None:
    """Set the number of threads of OpenBLAS to one, unless the user has chosen it.

    OpenBLAS starts one for each further core when NumPy is imported. Each is busy for milliseconds until
    it sleeps. The matrices of a robot are too small for threads.
    """
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


@contextmanager
def long_lived() -> Iterator[None]:
    """Create objects that last as long as the process, such as modules and nodes.

    The garbage collector would visit all of them again and again, and find nothing. It pauses here, and
    does not visit them later.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.freeze()
            gc.enable()
