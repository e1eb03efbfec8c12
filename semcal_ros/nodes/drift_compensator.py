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

"""Executable ``drift_compensator``: publishes the stream without drift, and the drift; it needs no calibration."""

from __future__ import annotations

from collections.abc import Sequence

from semcal_ros.nodes.common.parameters import INTERPOLATION
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.frames.compressed import compressed_parameters
from semcal_ros.nodes.frames.live_drift import DRIFT_PARAMETERS, DriftCorrection
from semcal_ros.nodes.frames.outputs import ImageOutput
from semcal_ros.nodes.frames.stream import StreamFrame, StreamNode, nominal_camera


class DriftCompensator(StreamNode):
    """Publishes ``image_stabilized``, ``drift``, ``drift_velocity`` and ``~/moving``.

    The scale in metres comes from the configured display width; the distortion stays in the images.
    """

    def __init__(self) -> None:
        super().__init__(
            "drift_compensator",
            (INTERPOLATION, *DRIFT_PARAMETERS, *compressed_parameters("image_stabilized")),
        )
        # Closed in the reverse order, so that the last compressed image is published.
        self._images = ImageOutput(self.node_context, "image_stabilized")
        self.closing.callback(self._images.close)
        self._correction = DriftCorrection(self.node_context, self.closing)
        self.receive_frames(self._on_frame)

    def _on_frame(self, frame: StreamFrame) -> None:
        g = self.known_magnification(frame)
        if g is None:
            return
        self._correction.correct(
            frame,
            nominal_camera(g, *frame.size, self.config.display_width_m),
            self._images,
            lambda _drift: self._images.publish(frame),
        )

    def conditions(self) -> list[str]:
        """Extend the base class: also report whether the drift is only predicted."""
        return super().conditions() + self._correction.conditions()


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(DriftCompensator, args)


if __name__ == "__main__":
    raise SystemExit(main())
