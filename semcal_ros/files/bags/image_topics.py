"""Find the images of a recording, as they are or compressed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semcal_ros.config.config import COMPRESSED_IMAGE_TYPE, IMAGE_TYPE, ImageConfig
from semcal_ros.files.bags.reader import BagTopic
from semcal_ros.files.bags.topics import find_topic, topic_matches

__all__ = ["find_image_topic"]

# What image_transport appends to the name of a topic for its compressed images.
_SUFFIX = "/compressed"


def find_image_topic(
    path: Path, topics: Sequence[BagTopic], image: ImageConfig
) -> tuple[BagTopic, list[str]]:
    """The topic to read, and notes.

    A recorder often takes only one of ``image_raw`` and ``image_raw/compressed``, which show the same; where that is
    not the configured one, the other is read, with a note.

    Raises
    ------
    BagError
        As :func:`~semcal_ros.files.bags.topics.find_topic`.
    """
    wanted, type_name = _source(image, [topic for topic in topics if topic.count])
    found, note = find_topic(path, topics, what="image", wanted=wanted, type_name=type_name)
    notes = [note] if note else []
    if type_name != image.type:
        notes.append(f"the images on {found.name} are {type_name}, not {image.type}")
    return found, notes


def _source(image: ImageConfig, filled: Sequence[BagTopic]) -> tuple[str, str]:
    """Name and type to look for."""
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
