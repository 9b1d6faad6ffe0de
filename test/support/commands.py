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

"""The commands of this package, run in the process of the test or in one process for many of them."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
from typing import NamedTuple

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import entry_points
from support.processes import run_python

COMMANDS = (*entry_points.NODES, *entry_points.tools())
EACH = """
import contextlib, io, json, sys
from diffdrive_jacobian.tools import entry_points

ended = []
for command, *arguments in json.loads(sys.argv[1]):
    sys.argv = [command, *arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = getattr(entry_points, command)()
        except SystemExit as end:
            code = end.code
    ended.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(ended))
"""
"""Runs many commands with their entry points."""


class Ended(NamedTuple):
    """What became of a command."""

    code: int
    out: str
    err: str


def run(command, *arguments, signals=None):
    """Run a command in this process."""
    arguments, signals = [str(one) for one in arguments], signals or Signals()
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            if command in entry_points.NODES:
                from diffdrive_jacobian.tools.run_node import run_node

                code = run_node(command, arguments, signals)
            else:
                tool = importlib.import_module(f'diffdrive_jacobian.tools.{command}')
                code = tool.main(arguments, signals)
        except SystemExit as end:
            code = end.code
    return Ended(code, out.getvalue(), err.getvalue())


def refused(command, *arguments, code=2):
    """Check that a command prints one error and nothing else; return the message."""
    ended = run(command, *arguments)
    assert (ended.code, ended.out) == (code, ''), ended
    return error_of(command, ended)


def error_of(command, ended):
    """Return the error with which a command has ended, without its name."""
    assert 'Traceback' not in ended.err, ended.err
    name, _, message = ended.err.splitlines()[-1].partition(': error: ')
    assert name == command, ended.err
    return message


def interrupted():
    """Return signals of which one has come."""
    signals = Signals()
    signals.count = 1
    return signals


def run_each(calls, before='', **kwargs):
    """Run commands one after the other, with their entry points, in one process of its own.

    Args:
        calls: Each is a command and its arguments.
        before: A program that runs first.
        kwargs: As for `subprocess.run`.
    """
    text = json.dumps([[str(word) for word in call] for call in calls])
    ended = run_python(before + EACH, text, **kwargs)
    assert ended.returncode == 0, ended.stderr
    return [Ended(*one) for one in json.loads(ended.stdout)]
