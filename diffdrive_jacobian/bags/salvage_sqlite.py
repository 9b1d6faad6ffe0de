"""Messages of a damaged SQLite file: all that are complete.

SQLite (sqlite.org/fileformat2.html) is read by its leaf pages, since the tree above them may be missing
or out of date. So rows are found that were written but not committed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, BinaryIO

from diffdrive_jacobian.bags.files import SQLITE_MAGIC
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.bags.limits import Budget, check_record
from diffdrive_jacobian.bags.salvage_mcap import Found, Note, Topic

_LEAF = 0x0D
_WIDTHS = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)  # of the serial types below 10
_MAX_COLUMNS = 32
_MESSAGE = [int, int, bytes]
"""Types of the columns of a message after its number: topic, time and data."""
_LOCKS = 1 << 30
"""Place of the page that SQLite uses for locks only."""
_COPIES = 4
"""Largest ratio of the size of all rows to that of the file: there may be older copies of pages."""


class _Pages:
    """An SQLite file as pages, numbered from 1, and the rows that those hold."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.bytes = file.seek(0, 2)
        file.seek(0)
        head = file.read(100).ljust(100, b'\0')
        self.size = {1: 65536}.get(size := int.from_bytes(head[16:18], 'big'), size)
        self.valid = head.startswith(SQLITE_MAGIC) and self.size in [2**n for n in range(9, 17)]
        self.usable = self.size - head[20]
        self.count = self.bytes // self.size if self.valid else 0
        self._budget = Budget(self.bytes, ratio=_COPIES)
        # Number of pages at the last commit; 0: unknown.
        self.committed = int.from_bytes(head[28:32], 'big') if head[24:28] == head[92:96] else 0
        self._locks = _LOCKS // self.size + 1 if self.valid else 0
        self._unused = int.from_bytes(head[36:40], 'big')
        # Ends of chains with nothing but zeros, as of a black picture.
        self._zero_ends: set[int] = set()

    def page(self, number: int) -> bytes:
        self._file.seek((number - 1) * self.size)
        return self._file.read(self.size)

    def erased(self) -> int:
        """Return the number of committed pages that hold nothing but zeros and should not.

        The ends of chains are known after their rows were read. SQLite clears pages that it does not
        use any more, and never writes the page of its locks.
        """
        zeros = bytes(self.size)
        numbers = range(1, min(self.count, self.committed) + 1)
        empty = sum(self.page(number) == zeros for number in numbers if number != self._locks)
        return max(0, empty - len(self._zero_ends) - self._unused)

    def rows(self, number: int) -> Iterator[tuple[int, list[Any] | None]]:
        """Yield number and values of the rows of a table's leaf page; None: a row cannot be read."""
        page, start = self.page(number), 100 if number == 1 else 0
        if page[start] != _LEAF:
            return
        count = int.from_bytes(page[start + 3 : start + 5], 'big')
        # A row takes six bytes at least.
        for index in range(min(count, self.size // 6)):
            row, at = 0, start + 8 + 2 * index
            try:
                length, at = _varint(page, int.from_bytes(page[at : at + 2], 'big'))
                row, at = _varint(page, at)
                yield row, _values(self._payload(page, at, length))
            except (ValueError, IndexError):
                yield row, None

    def _payload(self, page: bytes, at: int, length: int) -> bytes:
        """Return the content of a cell, which may continue in a chain of overflow pages."""
        most, least = self.usable - 35, (self.usable - 12) * 32 // 255 - 23
        local = length
        if length > most:
            local = least + (length - least) % (self.usable - 4)
            local = local if local <= most else least
        check_record(length, 'a row')
        self._budget.spend(length)
        parts = [page[at : at + local]]
        missing = length - len(parts[0])
        following = page[at + local : at + local + 4] if local < length else b''
        seen: set[int] = set()
        number, more = 0, b''
        while missing > 0 and len(parts[0]) == local:
            number = int.from_bytes(following, 'big')
            if not 1 < number <= self.count or number in seen:
                raise ValueError('the chain of pages is incomplete or a cycle')
            seen.add(number)
            more = self.page(number)
            # Before a commit, pages may exist without their content.
            if number > self.committed and not any(more):
                raise ValueError('a page of the chain was never written')
            parts.append(more[4 : min(self.usable, 4 + missing)])
            missing -= len(parts[-1])
            following = more[:4]
        if missing or any(following):
            raise ValueError(f'{length} bytes expected, {missing} are missing')
        if number and not any(more):
            self._zero_ends.add(number)
        return b''.join(parts)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for place in range(at, at + 8):
        value = value << 7 | data[place] & 0x7F
        if data[place] < 0x80:
            return value, place + 1
    return value << 8 | data[at + 8], at + 9


def _values(record: bytes) -> list[Any]:
    """Return the values of a row, or raise ValueError or IndexError if it is invalid."""
    body, at = _varint(record, 0)
    place = body
    values: list[Any] = []
    while at < body:
        kind, at = _varint(record, at)
        if kind in (10, 11) or len(values) == _MAX_COLUMNS:
            raise ValueError(f'invalid serial type, or too many columns: {kind}')
        width = _WIDTHS[kind] if kind < 10 else (kind - 12) // 2
        raw, place = record[place : place + width], place + width
        if kind >= 12:
            values.append(raw.decode() if kind % 2 else raw)
        else:
            number = kind - 8 if kind >= 8 else int.from_bytes(raw, 'big', signed=True)
            values.append(number if kind not in (0, 7) else None)
    if (at, place) != (body, len(record)):
        raise ValueError(f'a row of {place} bytes expected, got {len(record)}')
    return values


def read_sqlite(file: BinaryIO, note: Note, doubt: Note) -> Iterator[Found]:
    """Read an SQLite file of rosbag2, including rows that were not committed, in their order.

    Args:
        file: The file.
        note: Is called with a description of each loss.
        doubt: Is called with what cannot be checked.
    """
    doubt('SQLite has no checksums, so altered messages cannot be noticed')
    pages = _Pages(file)
    if not pages.valid:
        note(f'its {pages.bytes} bytes are not the start of an SQLite database')
        return
    topics: dict[int, list[Any]] = {}
    definitions: dict[str, str] = {}
    starts: list[tuple[int, int]] = []
    for number in range(1, pages.count + 1):
        for row, values in pages.rows(number):
            if not values or values[0] is not None:
                continue
            kinds = [type(value) for value in values[1:]]
            if kinds == _MESSAGE:
                starts.append((row, number))
                break
            if kinds == [int, str]:
                yield values[2]
            elif set(kinds) == {str} and values[1].startswith('/'):
                topics[row] = values[1:]
            elif kinds == [str] * 4:
                definitions[values[1]] = values[3]
    for row, values in topics.items():
        name, kind, encoding, qos, type_hash = [*values, '', ''][:5]
        yield Topic(row, name, kind, encoding, qos, type_hash, definitions.get(kind, ''))
    last = read = 0
    starts.sort()
    for (_, number), (limit, _) in zip(starts, [*starts, (2**63, 0)][1:], strict=True):
        for row, values in pages.rows(number):
            # There may be older copies of pages.
            if values and [type(value) for value in values[1:]] == _MESSAGE and last < row < limit:
                yield Message(*values[1:])
                last, read = row, read + 1
    if last > read:
        note(f'{last - read} of its first {last} messages cannot be read')
    if erased := pages.erased():
        note(f'{erased} of its {pages.committed} pages are empty: what was in them is lost')
    if missing := max(pages.committed * pages.size - pages.bytes, pages.bytes % pages.size):
        note(f'it is cut off: {missing} bytes are missing or are not a complete page')
