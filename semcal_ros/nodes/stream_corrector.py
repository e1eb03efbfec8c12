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

"""Executable ``stream_corrector``: drift and distortion removed in one interpolation."""

from __future__ import annotations

from collections.abc import Sequence

from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.frames.calibrated_stream import CalibratedStreamNode
from semcal_ros.nodes.frames.live_drift import DRIFT_PARAMETERS, DriftCorrection
from semcal_ros.nodes.frames.stream import StreamFrame, nominal_camera


class StreamCorrector(CalibratedStreamNode):
    """Publishes ``image_rect``, ``camera_info``, ``projection_stamped``, ``drift``, ``drift_velocity``, ``~/moving``.

    Without a calibration the drift is still removed, on the scale of the display width.
    """

    def __init__(self) -> None:
        super().__init__("stream_corrector", DRIFT_PARAMETERS)
        self.correction = DriftCorrection(self.node_context, self.closing)
        self.receive_frames(self._on_frame)

    def on_calibration(self) -> None:
        """Reset the drift: a keyframe in the coordinates of the old calibration is useless."""
        self.correction.tracking.reset()

    def _on_frame(self, frame: StreamFrame) -> None:
        g = self.known_magnification(frame)
        if g is None:
            return
        camera = self.camera(frame, g)
        width_m = self.calibration.config.display_width_m
        self.correction.correct(
            frame,
            camera or nominal_camera(g, *frame.size, width_m),
            self.output,
            lambda drift: self.publish(camera, frame, drift),
        )

    def conditions(self) -> list[str]:
        """Extend the base class: also report whether the drift is only predicted."""
        return super().conditions() + self.correction.conditions()


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(StreamCorrector, args)


if __name__ == "__main__":
    raise SystemExit(main())
