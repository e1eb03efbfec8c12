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

"""What programs hold: a calibration with its file, its figure and its corrected images."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import fields
from html import escape
from typing import TYPE_CHECKING, cast, overload

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.wording import counted
from semcal_ros.files.calibration_file import (
    format_calibration,
    parse_calibration,
    read_calibration,
    write_calibration,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from semcal_ros.core.calibration.paper.pda import FittedEquation

__all__ = ["Calibration"]


class Calibration(CalibrationModel):
    """A calibration that is continuous in the magnification.

    Two calibrations are equal if their files would be, digit for digit.

    Examples
    --------
    ::

        cal = Calibration.load("jsm820.yaml")
        cam = cal.at(5250.0)
        pixels = cam.project(points_m)
        flat = cal.rectify(image, 5250.0)
        cal.plot().savefig("jsm820.png")
    """

    @classmethod
    def from_model(cls, model: CalibrationModel) -> Calibration:
        """The calibration of a model that was computed by the core."""
        return cls(**{field.name: getattr(model, field.name) for field in fields(model)})

    # -- the file ---------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Read a calibration file.

        Raises
        ------
        CalibrationFileError
            If the file is missing, unreadable, corrupt, of another kind, or of a newer version.
        """
        return cls.from_model(read_calibration(path))

    @classmethod
    def loads(cls, text: str, *, source: str = "calibration") -> Calibration:
        """Parse the text of a calibration file; ``source`` names it in errors.

        Raises
        ------
        CalibrationFileError
            As :meth:`load`.
        """
        return cls.from_model(parse_calibration(text, source=source))

    def dumps(self) -> str:
        """The text of the calibration file, with every number in full precision."""
        return format_calibration(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the calibration file completely or not at all.

        Raises
        ------
        CalibrationFileError
            If it cannot be written; an existing file is then untouched.
        """
        write_calibration(self, path)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was suspicious when it was made, the costliest first; empty where a file does not say."""
        # The statistics in a file are notes, which may have been edited.
        notes = self.statistics
        listed = notes.get("warnings") if isinstance(notes, Mapping) else None
        if not isinstance(listed, (list, tuple)):
            return ()
        return tuple(text for text in listed if isinstance(text, str))

    @property
    def equations(self) -> tuple[FittedEquation, ...]:
        """The differential equation of each parameter, of method ``"pda"``; empty for the others."""
        # Here, so that those who only ask for a camera do not wait for the calibration's modules.
        from semcal_ros.core.calibration.paper.pda import list_equations

        return list_equations(self.functions)

    # -- cameras and images ---------------------------------------------------------------------

    @overload
    def at(self, magnification: float) -> ScanCamera: ...

    @overload
    def at(self, magnification: Iterable[float]) -> tuple[ScanCamera, ...]: ...

    def at(self, magnification: float | Iterable[float]) -> ScanCamera | tuple[ScanCamera, ...]:
        """The camera at a magnification, or the cameras at several.

        Outside :attr:`magnification_range` the functions go on along their tangents in log g,
        ``in_range`` is False, and the covariance grows with the distance from the range.

        Parameters
        ----------
        magnification
            A number, or a one-dimensional array or any other iterable of numbers.

        Returns
        -------
        ScanCamera or tuple of ScanCamera
            One camera for a number; for an iterable one camera for each, in the same order.

        Raises
        ------
        InvalidValueError
            If a magnification is not finite and positive, or so far out of range that no camera
            results.
        """
        # An array without dimensions is a number that claims to be iterable.
        if isinstance(magnification, Iterable) and getattr(magnification, "ndim", 1) > 0:
            return tuple(super(Calibration, self).at(g) for g in magnification)
        return super().at(cast("float", magnification))

    def rectify(
        self, image: AnyImage, magnification: float, *, interpolation: str = "linear"
    ) -> AnyImage:
        """The image in square pixels without skew and distortion, as the camera
        ``at(magnification).rectified`` would have taken it.

        Drift is left in; :func:`semcal_ros.rectify` removes it from the frames of a recording.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) of uint8, uint16 or float32 that shows the whole field of the
            calibration, with as many pixels as it likes.
        magnification
            Of the image.
        interpolation
            ``"linear"``, ``"cubic"`` or ``"lanczos4"``.

        Returns
        -------
        Array of the image's shape and type; pixels that were not scanned are 0.

        Raises
        ------
        InvalidValueError
            If image, magnification or interpolation cannot be used.
        """
        # Here, so that those who only ask for a camera do not wait for OpenCV.
        from semcal_ros.core.rectification.rectifier import Rectifier

        return Rectifier(interpolation).rectify(image, self.at(float(magnification)))

    # -- what a person sees -----------------------------------------------------------------------

    def plot(self) -> Figure:
        """Draw pixel size and parameters against the magnification, with their 1-sigma bands.

        Returns
        -------
        matplotlib.figure.Figure
            No figure manager knows it: notebooks show it, and ``savefig`` writes it.
        """
        # Here, so that those who want no figure do not wait for matplotlib.
        from semcal_ros.report.calibration.parameter_figures import plot_calibration

        return plot_calibration(self)

    def __repr__(self) -> str:
        facts = dict(self._facts())
        texts = [facts["method"], facts["magnification"], facts["image size"]]
        if "views" in facts:
            texts.append(counted(int(facts["views"]), "view"))
        texts += [f"{name} {facts[name]}" for name in ("RMS", "held-out RMS") if name in facts]
        if self.warnings:
            texts.append(counted(len(self.warnings), "warning"))
        return f"Calibration({', '.join(texts)})"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{name}</th><td>{escape(text)}</td></tr>"
            for name, text in [*self._facts(), *(("warning", text) for text in self.warnings)]
        )
        return f"<table><caption>Calibration</caption>{rows}</table>"

    def _facts(self) -> list[tuple[str, str]]:
        """Names and values of what a person wants to know first."""
        low, high = self.magnification_range
        facts = [
            ("method", self.method),
            ("magnification", f"{low:g}x to {high:g}x" if high > low else f"{low:g}x"),
            ("image size", f"{self.image_width} x {self.image_height} px"),
        ]
        # The statistics in a file are notes, which may have been edited.
        views = self.statistics.get("views")
        if isinstance(views, int):
            facts.append(("views", str(views)))
        for name, key in (("RMS", "rms_px"), ("held-out RMS", "held_out_rms_px")):
            value = self.statistics.get(key)
            if isinstance(value, (int, float)):
                facts.append((name, f"{value:.3g} px"))
        return facts

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Calibration):
            return NotImplemented
        return self is other or self.dumps() == other.dumps()

    def __hash__(self) -> int:
        return hash((self.method, self.image_size, self.display_width_m, self.magnifications))
