"""ROS messages to and from values of :mod:`semcal_ros.core`, and the ``msg_configs`` files that say
where they are.

Nothing here imports ROS: functions look at attribute names only and serve messages of rclpy and of
rosbags alike.
"""

from __future__ import annotations

from semcal_ros.bridge.calibration_text import (
    calibration_text_from_message,
    fill_calibration_text,
)
from semcal_ros.bridge.camera_info import fill_camera_info
from semcal_ros.bridge.config import (
    ImageConfig,
    MagnificationConfig,
    MicroscopeConfig,
    config_names,
    load_config,
    parse_config,
)
from semcal_ros.bridge.diagnostics import (
    DiagnosticLevel,
    DiagnosticSummary,
    StreamStatistics,
    fill_diagnostic_status,
)
from semcal_ros.bridge.drift import fill_drift, fill_drift_velocity
from semcal_ros.bridge.headers import (
    copy_header,
    fill_header,
    fill_stamp,
    optional_stamp_ns,
    stamp_ns_from_msg,
)
from semcal_ros.bridge.history import ZeroOrderHold
from semcal_ros.bridge.images import (
    ENCODINGS,
    fill_image,
    image_from_message,
    pixel_memory,
    to_gray,
    without_databar,
)
from semcal_ros.bridge.magnification import (
    MagnificationReading,
    check_magnification,
    magnification_from_message,
    read_magnification,
)
from semcal_ros.bridge.pace import TrackingPace
from semcal_ros.bridge.parameters import (
    PARAMETER_KINDS,
    ParameterRequest,
    is_continuous_parameter,
    parse_parameter_name,
    read_parameter,
    value_of,
)
from semcal_ros.bridge.projection import fill_projection, projection_from_message
from semcal_ros.bridge.scan_interval import scan_interval_ns

__all__ = [
    "ENCODINGS",
    "PARAMETER_KINDS",
    "DiagnosticLevel",
    "DiagnosticSummary",
    "ImageConfig",
    "MagnificationConfig",
    "MagnificationReading",
    "MicroscopeConfig",
    "ParameterRequest",
    "StreamStatistics",
    "TrackingPace",
    "ZeroOrderHold",
    "calibration_text_from_message",
    "check_magnification",
    "config_names",
    "copy_header",
    "fill_calibration_text",
    "fill_camera_info",
    "fill_diagnostic_status",
    "fill_drift",
    "fill_drift_velocity",
    "fill_header",
    "fill_image",
    "fill_projection",
    "fill_stamp",
    "image_from_message",
    "is_continuous_parameter",
    "load_config",
    "magnification_from_message",
    "optional_stamp_ns",
    "parse_config",
    "parse_parameter_name",
    "pixel_memory",
    "projection_from_message",
    "read_magnification",
    "read_parameter",
    "scan_interval_ns",
    "stamp_ns_from_msg",
    "to_gray",
    "value_of",
    "without_databar",
]
