"""Child processes without the cost of imports: forks of a server that has imported the packages.

A new Python process that imports rclpy, NumPy and rosbags uses half a second of CPU before it does
anything. A server imports them once and forks for each program. It runs no thread and initializes no
ROS. A child is a process like any other: it has its own process id, arguments, environment, working
directory, streams, signals and exit code, and its interpreter exits as usual. Only its imports are
done already. Tests of the start itself use `subprocess`.
"""

from __future__ import annotations

import atexit
import builtins
import ctypes
import fcntl
import gc
import importlib
import inspect
import io
import marshal
import math
import os
import pkgutil
import re
import select
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import types
import warnings
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import TextIO

PACKAGE = 'diffdrive_jacobian'
LIBRARIES = (
    *('numpy', 'matplotlib.figure', 'matplotlib.backends.backend_agg', 'rich.progress'),
    *('rosbags.rosbag2', 'rosbags.typesys.stores.ros2_jazzy', 'ruamel.yaml', 'apsw', 'lz4.frame'),
)
"""What programs without ROS import."""
EVERYTHING = (*LIBRARIES, 'pytest', 'rclpy.executors', 'rclpy.node', PACKAGE)
"""What all programs import. A package is imported with its modules, and the messages are loaded."""
SETS = (EVERYTHING, LIBRARIES, ())
"""What servers import: each of these sets has a server of its own."""
LARGEST = 1 << 20
"""Size of the largest request (bytes)."""
RESERVED = 100
"""Number of descriptors, from 0, that the libraries of a server do not get."""
SERVER = """
import sys
sys.path.append(sys.argv[1])
from forked import serve
sys.path.pop()
serve(int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
"""


# --- In the server


def serve(descriptor: int, listening: int, modules: list[str]) -> None:
    """Import modules and fork for each request, until the process that has started this one ends.

    `descriptor` is the connection to that, `listening` the socket to which all others connect.
    """
    # Children get descriptors of these numbers, as a rule. Libraries must not have them.
    for _ in range(RESERVED):
        os.open(os.devnull, os.O_RDONLY)
    # Ctrl-C ends the tests, which close the socket.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    starter = socket.socket(fileno=descriptor)
    listener = socket.socket(fileno=listening)
    shared = _SharedModules()
    for name in modules:
        _import(name)
    assert threading.active_count() == 1, 'a process that runs threads cannot be forked'
    tracing = _Tracing()
    shared.keep()
    children: dict[socket.socket, set[int]] = {starter: set()}
    while True:
        for ready in select.select([listener, *children], [], [])[0]:
            if ready is listener:
                children[listener.accept()[0]] = set()
                continue
            data, received = b'', []
            with suppress(ConnectionError):
                data, received, _, _ = socket.recv_fds(ready, LARGEST, RESERVED)
            if not data:
                ready.close()
                if ready is starter:
                    return
                # The command was killed.
                for pid in children.pop(ready):
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
                continue
            request = marshal.loads(data)
            if isinstance(request, int):
                code = os.waitstatus_to_exitcode(os.waitpid(request, 0)[1])
                children[ready].discard(request)
                _answer(ready, code)
                continue
            # Signals that come before the child is ready for them wait.
            signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
            with warnings.catch_warnings():
                warnings.simplefilter('ignore', DeprecationWarning)
                tracing.before_fork()
                pid = os.fork()
                tracing.after_fork(child=pid == 0)
            if pid == 0:
                for each in (listener, *children):
                    each.close()
                numbers, *program = request
                # First out of the way: a number of one may be that which another is to have.
                above = max([RESERVED, *(number + 1 for number in numbers)])
                sources = [fcntl.fcntl(each, fcntl.F_DUPFD_CLOEXEC, above) for each in received]
                for each in received:
                    os.close(each)
                os.closerange(0, RESERVED)
                for number, source in zip(numbers, sources, strict=True):
                    os.dup2(source, number)
                    os.close(source)
                _run(*program)
                return
            signal.pthread_sigmask(signal.SIG_SETMASK, ())
            for each in received:
                os.close(each)
            children[ready].add(pid)
            _answer(ready, pid)


def _answer(connection: socket.socket, number: int) -> None:
    """Send an answer. Who has closed the connection meanwhile is noticed when it is read next."""
    with suppress(ConnectionError):
        connection.send(marshal.dumps(number))


class _SharedModules:
    """Keeps children from touching what was imported for them when they exit.

    To clear it, in memory that is shared until then, would take longer than all else. What they have
    imported and created themselves is cleared as usual.
    """

    def __init__(self) -> None:
        # Before modules are imported whose functions are to be called at the exit.
        self._removed: dict[str, None] = {}
        # The interpreter does the same as it exits, and clears the modules that it finds there.
        atexit.register(sys.modules.update, self._removed)

    def keep(self) -> None:
        gc.collect()
        gc.freeze()
        modules = {
            name: module for name, module in sys.modules.items() if name not in ('sys', 'builtins')
        }
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(modules))
        self._removed.update(dict.fromkeys(modules))


class _Tracing:
    """The library of LTTng, which rclpy loads and which starts two threads of its own.

    It has to know of a fork: when a child exits, the library ends threads that the child does not have.
    """

    def __init__(self) -> None:
        maps = Path('/proc/self/maps').read_text()
        found = re.search(r'/\S*/liblttng-ust[-\da-f]*\.so\S*', maps)
        self._library = ctypes.CDLL(found[0]) if found else None
        self._signals = ctypes.create_string_buffer(128)

    def before_fork(self) -> None:
        self._call('before_fork')

    def after_fork(self, *, child: bool) -> None:
        """Continue in one of the two processes. The child starts the threads of its own."""
        self._call('after_fork_child' if child else 'after_fork_parent')

    def _call(self, name: str) -> None:
        if self._library is None:
            return
        # Newer libraries have another prefix.
        prefix = 'lttng_ust_' if hasattr(self._library, f'lttng_ust_{name}') else 'ust_'
        getattr(self._library, prefix + name)(self._signals)


def _import(name: str) -> None:
    module = importlib.import_module(name)
    if name != PACKAGE:
        return
    for each in pkgutil.walk_packages(module.__path__, f'{name}.'):
        # What tests use is not part of any program: pytest warns of plugins, as that of Hypothesis,
        # that were imported before it.
        if not each.name.startswith((f'{name}.testing', f'{name}.exploration')):
            importlib.import_module(each.name)
    # The first message to a log looks up the files of all modules.
    inspect.getmodule(sys._getframe())
    from rclpy.type_support import check_for_type_support

    for package in [name for name in sys.modules if name.endswith('_msgs.msg')]:
        for each in vars(sys.modules[package]).values():
            if isinstance(each, type):
                check_for_type_support(each)


def _run(python: str, code: str, argv: list[str], directory: str, environment: dict[str, str]) -> None:
    """Run a program, as `python -c CODE ARGUMENTS` does, or `python FILE ARGUMENTS`.

    `python` becomes `sys.executable`. Empty: that of the server.
    """
    for number, name in enumerate(('stdin', 'stdout', 'stderr')):
        unbuffered = bool(environment.get('PYTHONUNBUFFERED'))
        stream = _text_stream(getattr(sys, name), number, unbuffered=unbuffered)
        setattr(sys, name, stream)
        setattr(sys, f'__{name}__', stream)
    inherited = _python_path(os.environ, os.getcwd())
    os.chdir(directory)
    sys.argv[:] = argv
    sys.executable = python or sys.executable
    own = '' if argv[0] == '-c' else os.path.dirname(os.path.abspath(argv[0]))
    added = _python_path(environment, directory)
    sys.path[:] = [own, *added, *(path for path in sys.path[1:] if path not in inherited)]
    # A directory that was missing may be there now.
    for path in [path for path, finder in sys.path_importer_cache.items() if finder is None]:
        del sys.path_importer_cache[path]
    os.environ.clear()
    os.environ.update(environment)
    main = sys.modules['__main__'] = types.ModuleType('__main__')
    if argv[0] != '-c':
        main.__file__ = argv[0]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    with _QuickExit():
        exec(compile(code, '<string>' if argv[0] == '-c' else argv[0], 'exec'), vars(main))


class _QuickExit:
    """Ends the process once the interpreter has cleared all modules, which is the last that can be seen.

    What remains, to release each string and type that the server had imported, would copy the memory
    that is shared with it: half the CPU time of a short program.
    """

    def __init__(self) -> None:
        self._code: int | None = None
        self._exit = ctypes.CDLL(None).exit
        # Called last: registered first.
        atexit.register(self._flush)
        # Builtins are cleared last.
        builtins._quick_exit = self  # type: ignore[attr-defined]

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        if isinstance(error, SystemExit):
            code = 0 if error.code is None else error.code
            self._code = code if isinstance(code, int) else 1
        elif not isinstance(error, KeyboardInterrupt):
            self._code = 0 if error is None else 1

    def _flush(self) -> None:
        try:
            sys.stdout.flush()
        except (OSError, ValueError):
            # The interpreter reports that, with another exit code.
            self._code = None

    def __del__(self) -> None:
        if self._code is not None:
            self._exit(self._code)


def _python_path(environment: Mapping[str, str], directory: str) -> list[str]:
    """Return the directories that the variable PYTHONPATH adds to the path of modules."""
    paths = environment.get('PYTHONPATH', '')
    # An empty entry is the working directory.
    entries = paths.split(os.pathsep) if paths else []
    return [os.path.abspath(os.path.join(directory, entry)) for entry in entries]


def _text_stream(original: TextIO, descriptor: int, *, unbuffered: bool) -> io.TextIOWrapper:
    """Return a standard stream as the interpreter opens it."""
    mode, buffering = 'wb' if descriptor else 'rb', 0 if descriptor and unbuffered else -1
    return io.TextIOWrapper(
        open(descriptor, mode, buffering, closefd=False),
        encoding=original.encoding,
        errors=original.errors,
        line_buffering=not unbuffered and (descriptor == 2 or os.isatty(descriptor)),
        write_through=unbuffered,
    )


# --- In the tests


def _listen(modules: tuple[str, ...], folder: str) -> socket.socket:
    """Create the socket of the server that imports these modules."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(_path(modules, folder))
    listener.listen(100)
    return listener


def _start(modules: tuple[str, ...], listener: socket.socket, *, when_used: bool = False) -> None:
    """Start a server, which ends with this process."""
    if when_used:
        select.select([listener], [], [])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs, listener:
        passed = [theirs.fileno(), listener.fileno()]
        process = subprocess.Popen(
            [sys.executable, '-c', SERVER, str(Path(__file__).parent), *map(str, passed), *modules],
            stdin=subprocess.DEVNULL,
            pass_fds=passed,
            # NumPy starts a thread for every core otherwise.
            env={**os.environ, 'OPENBLAS_NUM_THREADS': '1', 'ROS_PYTHON_CHECK_FIELDS': '1'},
        )
    atexit.register(process.wait)
    atexit.register(ours.close)


class _Connection:
    """A connection to a server. Threads may share it."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(path)
        atexit.register(self._socket.close)

    def ask(self, request: object, descriptors: tuple[int, ...] = ()) -> int:
        """Send a request; return the answer."""
        with self._lock:
            socket.send_fds(self._socket, [marshal.dumps(request)], descriptors)
            answer = self._socket.recv(LARGEST)
        assert answer, 'the server of forks has ended'
        number: int = marshal.loads(answer)
        return number


def _path(modules: tuple[str, ...], folder: str) -> str:
    return os.path.join(folder, str(SETS.index(modules)))


def _folder() -> str:
    """Create a folder for sockets, which is removed when this process ends; return it."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    return folder.name


_shared: list[str] = []


@lru_cache
def share() -> str:
    """Let other processes use the servers of this one; return what they must pass to `use`.

    A server starts when it is used first.
    """
    folder = _folder()
    for modules in SETS:
        start = partial(_start, modules, _listen(modules, folder), when_used=True)
        threading.Thread(target=start, daemon=True).start()
    return folder


def use(folder: str) -> None:
    """Use the servers of the process that has called `share`."""
    _shared.append(folder)


@lru_cache
def _server(modules: tuple[str, ...], process: int) -> _Connection:
    if _shared:
        return _Connection(_path(modules, _shared[-1]))
    folder = _folder()
    _start(modules, _listen(modules, folder))
    return _Connection(_path(modules, folder))


class Popen:
    """A program in a fork of the server; used like `subprocess.Popen`."""

    def __init__(
        self, code, arguments=(), *, modules=EVERYTHING, cwd=None, env=None, stdout=None, stderr=None
    ):
        """Run `python -c CODE ARGUMENTS` in a fork of the server that has imported `modules`."""
        argv = ['-c', *map(str, arguments)]
        self.args = [sys.executable, '-c', code, *argv[1:]]
        self.returncode = None
        self._opened = []
        null = os.open(os.devnull, os.O_RDONLY)
        self.stdout, out = self._output(stdout, 1)
        self.stderr, error = self._output(stderr, 2)
        self._server = _server(modules, os.getpid())
        request = ([0, 1, 2], '', code, argv, os.fspath(cwd or os.getcwd()), dict(env or os.environ))
        self.pid = self._server.ask(request, (null, out, error))
        for each in (null, *self._opened):
            os.close(each)
        self._pidfd = os.pidfd_open(self.pid)

    def _output(self, stream, default):
        if stream == subprocess.PIPE:
            read, write = os.pipe()
            self._opened.append(write)
            return open(read), write
        if stream is None:
            return None, default
        return None, stream if isinstance(stream, int) else stream.fileno()

    def poll(self):
        """Return the exit code, negative if a signal ended it. None: it runs."""
        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def wait(self, timeout=None):
        """Wait for its end; return the exit code.

        Raises:
            subprocess.TimeoutExpired: It runs still.
        """
        if self.returncode is None:
            # Not select, which takes no descriptor beyond 1023.
            ended = select.poll()
            ended.register(self._pidfd, select.POLLIN)
            if not ended.poll(None if timeout is None else math.ceil(timeout * 1e3)):
                raise subprocess.TimeoutExpired(self.args, timeout)
            self.returncode = self._server.ask(self.pid)
            os.close(self._pidfd)
        return self.returncode

    def send_signal(self, number):
        """Send a signal; nothing happens if it has ended."""
        if self.poll() is None:
            signal.pidfd_send_signal(self._pidfd, number)

    def kill(self):
        """Kill it."""
        self.send_signal(signal.SIGKILL)


def run(code, arguments=(), *, stdout=None, timeout=None, **kwargs):
    """Run a program to its end; return what it printed, as `subprocess.run` with `capture_output=True`.

    What goes into a given `stdout` is not returned.
    """
    with tempfile.TemporaryFile('w+') as out, tempfile.TemporaryFile('w+') as error:
        child = Popen(code, arguments, stdout=stdout or out, stderr=error, **kwargs)
        try:
            child.wait(timeout)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
            raise
        for file in (out, error):
            file.seek(0)
        return subprocess.CompletedProcess(child.args, child.returncode, out.read(), error.read())


def make_commands(folder, scripts):
    """Make commands that run Python scripts in forks of the server, in a folder; return that.

    A command is a small process of its own with the name of its script, which passes its arguments,
    streams and signals on, and ends as the script does. `python` among the scripts makes one that takes
    a file, `-c` or `-m` as the interpreter does, and with which the scripts start processes.
    """
    folder.mkdir()
    server = _server(EVERYTHING, os.getpid())
    client = Path(__file__).with_name('forked_command.py')
    python = folder / 'python' if 'python' in scripts else ''
    for script in scripts:
        path = folder / Path(script).name
        words = (sys.executable, '-IS', client, server.path, python, script)
        path.write_text(f'#!/bin/sh\nexec {shlex.join(map(str, words))} "$@"\n')
        path.chmod(0o755)
    return folder
