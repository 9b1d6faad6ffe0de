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

"""Damaged messages: numbers that are not finite, wrong lengths, flipped, missing and random bytes."""

from __future__ import annotations

import math
import struct

DOUBLES = (
    *(math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1.7e308, -1.7e308, 1e9, -1e9, 0.0, -0.0),
    *(math.pi, 1e-9, 1e-160, 1e160),
)
LENGTHS = (0, 1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1)
TEXTS = (b'\x1b[2J\x1b]0;x\x07', b'\xff\xfe', b'a' * 5000, b'\n\r\0', '\u202e'.encode(), b'=1+1', b'')


def damaged(chance, data):
    """Return a serialized message damaged in one or a few ways, drawn from a `random.Random`."""
    found = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 4))):
        size = len(found)
        what = chance.randrange(8)
        if what <= 1 and size >= 12:
            # Doubles lie at multiples of 8 behind the encapsulation.
            at = 4 + 8 * chance.randrange((size - 4) // 8)
            struct.pack_into('<d', found, at, chance.choice(DOUBLES))
        elif what == 2 and size >= 8:
            at = 4 * chance.randrange(1, size // 4)
            struct.pack_into('<I', found, at, chance.choice(LENGTHS))
        elif what == 3 and size:
            for _ in range(chance.choice((1, 3, 30))):
                found[chance.randrange(size)] ^= 1 << chance.randrange(8)
        elif what == 4:
            del found[chance.randrange(size + 1) :]
        elif what == 5:
            found += chance.randbytes(chance.choice((1, 4, 100, 5000)))
        elif what == 6 and size >= 4:
            found[:4] = chance.choice((b'\0\0\0\0', b'\0\1\0\0', b'\0\2\0\0', b'\0\3\0\0', b'\xff' * 4))
        elif size >= 8:
            text = chance.choice(TEXTS)
            at = 4 * chance.randrange(1, size // 4)
            found[at:at] = struct.pack('<I', len(text) + 1) + text + b'\0'
    if chance.random() < 0.02:
        return chance.randbytes(chance.choice((0, 1, 3, 4, 8, 60, 1000)))
    return bytes(found)
