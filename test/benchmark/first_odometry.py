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

"""Run a program; print when it first published odometry, and its CPU time until then (ns).

    python first_odometry.py SCRIPT

The time is that of the monotonic clock, which is the same for all processes. `Publisher.publish` of
rclpy is wrapped when the program imports it, until the first odometry. This file imports nothing slow,
so both sides start as they do without it. An observer in another process would add the time of
discovery.
"""

from __future__ import annotations

import sys
import time
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType


class Wrapper:
    """A finder that wraps `Publisher.publish` when its module is loaded."""

    @classmethod
    def find_spec(cls, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Return None for every other module."""
        if name != 'rclpy.publisher':
            return None
        spec = PathFinder.find_spec(name, path)
        load = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            load(module)
            wrap(module.Publisher)

        spec.loader.exec_module = exec_module
        return spec


def wrap(publisher: type) -> None:
    """Wrap `publish` until the first odometry was published."""
    publish = publisher.publish

    def first(self: object, message: object) -> None:
        publish(self, message)
        if self.topic_name == '/odom':
            print(time.monotonic_ns(), time.process_time_ns(), flush=True)
            publisher.publish = publish

    publisher.publish = first


sys.meta_path.insert(0, Wrapper)
sys.argv = sys.argv[1:]
with open(sys.argv[0], encoding='utf-8') as script:
    source = script.read()
exec(compile(source, sys.argv[0], 'exec'), {'__name__': '__main__'})
