"""Drift tracking as the nodes use it: times from stamps, reset by service and by a new calibration."""

from __future__ import annotations

from typing import Any

from std_srvs.srv import Trigger

from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.drift import DriftSettings, DriftTracker, DriftUpdate
from semcal_ros.nodes.settings import Setting
from semcal_ros.nodes.stream import Frame, StreamNode

__all__ = ["DRIFT_SETTINGS", "LiveDrift"]

DRIFT_SETTINGS = (
    Setting(
        "keyframe_overlap",
        0.6,
        "A new keyframe is taken when less than this fraction of the picture overlaps with the last one."
        " A change starts the tracking anew.",
        low=0.1,
        high=0.95,
    ),
    Setting(
        "max_jump",
        0.25,
        "A shift between frames beyond this fraction of the field counts as a move of the stage."
        " A change starts the tracking anew.",
        low=0.01,
        high=1.0,
    ),
)


class LiveDrift:
    """The tracker of one node, with the service ``~/reset``."""

    def __init__(self, node: StreamNode) -> None:
        self._node = node
        self._origin_ns: int | None = None
        self._tracker = self._new_tracker()
        for setting in DRIFT_SETTINGS:
            node.settings.on_change(setting.name, self._on_setting)
        self._service = node.create_service(Trigger, "~/reset", self._on_reset)

    def _new_tracker(self) -> DriftTracker:
        values = self._node.settings
        return DriftTracker(
            DriftSettings(rekey_overlap=values["keyframe_overlap"], max_jump=values["max_jump"])
        )

    def _on_setting(self, _value: float) -> None:
        self._tracker = self._new_tracker()

    def _on_reset(self, _request: Any, response: Any) -> Any:
        self.reset()
        response.success, response.message = True, "the next frame has zero drift"
        return response

    def reset(self) -> None:
        """The next frame has zero drift."""
        self._tracker.reset()

    def update(self, frame: Frame, camera: ScanCamera) -> DriftUpdate:
        """Drift at a frame, in m; raises as :meth:`DriftTracker.update`."""
        config = self._node.config
        if self._origin_ns is None or frame.stamp_ns < self._origin_ns:
            # Seconds since 1970 in a float are only good to 0.2 us.
            self._origin_ns = frame.stamp_ns
            self._tracker.reset()
        time_s = (frame.stamp_ns - self._origin_ns) * 1e-9 + config.start_offset_s
        return self._tracker.update(frame.image, time_s, camera, config.scan)
