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

"""Executable ``rectifier``: publishes the stream without distortion, in square pixels, with each frame's camera."""

from __future__ import annotations

from collections.abc import Sequence

from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.frames.calibrated_stream import CalibratedStreamNode
from semcal_ros.nodes.frames.stream import StreamFrame

_INPUT = ParameterDeclaration(
    "input",
    "raw",
    "Which images to rectify: those of the microscope, or image_stabilized of drift_compensator.",
    choices=("raw", "stabilized"),
    fixed=True,
)


class RectifierNode(CalibratedStreamNode):
    """Publishes ``image_rect``, ``camera_info`` and ``projection_stamped``."""

    def __init__(self) -> None:
        super().__init__("rectifier", (_INPUT,))
        stabilized = self.parameters["input"] == "stabilized"
        self.receive_frames(
            self._on_frame,
            topic="image_stabilized" if stabilized else None,
            # The stabilised image no longer has a data bar.
            databar_rows=0 if stabilized else None,
        )

    def _on_frame(self, frame: StreamFrame) -> None:
        camera = None
        if self.calibration.current is not None:
            g = self.known_magnification(frame)
            if g is None:
                return
            camera = self.camera(frame, g)
        self.output.render(frame, camera)
        self.publish(camera, frame)


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(RectifierNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
