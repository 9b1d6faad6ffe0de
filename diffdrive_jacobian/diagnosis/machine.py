"""The machine that nodes run on: shared memory, network interfaces, multicast."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from diffdrive_jacobian.diagnosis.description import Finding
from diffdrive_jacobian.text import format_size, printable

SHARED_MEMORY = Path('/dev/shm')
SIOCGIFFLAGS = 0x8913
"""Request for the flags of an interface, as in linux/sockios.h."""
IFF_UP, IFF_LOOPBACK, IFF_MULTICAST = 0x1, 0x8, 0x1000
"""Flags of network interfaces, as in linux/if.h."""
MULTICAST_GROUP = '239.255.0.1'
"""Group by which participants of DDS discover each other."""
MULTICAST_PATIENCE = 0.3
"""Longest way of a message to this process itself (s)."""
SCARCE = 4_000_000
"""Free shared memory below which segments cannot be created (bytes). A participant needs 0.7 MB."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SharedMemory:
    """The directory in which Fast DDS exchanges messages on one machine."""

    size: int
    """Size (bytes)."""
    free: int
    """Free space (bytes)."""
    writable: bool = True
    stale: int = 0
    """Number of segments of processes that were killed."""
    stale_bytes: int = 0
    """Their size (bytes)."""


@dataclass(frozen=True, slots=True)
class Interface:
    """A network interface."""

    name: str
    up: bool
    loopback: bool
    multicast: bool


def shared_memory(path: Path = SHARED_MEMORY) -> SharedMemory | None:
    """Return the state of the shared memory. None: there is none."""
    try:
        usage = shutil.disk_usage(path)
    except OSError:
        return None
    stale = list(_stale_segments(path))
    return SharedMemory(
        size=usage.total,
        free=usage.free,
        writable=os.access(path, os.W_OK | os.X_OK),
        stale=len(stale),
        stale_bytes=sum(stale),
    )


def _stale_segments(path: Path) -> Iterator[int]:
    """Yield the sizes of the segments of Fast DDS whose process has ended (bytes).

    Each segment has a file with `_el` at its end, which a living process keeps locked.
    """
    with suppress(OSError):
        for lock in path.glob('fastrtps_*_el'):
            with suppress(OSError), lock.open('rb') as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                yield lock.with_name(lock.name.removesuffix('_el')).stat().st_size


def interfaces() -> tuple[Interface, ...]:
    """Return the network interfaces, sorted by name. Empty: they are unknown."""
    found = []
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as query:
        for _, name in socket.if_nameindex():
            request = struct.pack('16sh22x', name.encode(), 0)
            _, flags = struct.unpack('16sH22x', fcntl.ioctl(query, SIOCGIFFLAGS, request))
            found.append(
                Interface(
                    printable(name),
                    up=bool(flags & IFF_UP),
                    loopback=bool(flags & IFF_LOOPBACK),
                    multicast=bool(flags & IFF_MULTICAST),
                )
            )
    return tuple(sorted(found, key=lambda one: one.name))


def multicast_error() -> str:
    """Send a multicast message to this process; return why it did not arrive, or ''."""
    word = secrets.token_bytes(16)
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        ):
            receiver.bind(('', 0))
            member = socket.inet_aton(MULTICAST_GROUP) + socket.inet_aton('0.0.0.0')
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            receiver.settimeout(MULTICAST_PATIENCE)
            sender.sendto(word, (MULTICAST_GROUP, receiver.getsockname()[1]))
            while receiver.recv(64) != word:
                pass
    except TimeoutError:
        return 'no message arrives'
    except OSError as error:
        return (error.strerror or str(error)).lower()
    return ''


def check_shared_memory(memory: SharedMemory | None) -> Iterator[Finding]:
    """Yield what is wrong with the shared memory."""
    if memory is None or not memory.writable:
        yield Finding(
            f'{SHARED_MEMORY} is missing or cannot be written: Fast DDS sends messages by the network',
            f'mount a tmpfs on {SHARED_MEMORY} (in a container: --ipc=host or --shm-size)',
            problem=False,
        )
        return
    stale = f'{memory.stale} segments of killed processes in {SHARED_MEMORY}'
    if memory.free < SCARCE:
        held = f', {format_size(memory.stale_bytes)} of it in {stale}' if memory.stale else ''
        yield Finding(
            f'{SHARED_MEMORY} is full: {format_size(memory.free)} of {format_size(memory.size)} are '
            f'free{held}',
            f'run `fastdds shm clean`, or enlarge {SHARED_MEMORY} (in a container: --shm-size=512m)',
        )
    elif memory.stale:
        yield Finding(
            f'{stale} take {format_size(memory.stale_bytes)}',
            'run `fastdds shm clean`, which removes them',
            problem=False,
        )


def check_network(found: tuple[Interface, ...], reach: str, multicast: str) -> Iterator[Finding]:
    """Yield what is wrong with the network.

    Args:
        found: The interfaces. Empty: they are unknown.
        reach: The discovery range.
        multicast: Why multicast does not work. Empty: it does, or was not tried.
    """
    loopback = [one for one in found if one.loopback]
    if found and not any(one.up for one in loopback):
        yield Finding(
            'the loopback interface is down: nodes on this machine do not find each other',
            'ip link set lo up',
        )
    if reach != 'SUBNET':
        return
    others = [one for one in found if one.up and not one.loopback]
    if found and not others:
        yield Finding(
            'no network interface is up: nodes on other machines are not found',
            'connect the network, or set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST',
            problem=False,
        )
    elif found and not any(one.multicast for one in others):
        names = ', '.join(one.name for one in others)
        yield Finding(
            f'no network interface has multicast ({names}): nodes on other machines are not found',
            f'ip link set {others[0].name} multicast on, or name the other machines in ROS_STATIC_PEERS',
        )
    elif multicast:
        yield Finding(
            f'multicast does not work ({multicast}): nodes on other machines are not found',
            'permit UDP to 239.255.0.0/16 in the firewall, or name the other machines in '
            'ROS_STATIC_PEERS',
            # Nodes on this machine find each other without it.
            problem=False,
        )
