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

"""What metadata.yaml says, or its copy in a data file, as far as it can be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffdrive_jacobian.bags.files import NotARegularFileError, check_regular
from diffdrive_jacobian.bags.journal import Text
from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml


@dataclass(frozen=True, slots=True)
class Metadata:
    """The content of metadata.yaml. Any value may be missing, or of a wrong type."""

    content: dict[str, Any] = field(default_factory=dict)
    problem: str = ''
    """Why it was not read at all."""

    @classmethod
    def read(cls, source: Path | str) -> Metadata:
        """Read a file, or its text. Without content: it is missing or damaged."""
        try:
            if isinstance(source, Path):
                check_regular(source)
            found = load_yaml(source, aliases=True)
        except NotARegularFileError as error:
            return cls(problem=str(error))
        except (FileNotFoundError, *YAML_ERRORS):
            return cls()
        found = found.get('rosbag2_bagfile_information', found) if isinstance(found, dict) else {}
        return cls(found if isinstance(found, dict) else {})

    @property
    def message_count(self) -> int | None:
        """Number of messages."""
        count = self.content.get('message_count')
        return count if isinstance(count, int) else None

    @property
    def files(self) -> set[str]:
        """Names of the data files."""
        paths = self.content.get('relative_file_paths')
        return {Path(str(name)).name for name in paths} if isinstance(paths, list) else set()

    @property
    def topic_counts(self) -> Counter[str]:
        """Number of messages of each topic."""
        counts: Counter[str] = Counter()
        for topic, number in self._topics():
            if isinstance(number, int):
                counts[str(topic.get('name'))] += number
        return counts

    @property
    def type_hashes(self) -> dict[tuple[str, str], str]:
        """Hashes of types, by name and type of the topic."""
        hashes = ((one, one.get('type_description_hash')) for one, _ in self._topics())
        return {(str(one.get('name')), str(one.get('type'))): str(text) for one, text in hashes if text}

    @property
    def custom_data(self) -> list[Text]:
        """The custom data, in which damaged text is replaced that no file can hold."""
        custom = self.content.get('custom_data')
        pairs = custom.items() if isinstance(custom, dict) else ()
        return [Text(*(str(one).encode('utf-8', 'replace').decode() for one in pair)) for pair in pairs]

    def _topics(self) -> Iterator[tuple[dict[str, Any], Any]]:
        """Yield the description of each topic, and its number of messages."""
        topics = self.content.get('topics_with_message_count')
        for topic in topics if isinstance(topics, list) else ():
            described = topic.get('topic_metadata') if isinstance(topic, dict) else None
            if isinstance(described, dict):
                yield described, topic.get('message_count')
