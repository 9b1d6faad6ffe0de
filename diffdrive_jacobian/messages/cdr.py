"""Reading and writing single fields of serialized messages, without message objects.

rclpy converts each message between CDR bytes and nested Python objects, which costs several times what
sending the bytes costs. A `Writer` packs numbers into the bytes of a template. A `Reader` unpacks the
fields that are asked for. Both follow from the `Structure` of the message. None of them needs rclpy.

CDR, version 1: 4 bytes of encapsulation (0, 1 for little-endian or 0 for big-endian, and 2 that are
ignored), then the fields in order, each number aligned to its size. Alignment counts from the end of the
encapsulation.
"""

from __future__ import annotations

from diffdrive_jacobian.messages.cdr_reader import DecodingError as DecodingError
from diffdrive_jacobian.messages.cdr_reader import LongMessageError as LongMessageError
from diffdrive_jacobian.messages.cdr_reader import Reader as Reader
from diffdrive_jacobian.messages.cdr_writer import Writer as Writer
