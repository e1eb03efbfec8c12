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

"""Each camera parameter, grouped like the paper's figures 10 to 12, and the pixel size against the magnification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.report.calibration.curves import (
    draw_curve,
    mark_magnifications,
    read_curve,
    sample_cameras,
    set_limits_with_room,
)
from semcal_ros.report.html.encode import Picture, encode_figure
from semcal_ros.report.html.page import format_length, format_with_sigma
from semcal_ros.report.html.style import (
    OURS,
    SECOND,
    add_legend,
    create_figure,
    set_log_axis_y,
    set_magnification_axis,
    style_axes,
)


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that belong together.

    Attributes
    ----------
    title, text
        Heading, and a sentence below it.
    pictures
        One picture for each parameter.
    """

    title: str
    text: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class _Panel:
    """One parameter as a reader sees it: ``factor * value - offset`` in ``unit``."""

    name: str
    title: str
    unit: str
    factor: float = 1.0
    offset: float = 0.0


_FOCAL = _Panel("f", "Focal length, m / ρ", "10³ px", 1e-3)
_NO_FOCAL = "It is not shown here: somewhere ρ is not positive, which is no perspective."

_GROUPS = (
    (
        "Centre of the distortion",
        "Where the scan has no distortion.",
        (
            _Panel("ex", "Distortion centre, column", "px"),
            _Panel("ey", "Distortion centre, row", "px"),
        ),
    ),
    (
        "Strength of the distortion",
        "At half the image width from the centre, 10⁻³ is a displacement of "
        "0.05 % of the image width for the radial part.",
        (
            _Panel("xi_r", "Radial distortion", "10⁻³", 1e3),
            _Panel("xi_t", "Tangential distortion", "10⁻³", 1e3),
        ),
    ),
    (
        "Projection",
        "Focal length, aspect ratio and skew. The focal length is the scale "
        "m over the inverse distance ρ of the scan pivot.",
        (
            _FOCAL,
            _Panel("aspect", "Aspect ratio minus 1", "10⁻³", 1e3, 1e3),
            _Panel("skew", "Skew ratio", "10⁻³", 1e3),
        ),
    ),
    (
        "Scale, principal point and scan pivot",
        "What the focal length consists of, and the principal "
        "point, which is one for all magnifications where a magnification alone cannot show it.",
        (
            _Panel("m", "Scale, deviation from nominal", "%", 100.0, 100.0),
            _Panel("rho", "Inverse distance of the scan pivot", "1/m"),
            _Panel("px", "Principal point, column", "px"),
            _Panel("py", "Principal point, row", "px"),
        ),
    ),
)


def compute_focal_length_px(camera: ScanCamera) -> tuple[float, float]:
    """Focal length m / rho and its 1-sigma, px; infinite for a parallel projection."""
    if camera.rho <= 0.0:
        return float("inf"), float("inf")
    f = camera.m / camera.rho
    if camera.covariance is None:
        return f, 0.0
    gradient = np.zeros(len(camera.names))
    gradient[ALL_NAMES.index("m")] = 1.0 / camera.rho
    gradient[ALL_NAMES.index("rho")] = -f / camera.rho
    return f, float(np.sqrt(max(float(gradient @ camera.covariance @ gradient), 0.0)))


def _collect_values(
    model: CalibrationModel, cameras: list[ScanCamera], name: str
) -> tuple[Array, Array]:
    """Collect (G,) values of a parameter and their 1-sigma; the scale is relative to nominal."""
    if name == "f":
        pairs = np.array([compute_focal_length_px(c) for c in cameras])
        return pairs[:, 0], pairs[:, 1]
    k = ALL_NAMES.index(name)
    values = np.array([c.parameters[k] for c in cameras])
    variances = np.array(
        [0.0 if c.covariance is None else float(c.covariance[k, k]) for c in cameras]
    )
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    if name == "m":
        nominal = np.array([model.nominal_px_per_m(c.magnification) for c in cameras])
        return values / nominal, sigmas / nominal
    return values, sigmas


def plot_parameters(model: CalibrationModel) -> list[ParameterGroup]:
    """Plot each camera parameter against the magnification with its 1-sigma band."""
    cameras = sample_cameras(model)
    g = np.array([c.magnification for c in cameras])
    groups = []
    for title, text, panels in _GROUPS:
        pictures = []
        for panel in panels:
            values, sigmas = _collect_values(model, cameras, panel.name)
            if np.all(np.isfinite(values)):
                values, sigmas = panel.factor * values - panel.offset, panel.factor * sigmas
                pictures.append(_plot_panel(model, panel, g, values, sigmas))
            else:
                text = f"{text} {_NO_FOCAL}"
        groups.append(ParameterGroup(title, text, tuple(pictures)))
    return groups


def _plot_panel(
    model: CalibrationModel, panel: _Panel, g: Array, values: Array, sigmas: Array
) -> Picture:
    figure = create_figure(4.0, 2.4)
    axes = figure.add_subplot()
    _draw_panel(axes, model, panel, g, values, sigmas)
    first, last = (format_with_sigma(values[k], sigmas[k]) for k in (0, -1))
    # A constant may have a different uncertainty at each end.
    if len(g) > 1 and first == last and np.ptp(values) <= 1e-9 * np.abs(values).max():
        ends = f"{first} at every magnification"
    elif len(g) > 1:
        ends = f"{first} at {g[0]:g}× to {last} at {g[-1]:g}×"
    else:
        ends = f"{first} at {g[0]:g}×"
    return encode_figure(
        figure,
        f"{panel.title} against magnification: {ends}, in {panel.unit}; "
        f"largest 1-sigma {sigmas.max():.2g}.",
        f"{panel.title} ({panel.unit}): {ends}.",
        read_curve(
            axes,
            g,
            [
                f"{format_with_sigma(value, sigma)} {panel.unit}"
                for value, sigma in zip(values, sigmas, strict=True)
            ],
        ),
    )


def _draw_panel(
    axes: Axes, model: CalibrationModel, panel: _Panel, g: Array, values: Array, sigmas: Array
) -> None:
    """Draw a parameter with its 1-sigma band."""
    style_axes(axes, xlabel="magnification", ylabel=panel.unit)
    draw_curve(axes, g, values, sigmas, OURS)
    set_magnification_axis(axes, g[0], g[-1])
    if panel is _FOCAL:
        set_log_axis_y(axes, 0.7 * float(values.min()), 1.4 * float(values.max()))
    else:
        set_limits_with_room(axes, values, sigmas)
        axes.ticklabel_format(axis="y", useOffset=False)
    mark_magnifications(axes, model)


def plot_calibration(model: CalibrationModel) -> Figure:
    """Plot pixel size and all parameters against the magnification, with bands, in one figure.

    The focal length is left out: it is the scale over the inverse distance of the scan pivot.
    """
    cameras = sample_cameras(model)
    g = np.array([c.magnification for c in cameras])
    panels = [panel for _, _, group in _GROUPS for panel in group if panel is not _FOCAL]
    # The scale first, then what follows from the paper's figures.
    panels.sort(key=lambda panel: panel.name != "m")
    columns = 4
    figure = create_figure(3.6 * columns, 2.5 * -(-(1 + len(panels)) // columns))
    places = figure.subplots(-(-(1 + len(panels)) // columns), columns).ravel()
    _draw_pixel_size(places[0], model, g, np.array([c.pixel_size_m for c in cameras]))
    for axes, panel in zip(places[1:], panels, strict=False):
        values, sigmas = _collect_values(model, cameras, panel.name)
        values, sigmas = panel.factor * values - panel.offset, panel.factor * sigmas
        _draw_panel(axes, model, panel, g, values, sigmas)
        axes.set_title(panel.title, fontsize="small")
    for axes in places[1 + len(panels) :]:
        axes.remove()
    return figure


def _draw_pixel_size(axes: Axes, model: CalibrationModel, g: Array, sizes: Array) -> None:
    """Draw the mean pixel size of both axes; its uncertainty is in the panel of the scale."""
    nm = 1e9 * sizes.mean(axis=1)
    style_axes(axes, xlabel="magnification", ylabel="nm")
    axes.plot(g, nm, "o" if len(g) == 1 else "-", color=OURS, linewidth=1.4)
    set_magnification_axis(axes, g[0], g[-1])
    set_log_axis_y(axes, 0.8 * float(nm.min()), 1.25 * float(nm.max()))
    mark_magnifications(axes, model)
    axes.set_title("Size of a pixel", fontsize="small")


def plot_pixel_sizes(model: CalibrationModel) -> list[Picture]:
    """Plot the size of a pixel against the magnification, and its uncertainty."""
    cameras = sample_cameras(model)
    g = np.array([c.magnification for c in cameras])
    sizes = np.array([c.pixel_size_m for c in cameras])
    sigmas = np.array([_get_size_sigma(c) for c in cameras])
    nominal = np.array([1.0 / model.nominal_px_per_m(float(x)) for x in g])
    return [
        _plot_size(model, g, sizes, sigmas),
        _plot_size_interval(model, g, sizes / nominal[:, None], sigmas / nominal[:, None]),
    ]


_DIRECTIONS = (("x (horizontal)", OURS, "-"), ("y (vertical)", SECOND, "--"))


def _plot_size(model: CalibrationModel, g: Array, sizes: Array, sigmas: Array) -> Picture:
    figure = create_figure(4.6, 3.2)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="nm per pixel")
    for k, (label, color, style) in enumerate(_DIRECTIONS):
        shape = "o" if len(g) == 1 else style
        axes.plot(g, 1e9 * sizes[:, k], shape, color=color, linewidth=2.6 - 1.2 * k, label=label)
    set_magnification_axis(axes, g[0], g[-1])
    set_log_axis_y(axes, 0.8e9 * float(sizes.min()), 1.25e9 * float(sizes.max()))
    mark_magnifications(axes, model)
    add_legend(axes, loc="upper right")
    ends = [f"{format_length(sizes[k, 0])} at {g[k]:g}×" for k in (0, -1)]
    span = f"from {ends[0]} to {ends[1]}" if len(g) > 1 else ends[0]
    return encode_figure(
        figure,
        f"Pixel size against magnification, in x {span}.",
        f"Size of a pixel; in x {span}.",
        read_curve(
            axes,
            g,
            [
                f"x {format_length(x, s)}, y {format_length(y, t)}"
                for (x, y), (s, t) in zip(sizes, sigmas, strict=True)
            ],
        ),
    )


def _plot_size_interval(model: CalibrationModel, g: Array, ratio: Array, sigma: Array) -> Picture:
    figure = create_figure(4.6, 3.2)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="magnification", ylabel="pixel size relative to nominal (%)")
    percent, half = 100.0 * (ratio - 1.0), 196.0 * sigma
    for k, (label, color, style) in enumerate(_DIRECTIONS):
        draw_curve(axes, g, percent[:, k], half[:, k], color, label, style)
    set_magnification_axis(axes, g[0], g[-1])
    set_limits_with_room(axes, percent, half)
    mark_magnifications(axes, model)
    add_legend(axes, loc="best")
    worst = float(np.max(half / ratio))
    return encode_figure(
        figure,
        f"Deviation of the pixel size from nominal with its 95 % interval, at most {worst:.2g} % "
        "to either side.",
        "Deviation from the nominal size, with the 95 % interval, which is at most "
        f"±{worst:.2g} %. Errors of the grid itself are not included.",
        read_curve(
            axes,
            g,
            [
                f"x {format_with_sigma(x, s)} %, y {format_with_sigma(y, t)} % (± is 1-sigma)"
                for (x, y), (s, t) in zip(percent, 100.0 * sigma, strict=True)
            ],
        ),
    )


def _get_size_sigma(camera: ScanCamera) -> tuple[float, float]:
    return (0.0, 0.0) if camera.covariance is None else camera.pixel_size_sigma_m
