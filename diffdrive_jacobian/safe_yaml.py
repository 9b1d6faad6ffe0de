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

"""YAML, of which nothing is executed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

YAML_ERRORS = (YAMLError, ValueError, RecursionError, OverflowError)
"""What `load_yaml` raises on a text that is not valid YAML."""


def load_yaml(source: Path | str, *, aliases: bool = False) -> Any:
    """Load YAML from a file (a path) or a text.

    Args:
        source: The file or the text.
        aliases: Whether a value may be repeated by its name. ROS does not allow it in files of
            parameters, and a short file could become of any size.

    Returns:
        Dictionaries, lists, strings, numbers, dates and None.

    Raises:
        YAMLError, ValueError, RecursionError, OverflowError: It is not valid YAML.
        OSError: The file cannot be read.
    """
    text = source.read_text(encoding='utf-8') if isinstance(source, Path) else source
    if not aliases and re.search(r'(^|[\s,[{])\*\S', text):
        for event in YAML(typ='safe').parse(text):
            if isinstance(event, AliasEvent):
                line = event.start_mark.line + 1
                raise ValueError(f'aliases are not allowed, got *{event.anchor} in line {line}')
    return YAML(typ='safe').load(text)
