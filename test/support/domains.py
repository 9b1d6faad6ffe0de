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

"""ROS domains for tests: processes of different workers of pytest-xdist never share one."""

from __future__ import annotations

import itertools
import os
import zlib

DOMAINS = 100
"""Number of domains that are used. Larger ones have ports that other programs may take."""
_numbers = itertools.count()


def domain_id() -> int:
    """Return a domain that no other worker uses, and this one has not used for long."""
    worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
    span = DOMAINS // int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
    # Other runs on this machine begin elsewhere.
    run = zlib.crc32(os.environ.get('PYTEST_XDIST_TESTRUNUID', str(os.getpid())).encode())
    return 1 + worker * span + (run + next(_numbers)) % span
