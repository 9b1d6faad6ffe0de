"""Faster acknowledgements of what is published reliably with Fast DDS.

A reliable writer of Fast DDS sends its readers a heartbeat every 3 s. A reader that has received all
messages acknowledges them only in reply to a heartbeat. `Publisher.wait_for_all_acked` therefore takes
up to 3 s after the messages were received.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import NamedTemporaryFile

VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""Environment variable that names the XML profiles which Fast DDS reads for the first participant."""
PROFILE_VARIABLES = (VARIABLE, 'FASTDDS_DEFAULT_PROFILES_FILE')
PROFILE = """<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <publisher profile_name="heartbeats" is_default_profile="true"><times>
    <heartbeatPeriod><sec>0</sec><nanosec>100000000</nanosec></heartbeatPeriod>
  </times></publisher>
</profiles>
"""


@contextmanager
def fast_heartbeats() -> Iterator[None]:
    """Set the heartbeat period of publishers to 0.1 s.

    This affects only a process that has not created a participant yet, and only rmw_fastrtps. It does
    nothing if the environment names a file of profiles already.

    Raises:
        OSError: A temporary file cannot be written.
    """
    if any(os.environ.get(name) for name in PROFILE_VARIABLES):
        yield
        return
    with NamedTemporaryFile('w', suffix='.xml', encoding='utf-8') as file:
        file.write(PROFILE)
        file.flush()
        os.environ[VARIABLE] = file.name
        try:
            yield
        finally:
            del os.environ[VARIABLE]
