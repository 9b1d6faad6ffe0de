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

"""Exercises that grade themselves: tests of pytest that call the functions of a hand-in.

    import pytest

    from diffdrive_jacobian.grading import agree


    @pytest.mark.points(2)
    def test_product(hand_in):
        '''The product of two numbers.'''
        agree(hand_in.call('product', 3.0, 4.0), 12.0, 'product(3, 4)')

`pytest exercise.py --hand-in alice.py` grades one hand-in, `grade_hand_ins exercise.py *.py` many. A
hand-in runs in a process of its own, which is ended if it takes too long, and which can open no file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.grading.answers import agree
    from diffdrive_jacobian.grading.hand_in import HandIn, HandInError
    from diffdrive_jacobian.grading.plugin import SavePicture

__all__ = ['HandIn', 'HandInError', 'SavePicture', 'agree']
if not TYPE_CHECKING:
    _MODULES = {'agree': 'answers', 'SavePicture': 'plugin'}
    __getattr__, __dir__ = lazy.attach(
        __name__, {name: f'grading.{_MODULES.get(name, "hand_in")}' for name in __all__}
    )
