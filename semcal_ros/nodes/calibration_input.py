"""The calibration in force: from a file or from the topic, whichever came last."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from std_msgs.msg import String

from semcal_ros.bridge import MicroscopeConfig, calibration_text_from_message
from semcal_ros.calibration import Calibration
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.errors import SemcalError
from semcal_ros.nodes.base import SemNode
from semcal_ros.nodes.qos import latched
from semcal_ros.nodes.subscription import MessageInfo, published_ns

__all__ = ["CalibrationInput"]


class CalibrationInput:
    """Holds the last good calibration; a bad one is refused, counted, and leaves the old one in force.

    Parameters
    ----------
    node
        A node that declares the parameter ``calibration``.
    on_change
        Called after each change.

    Raises
    ------
    CalibrationFileError
        The file given at start cannot be used.
    """

    def __init__(self, node: SemNode, *, on_change: Callable[[], None] | None = None) -> None:
        self._node = node
        self._on_change = on_change
        self._checked: tuple[str, Calibration] | None = None
        self.current: Calibration | None = None
        self.source = "none"
        self._config = node.config
        self._topic_ns = 0
        path = node.settings["calibration"]
        if path:
            self._install(Calibration.load(path), path)
        node.settings.on_change("calibration", self._apply_file, self._check_file)
        node.listen(String, "calibration", self._on_message, latched())

    @property
    def config(self) -> MicroscopeConfig:
        """The node's configuration with the display width of the calibration in force."""
        return self._config

    def camera(self, magnification: float, width: int, height: int) -> ScanCamera | None:
        """Camera for frames of that size, or None while there is no calibration; raises as ``Calibration.at``."""
        if self.current is None:
            return None
        return self.current.at(magnification).resized(width, height)

    def load(self, path: str) -> None:
        """Take the calibration from a file; raises :class:`CalibrationFileError` and keeps the old one if it is bad."""
        self._install(Calibration.load(path), path)

    def _check_file(self, path: str) -> None:
        self._checked = (path, Calibration.load(path)) if path else None

    def _apply_file(self, path: str) -> None:
        if self._checked is not None and self._checked[0] == path:
            self._install(self._checked[1], path)
        self._checked = None

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        # Two latched publishers may answer a late joiner in any order; the later calibration counts.
        if published_ns(info) < self._topic_ns:
            return
        try:
            text = calibration_text_from_message(message)
            calibration = Calibration.loads(text, source="topic calibration")
            self._topic_ns = published_ns(info)
            # The same again, from another node or as an echo, is no reason to start drift anew.
            if self.current is None or calibration.dumps() != self.current.dumps():
                self._install(calibration, "topic")
        except SemcalError as error:
            self._node.reject(error)

    def _install(self, calibration: Calibration, source: str) -> None:
        self.current, self.source = calibration, source
        self._config = replace(self._node.config, display_width_m=calibration.display_width_m)
        low, high = calibration.magnification_range
        self._node.get_logger().info(
            f"calibration from {source}: {calibration.method}, {low:g}x to {high:g}x"
        )
        self._node.statistics.note("calibration", source)
        if self._on_change is not None:
            self._on_change()
