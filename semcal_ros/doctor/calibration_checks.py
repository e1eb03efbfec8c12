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

"""Checks of the calibration against the live images and their magnification."""

from __future__ import annotations

from semcal_ros.bridge.continuous_parameters import continuous_value
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import SemcalError
from semcal_ros.doctor.findings import Finding, note, ok, problem
from semcal_ros.doctor.observations import CalibrationSeen, Session

# One row in a thousand: the change of shape when a scaled size is rounded.
_ASPECT = 1e-3


def live_size(session: Session) -> tuple[int, int] | None:
    """Return the width and height of the live images without their data bar, px, or None."""
    image = session.image
    if image is None or image.height <= image.databar_rows:
        return None
    return image.width, image.height - image.databar_rows


def describe_calibration(
    source: str,
    calibration: Calibration,
    magnification: float | None,
    size: tuple[int, int] | None,
) -> CalibrationSeen:
    """Describe a calibration for live images of this size (width, height) and magnification."""
    low, high = calibration.magnification_range
    sigma, trouble = None, ""
    if magnification is not None:
        try:
            camera = calibration.at(magnification).resized(*(size or calibration.image_size))
            centre, *corners = continuous_value("sigma", camera)
            sigma = centre, max(corners)
        except SemcalError as error:
            trouble = str(error)
    return CalibrationSeen(
        source=source,
        trouble=trouble,
        width=calibration.image_width,
        height=calibration.image_height,
        display_width_m=calibration.display_width_m,
        low=low,
        high=high,
        sigma_px=sigma,
    )


def check_calibration(
    seen: CalibrationSeen | None,
    size: tuple[int, int] | None,
    magnification: float | None,
    config: MicroscopeConfig,
) -> list[Finding]:
    """Check whether the calibration in force is valid for the live images."""
    if seen is None:
        return [
            note(
                "calibration",
                "no calibration on its topic, and none given",
                do="calibrate (`semcal calibrate`), give the file to the nodes, or to this command: --calibration",
            )
        ]
    if seen.trouble:
        return [problem("calibration", f"{seen.source}: {seen.trouble}")]
    found = [*_range(seen, magnification), *_size(seen, size), *_display(seen, config)]
    if found:
        return found
    return [ok("calibration", f"{seen.source}: {_reach(seen)}{_error(seen)}")]


def _reach(seen: CalibrationSeen) -> str:
    return f"{seen.low:g}x to {seen.high:g}x, {seen.width} x {seen.height} px"


def _error(seen: CalibrationSeen) -> str:
    if seen.sigma_px is None:
        return ""
    centre, corner = seen.sigma_px
    return f", predicted 1-sigma error {centre:.2g} px at the centre, {corner:.2g} px in a corner"


def _range(seen: CalibrationSeen, magnification: float | None) -> list[Finding]:
    if magnification is None:
        return [
            note("calibration", f"{seen.source}: {_reach(seen)}; the magnification is not known")
        ]
    if not seen.low * (1 - 1e-9) <= magnification <= seen.high * (1 + 1e-9):
        return [
            problem(
                "calibration",
                f"{seen.source} is extrapolated to {magnification:g}x{_error(seen)}",
                expected=f"{seen.low:g}x to {seen.high:g}x, where it was calibrated",
                do="calibrate there too, check the unit and display width in the configuration, or zoom",
            )
        ]
    return []


def _size(seen: CalibrationSeen, size: tuple[int, int] | None) -> list[Finding]:
    if size is None or size == (seen.width, seen.height):
        return []
    width, height = size
    live = f"images of {width} x {height} px, {seen.source} is of {seen.width} x {seen.height} px"
    if abs(width * seen.height / (height * seen.width) - 1.0) > _ASPECT:
        return [
            problem(
                "calibration",
                f"{live}, of another shape",
                expected="the same field of view",
                do="a data bar at the bottom: set image.databar_rows in the configuration; a cropped or reduced scan:"
                " calibrate with it",
            )
        ]
    return [note("calibration", f"{live}: scaled, which holds if the field of view is the same")]


def _display(seen: CalibrationSeen, config: MicroscopeConfig) -> list[Finding]:
    source = config.magnification
    is_independent = source.quantity != "magnification" or source.display_width_m is not None
    if is_independent or abs(config.display_width_m / seen.display_width_m - 1.0) < 1e-6:
        return []
    return [
        note(
            "calibration",
            f"its display width is {seen.display_width_m:g} m, that of the configuration {config.display_width_m:g} m",
            expected="the same, or magnification.display_width_m in the configuration",
            do="say to which width the published magnification refers: it is read as that of the calibration",
        )
    ]
