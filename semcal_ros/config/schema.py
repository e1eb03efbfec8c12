"""What a ``msg_configs`` file may contain.

The ``description`` of each key is what an error message names as expected.
"""

from __future__ import annotations

from typing import Any

__all__ = ["COMPRESSED_IMAGE_TYPE", "CONFIG_SCHEMA", "IMAGE_TYPE", "IMAGE_TYPES"]

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE_TYPE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE_TYPE, COMPRESSED_IMAGE_TYPE)
"""Message types in which frames are accepted."""

_TYPE_PATTERN = r"^[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*\Z"
_TOPIC_PATTERN = r"^(~/|/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*\Z"
_FIELD_PATTERN = r"^[A-Za-z_][A-Za-z0-9_]*(\[[0-9]+\])?(\.[A-Za-z_][A-Za-z0-9_]*(\[[0-9]+\])?)*\Z"
_FRAME_PATTERN = r"^[A-Za-z_][A-Za-z0-9_/-]*\Z"


def _positive(what: str, maximum: float) -> dict[str, Any]:
    # The upper limits only catch a wrong unit: nothing real comes near them.
    return {"type": "number", "exclusiveMinimum": 0, "maximum": maximum, "description": what}


_MAX_NAME = 255
_TOPIC = {
    "type": "string",
    "maxLength": _MAX_NAME,
    "pattern": _TOPIC_PATTERN,
    "description": "a ROS topic name such as image_raw",
}
_IMAGE: dict[str, Any] = {
    "type": "object",
    "description": "a mapping of image settings",
    "additionalProperties": False,
    "properties": {
        "topic": _TOPIC,
        "type": {
            "enum": list(IMAGE_TYPES),
            "description": " or ".join(IMAGE_TYPES),
        },
        "stamp": {
            "enum": ["start", "centre", "end"],
            "description": "start, centre or end, the moment of the acquisition that is stamped",
        },
        "databar_rows": {
            "type": "integer",
            "minimum": 0,
            "maximum": 100000,
            "description": "the number of rows of the data bar, 0 or more",
        },
    },
}
_MAGNIFICATION: dict[str, Any] = {
    "type": "object",
    "description": "a mapping of magnification settings",
    "additionalProperties": False,
    "required": ["quantity"],
    "properties": {
        "topic": _TOPIC,
        "type": {
            "type": "string",
            "maxLength": _MAX_NAME,
            "pattern": _TYPE_PATTERN,
            "description": "a message type such as std_msgs/msg/Float64",
        },
        "field": {
            "type": "string",
            "maxLength": _MAX_NAME,
            "pattern": _FIELD_PATTERN,
            "description": "a path of field names such as data, vector.x or position[0]",
        },
        "quantity": {
            "enum": ["magnification", "pixel_size", "field_width"],
            "description": "magnification, pixel_size or field_width",
        },
        "unit": {
            "enum": ["1", 1, "m", "mm", "um", "nm", "pm"],
            "description": "1 for a magnification; m, mm, um, nm or pm for a length",
        },
        "display_width_m": _positive("a positive display width in m", 100.0),
        "image_width_px": {
            "type": "integer",
            "minimum": 1,
            "maximum": 1000000,
            "description": "a positive number of pixels",
        },
    },
}
_SCAN: dict[str, Any] = {
    "type": "object",
    "description": "a mapping of scan settings",
    "additionalProperties": False,
    "required": ["frame_time_s"],
    "properties": {
        "frame_time_s": _positive("the positive time of one pass over the frame in s", 1e6),
        "averages": {
            "type": "integer",
            "minimum": 1,
            "maximum": 1000000,
            "description": "the number of averaged passes, 1 to 1000000",
        },
        "flyback_fraction": {
            "type": "number",
            "minimum": 0,
            "exclusiveMaximum": 1,
            "description": "a number in [0, 1)",
        },
    },
}

CONFIG_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "semcal_ros microscope configuration",
    "type": "object",
    "description": "a mapping of settings",
    "additionalProperties": False,
    "required": ["name", "display_width_m", "magnification"],
    "properties": {
        "name": {"type": "string", "minLength": 1, "maxLength": 100, "description": "a name"},
        "display_width_m": _positive("a positive display width in m, such as 0.12", 100.0),
        "frame_id": {
            "type": "string",
            "maxLength": _MAX_NAME,
            "pattern": _FRAME_PATTERN,
            "description": "a frame name such as sem_optical",
        },
        "image": _IMAGE,
        "magnification": _MAGNIFICATION,
        "scan": _SCAN,
        "squares_m": {
            "type": "array",
            "minItems": 1,
            "items": _positive("a positive square size in m", 1.0),
            "description": "a list of square sizes in m",
        },
    },
}
"""JSON Schema (draft 2020-12) of the file."""
