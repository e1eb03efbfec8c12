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

"""Microscopes that OpenFIBSEM (package fibsem) talks to: Thermo Fisher, TESCAN, Odemis, and its DemoMicroscope."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from semcal_ros.core.errors import ConfigError, MicroscopeError
from semcal_ros.drivers.source import SourceFrame

# Class, and port of the server, as fibsem itself chooses them. Its own setup_session is not used: on connecting it sets
# the beam shift to zero, and nothing is to be changed at a microscope that is only looked at.
MANUFACTURERS: Mapping[str, tuple[str, str, int]] = {
    "Demo": ("fibsem.microscopes.simulator", "DemoMicroscope", 7520),
    "ThermoFisher": ("fibsem.microscope", "ThermoMicroscope", 7520),
    "Tescan": ("fibsem.microscopes.tescan", "TescanMicroscope", 8300),
    "Odemis": ("fibsem.microscopes.odemis_microscope", "OdemisThermoMicroscope", 0),
}
# Joints by fibsem's names; its limits of the angles are in degrees.
_AXES = {"x": "x", "y": "y", "z": "z", "rotation": "r", "tilt": "t"}
_WAITING = 2
# The state was read before the scan, as of the DemoMicroscope, if it is older than nearly all of the scan; else after.
_BEFORE = 0.9
# A stage has arrived where it says so to a micrometre and a hundredth of a degree.
_ARRIVED = {"m": 2e-6, "rad": 2e-4}
# Of a field width that was set: a microscope rounds it to the digits that it shows.
_SAME_WIDTH = 0.01


def require_fibsem() -> None:
    """Raise :class:`ConfigError` where fibsem is not installed, without importing all of it."""
    if importlib.util.find_spec("fibsem") is None:
        raise ConfigError(
            "no package fibsem for source openfibsem",
            expected="OpenFIBSEM from PyPI",
            do="pip install fibsem, or choose another source",
        )


class OpenFibsemSource:
    """Live frames of one beam, by the acquisition signal of fibsem.

    Parameters
    ----------
    manufacturer
        One of :data:`MANUFACTURERS`; empty: that of the configuration.
    ip_address
        Of the microscope's server; empty: that of the configuration.
    configuration
        File of fibsem; None for its default.
    beam
        ``electron`` or ``ion``.
    """

    streams = True
    lossless = False

    def __init__(
        self,
        manufacturer: str = "",
        ip_address: str = "",
        configuration: Path | None = None,
        beam: str = "electron",
    ) -> None:
        self._manufacturer = manufacturer
        self._ip_address = ip_address
        self._configuration = configuration
        self._beam_name = beam
        self._beam: Any = None
        self._microscope: Any = None
        self._signal: Any = None
        self._arrived = threading.Condition()
        self._images: deque[tuple[int, Any]] = deque(maxlen=_WAITING)

    # -- frames ------------------------------------------------------------------------------------

    def open(self) -> str:
        """Connect and begin to scan; see :meth:`FrameSource.open`."""
        self.close()
        from fibsem import utils
        from fibsem.structures import BeamType

        settings = utils.load_microscope_configuration(self._configuration)
        info = settings.system.info
        info.ip_address = self._ip_address or info.ip_address
        info.manufacturer = self._manufacturer or info.manufacturer
        if info.manufacturer not in MANUFACTURERS:
            raise MicroscopeError(
                f"a microscope of {info.manufacturer}",
                expected=f"one of {', '.join(MANUFACTURERS)}",
            )
        module, name, port = MANUFACTURERS[info.manufacturer]
        microscope = getattr(importlib.import_module(module), name)(settings.system)
        if port:
            microscope.connect_to_microscope(info.ip_address, port=port, reset_beam_shift=False)
        self._microscope = microscope
        electron = self._beam_name == "electron"
        self._beam = BeamType.ELECTRON if electron else BeamType.ION
        self._signal = (
            microscope.sem_acquisition_signal if electron else microscope.fib_acquisition_signal
        )
        self._signal.connect(self._on_image)
        microscope.start_acquisition(self._beam)
        about = microscope.system.info
        return f"{about.manufacturer} {about.model} {about.serial_number} at {about.ip_address}"

    def close(self) -> None:
        """Scan no longer, and disconnect."""
        microscope, self._microscope = self._microscope, None
        if microscope is None:
            return
        with contextlib.suppress(Exception):
            self._signal.disconnect(self._on_image)
        for end in (microscope.stop_acquisition, microscope.disconnect):
            with contextlib.suppress(Exception):
                end()
        with self._arrived:
            self._images.clear()

    def _on_image(self, image: Any) -> None:
        """Keep an image; runs in the thread of fibsem, which must not wait for anything."""
        with self._arrived:
            self._images.append((time.time_ns(), image))
            self._arrived.notify_all()

    def read(self, timeout_s: float) -> SourceFrame | None:
        """Return the next frame; see :meth:`FrameSource.read`."""
        with self._arrived:
            if not self._images:
                self._arrived.wait(timeout_s)
            found = self._images.popleft() if self._images else None
        if found is not None:
            return self._frame(*found)
        # The thread of fibsem logs what goes wrong, and ends.
        if not self._microscope.is_acquiring:
            raise MicroscopeError(
                "the microscope has stopped to scan",
                expected="a live acquisition",
                do="look at the microscope and its server",
            )
        return None

    def _frame(self, arrived_ns: int, image: Any) -> SourceFrame:
        about = image.metadata
        settings, state = about.image_settings, about.microscope_state
        height, width = image.data.shape[:2]
        dwell_s = _number(settings.dwell_time)
        # A scan of the whole field, of which a reduced area is only a part.
        pass_s = None if dwell_s is None else dwell_s * width * height
        if pass_s is not None:
            pass_s *= settings.line_integration or 1
        scan_s = None if pass_s is None else pass_s * (settings.frame_integration or 1)
        start_ns = arrived_ns - round((scan_s or 0.0) * 1e9)
        stated_ns = round(float(state.timestamp) * 1e9)
        if scan_s is not None and 0 < stated_ns < arrived_ns - _BEFORE * scan_s * 1e9:
            start_ns = stated_ns
        pixel_m = None if about.pixel_size is None else _number(about.pixel_size.x)
        data = np.asarray(image.data)
        return SourceFrame(
            np.ascontiguousarray(data if data.ndim == 2 else data[..., 0]),
            start_ns,
            scan_s,
            pixel_m * width if pixel_m else _number(settings.hfw),
            self._conditions(about, dwell_s, pass_s),
            self._joints(state.stage_position, self._beam_state(state).scan_rotation),
        )

    def _beam_state(self, state: Any) -> Any:
        return state.electron_beam if self._beam_name == "electron" else state.ion_beam

    def _conditions(
        self, about: Any, dwell_s: float | None, pass_s: float | None
    ) -> dict[str, float | str]:
        state, info = about.microscope_state, about.system_info
        beam = self._beam_state(state)
        electron = self._beam_name == "electron"
        detector = state.electron_detector if electron else state.ion_detector
        found = {
            "accelerating_voltage_v": _number(beam.voltage),
            "working_distance_m": _number(beam.working_distance),
            "beam_current_a": _number(beam.beam_current),
            "detector": "" if detector is None else str(detector.type or ""),
            "dwell_s": dwell_s,
            "frame_time_s": pass_s,
            "scan_rotation_rad": _number(beam.scan_rotation),
            "maker": "" if info is None else str(info.manufacturer or ""),
            "model": "" if info is None else str(info.model or ""),
            "serial": "" if info is None else str(info.serial_number or ""),
        }
        return {key: value for key, value in found.items() if value not in (None, "")}

    @staticmethod
    def _joints(position: Any, scan_rotation: Any = None) -> dict[str, float]:
        found = {} if position is None else {j: getattr(position, a) for j, a in _AXES.items()}
        found["scan_rotation"] = scan_rotation
        numbers = {joint: _number(value) for joint, value in found.items()}
        return {joint: value for joint, value in numbers.items() if value is not None}

    # -- moving ------------------------------------------------------------------------------------

    def _connected(self) -> Any:
        if self._microscope is None:
            raise MicroscopeError("no connection", expected="a microscope that answers")
        return self._microscope

    def set_field_width(self, width_m: float) -> None:
        """Set the field width; see :meth:`SetsFieldWidth.set_field_width`."""
        got_m = _number(self._connected().set_field_of_view(width_m, self._beam))
        if got_m is None or not math.isclose(got_m, width_m, rel_tol=_SAME_WIDTH):
            raise MicroscopeError(
                f"a field width of {got_m} m after {width_m:.6g} m was set",
                expected="a field width that the microscope has",
            )

    def stage_position(self) -> Mapping[str, float]:
        """Return where the stage is; see :meth:`MovesStage.stage_position`."""
        microscope = self._connected()
        rotation = microscope.get_scan_rotation(self._beam)
        return self._joints(microscope.get_stage_position(), rotation)

    def stage_limits(self) -> Mapping[str, tuple[float, float]]:
        """Return the limits that fibsem knows; see :meth:`MovesStage.stage_limits`."""
        known = self._connected()._get_axis_limits()
        found = {}
        for joint, axis in _AXES.items():
            if axis in known:
                low, high = float(known[axis].min), float(known[axis].max)
                is_angle = axis in ("r", "t")
                found[joint] = (math.radians(low), math.radians(high)) if is_angle else (low, high)
        return found

    def move_stage(self, target: Mapping[str, float]) -> None:
        """Move, and look whether it has arrived; see :meth:`MovesStage.move_stage`."""
        from fibsem.structures import FibsemStagePosition

        microscope = self._connected()
        axes = {_AXES[joint]: value for joint, value in target.items() if joint in _AXES}
        if axes:
            microscope.move_stage_absolute(FibsemStagePosition(**axes, coordinate_system="RAW"))
        if "scan_rotation" in target:
            microscope.set_scan_rotation(target["scan_rotation"], self._beam)
        now = self.stage_position()
        for joint, wanted in target.items():
            unit = "m" if joint in ("x", "y", "z") else "rad"
            off = abs(now.get(joint, math.inf) - wanted)
            if unit == "rad" and math.isfinite(off):
                off = abs(math.remainder(off, 2.0 * math.pi))
            if off > _ARRIVED[unit]:
                raise MicroscopeError(
                    f"{joint} at {now.get(joint, math.nan):.6g} {unit} after a move to {wanted:.6g}",
                    expected="a stage that arrives",
                    do="look at the microscope",
                )


def _number(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None
