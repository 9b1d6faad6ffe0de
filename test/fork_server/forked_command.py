"""A command that runs a Python script in a fork of the server, see `forked.make_commands`.

    python -IS forked_command.py SOCKET PYTHON SCRIPT ARGUMENT ...
    python -IS forked_command.py SOCKET PYTHON python (FILE | -c CODE | -m MODULE) ARGUMENT ...

PYTHON is what the script finds as `sys.executable`, empty: the interpreter of the server.

This is what a shell starts instead of the script, so it imports as little as possible: `signal` and
`socket` take longer to import, for their enumerations, than all that is done here.
"""

import _signal as signal
import _socket as socket
import marshal
import os
import select
import struct
import sys

FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
MODULE = """
import os, runpy, sys
sys.path[0] = os.getcwd()
runpy.run_module({!r}, run_name='__main__', alter_sys=True)
"""


def is_open(number):
    """Return whether a descriptor is open."""
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def main(path, python, script, *arguments):
    """Run the script, and end as it does."""
    inherited = [number for number in map(int, os.listdir('/proc/self/fd')) if is_open(number)]
    caught = []
    for number in FORWARDED:
        signal.signal(number, lambda number, _: caught.append(number))
    wakeup, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    server.connect(path)
    if script == 'python':
        script, *arguments = arguments
    if script in ('-c', '-m'):
        code, *arguments = arguments
        code = code if script == '-c' else MODULE.format(code)
        script = '-c'
    else:
        with open(script, encoding='utf-8') as file:
            code = file.read()
    request = marshal.dumps(
        (inherited, python, code, [script, *arguments], os.getcwd(), dict(os.environ))
    )
    descriptors = struct.pack(f'{len(inherited)}i', *inherited)
    server.sendmsg([request], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, descriptors)])
    pid = marshal.loads(server.recv(1000))
    # As if this process were the program: who reads its output sees its end.
    null = os.open(os.devnull, os.O_RDWR)
    for number in inherited:
        os.dup2(null, number)
    ended = os.pidfd_open(pid)
    while True:
        while caught:
            signal.pidfd_send_signal(ended, caught.pop(0))
        ready = select.select([ended, wakeup], [], [])[0]
        if ended in ready:
            break
        os.read(wakeup, 100)
    server.send(marshal.dumps(pid))
    code = marshal.loads(server.recv(1000))
    if code < 0:
        signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


main(*sys.argv[1:])
