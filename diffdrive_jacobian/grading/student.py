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

"""The process of a hand-in. It is run as a program, and imports nothing of this package.

It reads requests from its input, one JSON array each, calls a function of the hand-in, and writes the
answer. Before anything of the hand-in runs, it gives up what a law does not need: files, the network and
other processes.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import io
import json
import os
import sys
import types
from typing import Any

import numpy as np

resource: Any = None
# Windows has none.
with contextlib.suppress(ImportError):
    import resource

MODULES = (
    *('abc', 'bisect', 'cmath', 'collections', 'collections.abc', 'copy', 'dataclasses', 'enum'),
    *('fractions', 'functools', 'heapq', 'itertools', 'math', 'numbers', 'operator', 'random'),
    *('statistics', 'string', 'textwrap', 'time', 'typing', 'unicodedata', 'warnings'),
    *('numpy', 'numpy.fft', 'numpy.linalg', 'numpy.ma', 'numpy.polynomial', 'numpy.random'),
)
"""What a hand-in may import. It is imported before, because no file can be opened after."""
MEMORY = 4 << 30
"""Largest address space (bytes)."""
LONGEST = 1_000_000
"""Largest size of an answer (characters)."""


KEPT = ('fspath', 'urandom', 'getpid', 'cpu_count', 'strerror')
"""Functions of the system that stay. Many of the others change something without an audit event."""


def raise_fence() -> None:
    """Refuse what a hand-in need not do. It is for mistakes and for the curious: the limits are more.

    The hook is no name of a module, where a hand-in would find and change it.
    """

    def fence(event: str, args: tuple[Any, ...]) -> None:
        # Only what cannot be replaced: literals, and methods of str.
        if event == 'import':
            raise ImportError('', name=args[0])
        if event == 'builtins.input':
            raise PermissionError('asks for input, which nobody answers')
        if event in {'open', 'os.listdir', 'os.scandir'}:
            raise PermissionError('opens or changes a file')
        if event.startswith(('socket.', 'urllib.', 'ftplib.', 'http.', 'smtplib.', 'ssl.')):
            raise PermissionError('uses the network')
        if event.startswith(('os.', 'shutil.', 'tempfile.', 'glob.', 'resource.', 'fcntl.', 'mmap.')):
            raise PermissionError('changes files or other programs')
        if event.startswith(('subprocess.', 'pty.', 'signal.', 'syslog.', 'webbrowser.')):
            raise PermissionError('starts or ends another program')
        if event.startswith(('winreg.', '_winapi.', 'msvcrt.', 'ctypes.', 'gc.', 'cpython.')):
            raise PermissionError('changes how the system or Python works')
        if event.startswith(('sys.settrace', 'sys.setprofile', 'builtins.breakpoint')):
            raise PermissionError('changes how Python works')
        if event == 'object.__setattr__' and args[1] == '__code__':
            raise PermissionError('changes how Python works')

    def refusing(name: str) -> Any:
        def refuse(*_: object, **__: object) -> None:
            raise PermissionError(f'uses os.{name}, which a hand-in may not')

        return refuse

    for module in (os, *(sys.modules[name] for name in ('posix', 'nt') if name in sys.modules)):
        for name, value in list(vars(module).items()):
            if type(value) is type(len) and name not in KEPT:
                setattr(module, name, refusing(name))
    sys.addaudithook(fence)


def limit(seconds: int) -> None:
    """Limit what the process can use, where the system can: no further file, no memory without end."""
    if resource is None:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    # Root has no limit of processes.
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    # macOS has a limit of the address space that is no limit.
    if sys.platform == 'linux':
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    # Those that are open stay open.
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))


def end_with_parent() -> None:
    """End this process when the one that asks ends, where the system can."""
    if sys.platform == 'linux':
        # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(1, 9)


def described(error: BaseException, name: str) -> str:
    """Return what went wrong in words, with the line of the hand-in."""
    # Of the fence. Python's own says that a module lacks a name.
    if isinstance(error, ImportError) and not error.msg:
        return f'imports {error.name}, and may import numpy and what computes in the standard library'
    line, trace = 0, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == name:
            line = trace.tb_lineno
        trace = trace.tb_next
    if isinstance(error, SyntaxError) and error.filename == name:
        line = error.lineno or 0
    try:
        text = error.msg if isinstance(error, SyntaxError) else str(error)
    except BaseException:
        text = 'an error without a text'
    what = text if isinstance(error, PermissionError) else f'{type(error).__name__}: {text}'
    return f'{what[:300]} (line {line})' if line else what[:300]


def plain(value: object) -> object:
    """Return a result as JSON has it, or raise TypeError."""
    if isinstance(value, np.ndarray):
        return {'array': plain(value.tolist()), 'shape': value.shape}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f'must return numbers, arrays, lists or texts, got {type(value).__name__}')


def given(value: object) -> object:
    """Return an argument: arrays are marked."""
    if isinstance(value, dict):
        return np.array(value['array'], dtype=float).reshape(value['shape'])
    return [given(one) for one in value] if isinstance(value, list) else value


def main() -> None:
    """Serve requests until the input ends."""
    path, seconds = sys.argv[1], int(sys.argv[2])
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), 'w')
    # As Python reads it: with its encoding, and with the mark that some editors put before it.
    with open(path, 'rb') as file:
        source = file.read()
    for needed in MODULES:
        importlib.import_module(needed)

    def answer(kind: str, value: object) -> None:
        text = json.dumps([kind, value])
        if len(text) > LONGEST:
            text = json.dumps(['failed', f'must return less than {LONGEST} characters, got {len(text)}'])
        answers.write(text + '\n')
        answers.flush()

    # What a hand-in prints is not for anybody, and it may be endless.
    devnull = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(devnull, number)
    sys.stdout = sys.stderr = io.TextIOWrapper(_Nowhere(), encoding='utf-8', errors='replace')
    name = os.path.basename(path)
    # Not the folders of whoever grades.
    sys.argv, sys.stdin = [name], io.StringIO()
    end_with_parent()
    limit(seconds)
    raise_fence()
    answer('loaded', None)
    hand_in = types.ModuleType('hand_in')
    hand_in.__file__ = name
    # Dataclasses look for the module of their class.
    sys.modules['hand_in'] = hand_in
    module = vars(hand_in)
    try:
        # A program that ends itself has defined its functions.
        with contextlib.suppress(SystemExit):
            exec(compile(source, name, 'exec', dont_inherit=True), module)
        names = [one for one, value in module.items() if callable(value) and not one.startswith('_')]
    except BaseException as error:
        answer('broken', described(error, name))
        return
    answer('ready', names)
    for line in requests:
        function, arguments = json.loads(line)
        try:
            answer('value', plain(module[function](*map(given, arguments))))
        except BaseException as error:
            answer('failed', described(error, name))


class _Nowhere(io.RawIOBase):
    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        return len(data)  # type: ignore[arg-type]


if __name__ == '__main__':
    main()
