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

"""Bags of recorded runs: read as arrays, verified, and recovered after a crash. No ROS is needed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.bags.bag_reader import (
        BagError,
        DamagedBagError,
    )
    from diffdrive_jacobian.bags.files import NotABagError
    from diffdrive_jacobian.bags.recovery import (
        NothingToSaveError,
        Recovery,
        UncheckedError,
        recover,
    )
    from diffdrive_jacobian.bags.run import Run, Series, read_run
    from diffdrive_jacobian.bags.verification import Verification, verify

__all__ = [
    'BagError',
    'DamagedBagError',
    'NotABagError',
    'NothingToSaveError',
    'Recovery',
    'Run',
    'Series',
    'UncheckedError',
    'Verification',
    'read_run',
    'recover',
    'verify',
]
if not TYPE_CHECKING:
    # Whoever reads does not need what recovers, and the recorder neither.
    __getattr__, __dir__ = lazy.attach(
        __name__,
        {
            'BagError': 'bags.bag_reader',
            'DamagedBagError': 'bags.bag_reader',
            'NotABagError': 'bags.files',
            'NothingToSaveError': 'bags.recovery',
            'Recovery': 'bags.recovery',
            'Run': 'bags.run',
            'Series': 'bags.run',
            'UncheckedError': 'bags.recovery',
            'Verification': 'bags.verification',
            'read_run': 'bags.run',
            'recover': 'bags.recovery',
            'verify': 'bags.verification',
        },
    )
