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

"""Whether the magnification lies in the range of the calibration, told once each time that it changes."""

from __future__ import annotations

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.reporter import Reporter

OUT_OF_RANGE = ParameterDeclaration(
    "out_of_range",
    "flag",
    "What is said of the camera at magnifications that the calibration does not cover, where images are rectified"
    " by its continuation. flag: camera_info and projection_stamped are zero, as without a calibration."
    " extrapolate: they are those of that continuation.",
    choices=("flag", "extrapolate"),
)


class RangeWatch:
    """Notes ``in_calibrated_range``, and logs when the range is left and entered again.

    Parameters
    ----------
    reporter
        Where to note and to log.
    """

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self.is_outside = False

    def check(
        self, calibration: Calibration | None, camera: ScanCamera | None, magnification: float
    ) -> None:
        """Take the camera in use at a magnification; both are None without a calibration."""
        outside = camera is not None and not camera.in_range
        self._reporter.note("in_calibrated_range", camera is not None and not outside)
        if outside == self.is_outside or calibration is None:
            return
        self.is_outside = outside
        low, high = calibration.magnification_range
        covered = f"the calibrated range {low:g}x to {high:g}x"
        if outside:
            self._reporter.warn(f"{magnification:g}x is outside of {covered}")
        else:
            self._reporter.info(f"{magnification:g}x is inside of {covered} again")
