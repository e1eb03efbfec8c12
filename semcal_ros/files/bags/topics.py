# Copyright 2026 semcal_ros maintainers
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

"""Find the topic that a configuration means among those of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semcal_ros.config import COMPRESSED_IMAGE_TYPE, IMAGE_TYPE, ImageConfig
from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.reader import BagTopic

_MAX_LISTED = 8  # topics in one line of an error


def topic_matches(wanted: str, recorded: str) -> bool:
    """Return whether a recorded topic is the wanted one: relative names match by their last parts."""
    if wanted.startswith("/"):
        return recorded == wanted
    return recorded == wanted or recorded.endswith("/" + wanted)


def _list_topics(topics: Sequence[BagTopic]) -> str:
    shown = [f"{t.name} ({t.type}, {t.count})" for t in topics[:_MAX_LISTED]]
    more = len(topics) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "") if shown else "no topics"


def find_topic(
    path: Path, topics: Sequence[BagTopic], *, what: str, wanted: str, type_name: str
) -> tuple[BagTopic, str]:
    """Find the topic to read; also return a note, empty if the topic has the configured name.

    Parameters
    ----------
    topics
        All topics of the recording.
    what
        What the topic carries, for messages to the user.
    wanted, type_name
        Name and message type from the configuration.

    Raises
    ------
    BagError
        No topic fits, several do, or the topic has another type.
    """
    named = [t for t in topics if topic_matches(wanted, t.name)]
    fitting = [t for t in named if t.type == type_name]
    if len(fitting) == 1:
        return fitting[0], ""
    if named and not fitting:
        raise BagError(
            f"topic {named[0].name} in {path} has type {named[0].type}",
            expected=f"{type_name} for the {what}",
            do="set topic and type in the msg_configs file and name it with --config",
        )
    candidates = fitting or [t for t in topics if t.type == type_name and t.count > 0]
    if len(candidates) == 1:
        return candidates[
            0
        ], f"the {what} is read from {candidates[0].name}: there is no topic {wanted}"
    seen = _list_topics(candidates) if candidates else _list_topics(topics)
    problem = "several topics could be" if candidates else "no topic is"
    raise BagError(
        f"in {path} {problem} the {what}; the topics are {seen}",
        expected=f"one topic {wanted} of type {type_name}",
        do="name the topic in a msg_configs file and pass it with --config",
    )


# Images that are matrices, and no pictures (doc/nodes.md).
_MATRICES = ("projection_stamped", "projection_covariance_stamped")
# What image_transport appends to the name of a topic for its compressed images.
_SUFFIX = "/compressed"


def find_image_topic(
    path: Path, topics: Sequence[BagTopic], image: ImageConfig
) -> tuple[BagTopic, list[str]]:
    """Find the topic of images to read; also return notes. ``projection_stamped`` is not one unless it is configured.

    A recorder often takes only one of ``image_raw`` and ``image_raw/compressed``, which show the same; if that is not
    the configured one, the other is read, with a note.

    Raises
    ------
    BagError
        As :func:`~semcal_ros.files.bags.topics.find_topic`.
    """
    for matrix in _MATRICES:
        if not topic_matches(matrix, image.topic):
            topics = [topic for topic in topics if not topic_matches(matrix, topic.name)]
    wanted, type_name = _source(image, [topic for topic in topics if topic.count])
    found, note = find_topic(path, topics, what="image", wanted=wanted, type_name=type_name)
    notes = [note] if note else []
    if type_name != image.type:
        notes.append(f"the images on {found.name} are {type_name}, not {image.type}")
    return found, notes


def _source(image: ImageConfig, filled: Sequence[BagTopic]) -> tuple[str, str]:
    """Return the name and type to search for."""
    other_name, other_type = f"{image.topic}{_SUFFIX}", COMPRESSED_IMAGE_TYPE
    if image.type == COMPRESSED_IMAGE_TYPE:
        other_name, other_type = image.topic.removesuffix(_SUFFIX), IMAGE_TYPE
    for source in (
        (image.topic, image.type),
        (other_name, other_type),
        (image.topic, other_type),
    ):
        if any((t.type, topic_matches(source[0], t.name)) == (source[1], True) for t in filled):
            return source
    types = {topic.type for topic in filled}
    only_other = other_type in types and image.type not in types
    return image.topic, other_type if only_other else image.type
