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

"""Relations between a world and its image: what nodes say must be the image of what they said.

    from diffdrive_jacobian.relations import Mirrored
    from diffdrive_jacobian.testing import explore

    explore(drive, relations=[Mirrored()], ...)

No property needs to know what is right: what is right in one place is right in its mirror image.
`check_relation` checks a relation in one world. For relations of your own, derive from `Relation`. Those
of a robot are imported on first use.
"""

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy
from diffdrive_jacobian.relations.arrival import Late, Repeated
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.relations.checking import check_relation
from diffdrive_jacobian.relations.whole_world import Renamed, Shifted

if TYPE_CHECKING:
    from diffdrive_jacobian.robot_testing.symmetry import Mirrored, Moved

__all__ = [
    'Late',
    'Mirrored',
    'Moved',
    'Relation',
    'Renamed',
    'Repeated',
    'Shifted',
    'check_relation',
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__, dict.fromkeys(('Mirrored', 'Moved'), 'robot_testing.symmetry')
    )
