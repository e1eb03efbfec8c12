"""Shapes of the ROS messages that the bridge reads and fills.

The bridge looks at attribute names only, so the same code serves messages of rclpy and dataclasses
of ``rosbags``. Array fields are ``Any``: they are ``array.array`` or ``numpy.ndarray`` according to
who made the message.
"""

from __future__ import annotations

from typing import Any, Protocol

__all__ = [
    "CameraInfoMessage",
    "DiagnosticStatusMessage",
    "HeaderMessage",
    "ImageMessage",
    "MultiArrayMessage",
    "PoseWithCovarianceStampedMessage",
    "StampMessage",
    "StringMessage",
    "TwistWithCovarianceStampedMessage",
]


class StampMessage(Protocol):
    """builtin_interfaces/msg/Time."""

    sec: int
    nanosec: int


class HeaderMessage(Protocol):
    """std_msgs/msg/Header."""

    stamp: Any
    frame_id: str


class ImageMessage(Protocol):
    """sensor_msgs/msg/Image."""

    header: Any
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Any


class CameraInfoMessage(Protocol):
    """sensor_msgs/msg/CameraInfo."""

    header: Any
    height: int
    width: int
    distortion_model: str
    d: Any
    k: Any
    r: Any
    p: Any


class MultiArrayMessage(Protocol):
    """std_msgs/msg/Float64MultiArray."""

    layout: Any
    data: Any


class PoseWithCovarianceStampedMessage(Protocol):
    """geometry_msgs/msg/PoseWithCovarianceStamped."""

    header: Any
    pose: Any


class TwistWithCovarianceStampedMessage(Protocol):
    """geometry_msgs/msg/TwistWithCovarianceStamped."""

    header: Any
    twist: Any


class StringMessage(Protocol):
    """std_msgs/msg/String."""

    data: str


class DiagnosticStatusMessage(Protocol):
    """diagnostic_msgs/msg/DiagnosticStatus."""

    level: Any
    name: str
    message: str
    hardware_id: str
    values: Any
