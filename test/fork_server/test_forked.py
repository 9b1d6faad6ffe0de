"""Programs in forks of a server behave like programs in processes of their own."""

from __future__ import annotations

import fcntl
import marshal
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from fork_server import forked

pytestmark = pytest.mark.process
STATE = """
import os, signal, sys
shell = ('_', 'OLDPWD', 'PWD', 'SHLVL')
print(sys.argv, __name__, os.getcwd(), globals().get('__file__'))
print(*sorted(item for item in os.environ.items() if item[0] not in shell), sep='\\n')
print(*sys.path, sep='\\n')
print([(stream.encoding, stream.errors, stream.line_buffering, stream.write_through)
       for stream in (sys.stdin, sys.stdout, sys.stderr)])
print(sys.stdin.read(), os.getpgid(0), sys.getswitchinterval(), sys.warnoptions)
print([signal.getsignal(number) for number in sorted(signal.valid_signals())])
print(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
print('error', file=sys.stderr)
sys.exit(3)
"""
EXITS = """
import atexit, os, threading

class Open:
    def __del__(self):
        os.write(1, b'cleared ')

kept = Open()
atexit.register(os.write, 1, b'atexit ')
threading.Thread(target=lambda: os.write(1, b'thread ')).start()
print('printed', end=' ')
"""
WAITS = """
import time
print('waits', flush=True)
time.sleep(60)
"""
ROS = """
import rclpy
rclpy.init()
node = rclpy.create_node('name')
print(node.get_name(), len(node.get_topic_names_and_types()))
rclpy.shutdown()
"""


def results(ended):
    return ended.returncode, ended.stdout, ended.stderr


def interpreter(code, *arguments, stdout=subprocess.PIPE, **kwargs):
    """Run a program in an interpreter of its own."""
    command = [sys.executable, '-c', code, *arguments]
    streams = {'stdin': subprocess.DEVNULL, 'stdout': stdout, 'stderr': subprocess.PIPE}
    return subprocess.run(command, text=True, timeout=60, **streams, **kwargs)


@pytest.mark.parametrize('unbuffered', ['', '1'])
def test_a_program_finds_what_it_finds_in_an_interpreter_of_its_own(tmp_path, unbuffered):
    environment = {**os.environ, 'PYTHONPATH': str(tmp_path), 'PYTHONUNBUFFERED': unbuffered, 'A': 'b'}
    keywords = {'cwd': tmp_path, 'env': environment}
    expected = results(interpreter(STATE, 'x', '-y', **keywords))
    assert results(forked.run(STATE, ('x', '-y'), **keywords)) == expected


def test_the_interpreter_exits_as_usual():
    environment = {**os.environ, 'PYTHONUNBUFFERED': ''}
    expected = results(interpreter(EXITS, env=environment))
    assert expected == (0, 'thread atexit printed cleared ', '')
    assert results(forked.run(EXITS, env=environment)) == expected


@pytest.mark.parametrize(
    ('end', 'code', 'last'),
    [
        ('', 0, ''),
        ('sys.exit("text")', 1, 'text'),
        ('sys.exit(True)', 1, ''),
        ('raise KeyboardInterrupt', -signal.SIGINT, 'KeyboardInterrupt'),
        ('1 / 0', 1, 'ZeroDivisionError: division by zero'),
    ],
)
def test_the_exit_code_is_that_of_an_interpreter(end, code, last):
    program = f'import sys; print(1); {end}'
    ended = forked.run(program)
    assert (ended.returncode, ended.stdout) == (code, '1\n')
    assert ended.stderr.rstrip().rpartition('\n')[2] == last
    # What was printed cannot be written.
    buffered = {'env': {**os.environ, 'PYTHONUNBUFFERED': ''}}
    with open('/dev/full', 'w') as full:
        expected = interpreter(program, stdout=full, **buffered).returncode
        assert expected == (code if code < 0 else 120)
        assert forked.run(program, stdout=full, **buffered).returncode == expected


SHARED = """
import os, sys
sys.path.append(sys.argv[1])
from fork_server import forked
forked.use(sys.argv[2])
print(forked.run('import os; print(os.getppid())', modules=()).stdout.strip())
"""


def test_processes_share_a_server():
    arguments = [Path(forked.__file__).parents[1], forked.share()]
    one, other = (forked.run(SHARED, arguments, modules=()) for _ in range(2))
    assert one.stdout == other.stdout
    assert int(one.stdout) != os.getpid()


def test_a_server_goes_on_after_a_command_that_was_killed_before_the_answer():
    program = ('', 'import time; time.sleep(60)', ['-c'], os.getcwd(), dict(os.environ))
    for _ in range(5):
        command = forked._Connection(forked._server(forked.EVERYTHING, os.getpid()).path)
        socket.send_fds(command._socket, [marshal.dumps(((), *program))], ())
        command._socket.close()
    assert forked.run('raise SystemExit(3)').returncode == 3


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL, signal.SIGHUP, signal.SIGINT])
def test_a_signal_ends_a_program(number):
    child = forked.Popen(WAITS, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with child.stdout, child.stderr:
        assert child.stdout.readline() == 'waits\n'
        assert child.poll() is None
        child.send_signal(number)
        assert child.wait(60) == -number
        assert child.poll() == -number
        child.send_signal(number)
        assert ('KeyboardInterrupt' in child.stderr.read()) == (number == signal.SIGINT)


def test_a_program_that_lasts_too_long_is_killed():
    with pytest.raises(subprocess.TimeoutExpired):
        forked.run(WAITS, timeout=0.0)


def test_ros_starts_and_ends_in_a_fork():
    for _ in range(2):
        assert results(forked.run(ROS)) == (0, 'name 2\n', '')


# --- Commands


@pytest.fixture
def commands(tmp_path):
    """Return a folder with a command that runs a script."""
    scripts = tmp_path / 'scripts'
    scripts.mkdir()
    (scripts / 'state').write_text(STATE)
    (scripts / 'state.py').write_text(STATE)
    (scripts / 'waits').write_text(WAITS)
    return forked.make_commands(tmp_path / 'commands', ['python', scripts / 'state', scripts / 'waits'])


def test_a_command_runs_a_script_as_the_interpreter_does(tmp_path, commands):
    def run(*command):
        return results(
            subprocess.run(
                command, cwd=tmp_path, capture_output=True, text=True, stdin=subprocess.DEVNULL
            )
        )

    script = tmp_path / 'scripts' / 'state'
    assert run(commands / 'state', 'x y', '$z') == run(sys.executable, script, 'x y', '$z')
    for words in (['-c', STATE, 'x'], [script, 'x'], ['-m', 'scripts.state', 'x']):
        assert run(commands / 'python', *words) == run(sys.executable, *words)


def test_a_command_starts_python_in_a_fork(commands):
    code = 'import sys; print("numpy" in sys.modules)'
    starting = f'import subprocess, sys; subprocess.run([sys.executable, "-c", {code!r}])'
    ended = subprocess.run([commands / 'python', '-c', starting], capture_output=True, text=True)
    assert results(ended) == (0, 'True\n', '')


@pytest.mark.parametrize('least', [0, 100, 101, 102, 103, 300])
def test_a_command_inherits_descriptors(commands, least):
    """Also of numbers that the server itself uses, as from a process with many open files."""
    read, write = os.pipe()
    with open(read) as stream:
        passed = fcntl.fcntl(write, fcntl.F_DUPFD, least)
        os.close(write)
        code = 'import os, sys; os.write(int(sys.argv[1]), b"from the child")'
        subprocess.run([commands / 'python', '-c', code, str(passed)], pass_fds=[passed], check=True)
        os.close(passed)
        assert stream.read() == 'from the child'


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_command_passes_signals_on_and_ends_as_its_script(commands, number):
    streams = {'stdout': subprocess.PIPE, 'stderr': subprocess.DEVNULL}
    with subprocess.Popen([commands / 'waits'], **streams) as child:
        assert child.stdout.readline() == b'waits\n'
        child.send_signal(number)
        assert child.wait(60) == -number


def test_a_script_does_not_outlive_its_command(commands):
    with subprocess.Popen([commands / 'waits'], stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b'waits\n'
        child.kill()
        # The end of the output comes when the script has ended.
        assert child.stdout.read() == b''
