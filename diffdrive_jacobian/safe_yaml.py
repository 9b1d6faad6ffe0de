"""YAML, of which nothing is executed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

YAML_ERRORS = (YAMLError, ValueError, RecursionError, OverflowError)
"""What `load_yaml` raises on a text that is not valid YAML."""


def load_yaml(source: Path | str) -> Any:
    """Load YAML from a file (a path) or a text.

    Returns:
        Dictionaries, lists, strings, numbers, dates and None.

    Raises:
        YAMLError, ValueError, RecursionError, OverflowError: It is not valid YAML.
        OSError: The file cannot be read.
    """
    text = source.read_text(encoding='utf-8') if isinstance(source, Path) else source
    return YAML(typ='safe').load(text)
