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

"""What nodes run on: environment variables, versions, shared memory."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from diffdrive_jacobian import __version__
from diffdrive_jacobian.diagnosis.graph import Problem
from diffdrive_jacobian.locks import lock
from diffdrive_jacobian.text import format_size, how_to_get_ros, printable

DISTRIBUTION = 'jazzy'
"""The ROS distribution that this package is made for."""
WHEEL_VERSION = '7.1.'
"""Beginning of the version of its rclpy."""
WHEEL_RMW = 'rmw_fastrtps_cpp'
"""The only implementation of the middleware that the wheels have."""
RANGES = ('OFF', 'LOCALHOST', 'SUBNET', 'SYSTEM_DEFAULT')
SAFE_DOMAIN = 101
"""Largest domain whose ports do not collide with those that Linux gives to clients."""
MAX_DOMAIN = 232
ROS_PACKAGES = ('rclpy', 'geometry_msgs', 'nav_msgs', 'std_msgs', 'sensor_msgs', 'action_msgs')
"""Packages that must come from one installation."""
PYTHON_PACKAGES = ('numpy', 'rosbags', 'matplotlib')
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
VARIABLES = (
    *('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'),
    *('ROS_DISCOVERY_SERVER', 'ROS_DISTRO', 'RMW_IMPLEMENTATION', *PROFILES),
)
"""Environment variables that decide who finds whom."""
WHEELS, INSTALLATION = 'wheels', 'ROS installation'


@dataclass(frozen=True, kw_only=True, slots=True)
class Environment:
    """The environment of this process."""

    python: str
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of packages, by name. Those that are not installed are missing."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Where the packages of ROS come from, WHEELS or INSTALLATION, by name."""
    variables: Mapping[str, str] = field(default_factory=dict)
    """The environment variables that are set."""
    loopback: bool = True
    """Whether the loopback interface is up."""
    rmw_missing: bool = False
    """Whether the implementation in RMW_IMPLEMENTATION is not installed."""

    @property
    def domain(self) -> str:
        """The ROS domain, as text."""
        return self.variables.get('ROS_DOMAIN_ID') or '0'

    @property
    def reach(self) -> str:
        """The discovery range."""
        if self.variables.get('ROS_LOCALHOST_ONLY') == '1':
            return 'LOCALHOST'
        given = self.variables.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '')
        return given if given in RANGES else 'SUBNET'


def environment() -> Environment:
    """Return the environment of this process."""
    versions = {'diffdrive_jacobian': __version__}
    # A ROS installation has a distribution rclpy, the wheels have both.
    for name in (*PYTHON_PACKAGES, 'rclpy', 'ros-rclpy'):
        with suppress(metadata.PackageNotFoundError):
            versions[name.removeprefix('ros-')] = metadata.version(name)
    sources = {name: source for name in ROS_PACKAGES if (source := _source(name))}
    return Environment(
        python=platform.python_version(),
        versions=versions,
        sources=sources,
        variables={name: os.environ[name] for name in VARIABLES if name in os.environ},
        loopback=_loopback_is_up(),
        rmw_missing=_rmw_missing(wheels=sources.get('rclpy') == WHEELS),
    )


def _loopback_is_up() -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unused:
        try:
            # Connecting a UDP socket sends nothing. It fails if there is no route.
            unused.connect(('127.0.0.1', 1))
        except OSError:
            return False
    return True


def _rmw_missing(*, wheels: bool) -> bool:
    """Return whether the middleware that the environment names is not installed.

    rclpy must not be imported then: rcl ends the process.
    """
    name = os.environ.get('RMW_IMPLEMENTATION')
    if not name or (wheels and name == WHEEL_RMW):
        return False
    folders = os.environ.get('LD_LIBRARY_PATH', '').split(os.pathsep)
    return wheels or not any(Path(folder, f'lib{name}.so').exists() for folder in folders if folder)


def _source(package: str) -> str:
    """Return where a package of ROS comes from, or '' if it is not installed."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return ''
    try:
        wheel = metadata.distribution(f'ros-{package.replace("_", "-")}')
    except metadata.PackageNotFoundError:
        return INSTALLATION
    within = Path(spec.origin).is_relative_to(Path(str(wheel.locate_file(''))).resolve())
    return WHEELS if within or Path(spec.origin).resolve() == _file(wheel, package) else INSTALLATION


def _file(wheel: metadata.Distribution, package: str) -> Path:
    return Path(str(wheel.locate_file(f'{package}/__init__.py'))).resolve()


def check_environment(found: Environment) -> Iterator[Problem]:
    """Yield what is wrong with the environment."""
    yield from _check_versions(found)
    yield from _check_domain(found)
    yield from _check_discovery(found)
    for name in PROFILES:
        path = found.variables.get(name)
        if path and not Path(path).is_file():
            yield Problem(
                f'{name} names a file that does not exist: {printable(path)}',
                f'unset {name}, or correct it',
            )


def _check_versions(found: Environment) -> Iterator[Problem]:
    install = "pip install '.[jazzy]' in a clone of diffdrive_jacobian"
    missing = [name for name in ROS_PACKAGES if name not in found.sources]
    if missing:
        yield Problem(
            f'there is no {", ".join(missing)}',
            how_to_get_ros(),
        )
    by_source = {
        source: sorted(n for n, s in found.sources.items() if s == source)
        for source in set(found.sources.values())
    }
    if len(by_source) > 1:
        yield Problem(
            f'two installations of ROS are mixed: {", ".join(by_source[WHEELS])} from {WHEELS}, '
            f'{", ".join(by_source[INSTALLATION])} from a {INSTALLATION}',
            'use a virtual environment without the wheels beside a sourced ROS installation, or a shell '
            'that has not sourced one',
        )
    version = found.versions.get('rclpy', WHEEL_VERSION)
    if found.sources.get('rclpy') == WHEELS and not version.startswith(WHEEL_VERSION):
        yield Problem(
            f'rclpy {version} is not that of ROS 2 Jazzy ({WHEEL_VERSION}x)', f'call {install}'
        )
    if found.rmw_missing:
        yield Problem(
            f'RMW_IMPLEMENTATION is {printable(found.variables["RMW_IMPLEMENTATION"])}, which is not '
            'installed: no node can start',
            f'unset RMW_IMPLEMENTATION, or install it (the wheels have {WHEEL_RMW} only)',
        )
    distribution = found.variables.get('ROS_DISTRO', DISTRIBUTION)
    if distribution != DISTRIBUTION:
        yield Problem(
            f'ROS_DISTRO is {printable(distribution)}, this package is made for {DISTRIBUTION}',
            f'. /opt/ros/{DISTRIBUTION}/setup.bash in a new shell',
            problem=False,
        )


def _check_domain(found: Environment) -> Iterator[Problem]:
    domain = found.domain
    if not (domain.isascii() and domain.isdecimal() and int(domain) <= MAX_DOMAIN):
        yield Problem(
            f'ROS_DOMAIN_ID must be in 0 to {MAX_DOMAIN}, got {printable(domain)!r}',
            'export ROS_DOMAIN_ID=0, the same everywhere',
        )
    elif int(domain) > SAFE_DOMAIN:
        yield Problem(
            f'the ports of ROS_DOMAIN_ID {domain} can be taken by other programs',
            f'choose one in 0 to {SAFE_DOMAIN}',
            problem=False,
        )


def _check_discovery(found: Environment) -> Iterator[Problem]:
    given = found.variables.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '')
    if given and given not in RANGES:
        yield Problem(
            f'ROS_AUTOMATIC_DISCOVERY_RANGE must be one of {", ".join(RANGES)}, '
            f'got {printable(given)!r}: SUBNET is used',
            'export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST',
        )
    local = found.variables.get('ROS_LOCALHOST_ONLY', '')
    if local not in ('', '0', '1'):
        yield Problem(
            f'ROS_LOCALHOST_ONLY must be 0 or 1, got {printable(local)!r}: it has no effect',
            'unset ROS_LOCALHOST_ONLY; export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST',
        )
    if local == '1':
        yield Problem(
            'ROS_LOCALHOST_ONLY is set, which is deprecated and overrides ROS_AUTOMATIC_DISCOVERY_RANGE',
            'unset ROS_LOCALHOST_ONLY; export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST',
            problem=False,
        )
    elif given == 'OFF':
        yield Problem(
            'ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: no other process is found',
            'export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or SUBNET for other machines',
        )
    if not found.loopback:
        yield Problem(
            'the loopback interface is down: processes on this machine do not find each other',
            'ip link set lo up',
        )
    if found.variables.get('ROS_DISCOVERY_SERVER'):
        yield Problem(
            f'ROS_DISCOVERY_SERVER is {printable(found.variables["ROS_DISCOVERY_SERVER"])}: a client '
            'lists only topics that it uses itself',
            'export ROS_SUPER_CLIENT=TRUE for this tool, or use a Super Client profile',
            problem=False,
        )


SHARED_MEMORY = Path('/dev/shm')
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


def _stale_segments(folder: Path) -> Iterator[int]:
    """Yield the sizes of the segments of Fast DDS whose process has ended (bytes).

    Each segment has a file with `_el` at its end, which a living process keeps locked.
    """
    with suppress(OSError):
        for path in folder.glob('fastrtps_*_el'):
            with suppress(OSError), path.open('rb') as file:
                if lock(file, shared=True):
                    yield path.with_name(path.name.removesuffix('_el')).stat().st_size


def check_shared_memory(memory: SharedMemory | None) -> Iterator[Problem]:
    """Yield what is wrong with the shared memory."""
    if memory is None or not memory.writable:
        yield Problem(
            f'{SHARED_MEMORY} is missing or cannot be written: Fast DDS sends messages by the network',
            f'mount a tmpfs on {SHARED_MEMORY} (in a container: --ipc=host or --shm-size)',
            problem=False,
        )
        return
    stale = f'{memory.stale} segments of killed processes in {SHARED_MEMORY}'
    if memory.free < SCARCE:
        held = f', {format_size(memory.stale_bytes)} of it in {stale}' if memory.stale else ''
        yield Problem(
            f'{SHARED_MEMORY} is full: {format_size(memory.free)} of {format_size(memory.size)} are '
            f'free{held}',
            f'run `fastdds shm clean`, or enlarge {SHARED_MEMORY} (in a container: --shm-size=512m)',
        )
    elif memory.stale:
        yield Problem(
            f'{stale} take {format_size(memory.stale_bytes)}',
            'run `fastdds shm clean`, which removes them',
            problem=False,
        )
