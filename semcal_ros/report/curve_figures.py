"""Figures against the magnification: errors, parameters, pixel size, predicted uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from semcal_ros.core.calibrate import CalibrationResult
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.evaluate import rms_by_magnification
from semcal_ros.core.model import CalibrationModel
from semcal_ros.core.projection import project_points_with_jacobians
from semcal_ros.report.encode import Picture, picture_of_figure
from semcal_ros.report.numbers import PAPER_RMS_PX, format_length
from semcal_ros.report.style import (
    ACCENT,
    OURS,
    REFERENCE,
    SECOND,
    legend,
    log_axis_y,
    magnification_axis,
    new_figure,
    tidy,
)

__all__ = [
    "parameter_pictures",
    "pixel_size_pictures",
    "rms_picture",
    "shape_sigma_px",
    "sigma_picture",
]

Array = NDArray[np.float64]

_SAMPLES = 81


def _sampled(model: CalibrationModel) -> list[ScanCamera]:
    low, high = model.magnification_range
    count = _SAMPLES if high > low else 1
    return [model.at(float(g)) for g in np.clip(np.geomspace(low, high, count), low, high)]


def _rug(axes: Axes, model: CalibrationModel) -> None:
    """Short marks on the x axis where images were taken."""
    g = np.array(model.magnifications)
    axes.plot(
        g,
        np.zeros(len(g)),
        "|",
        color=SECOND,
        markersize=7,
        markeredgewidth=1.2,
        transform=axes.get_xaxis_transform(),
        clip_on=False,
        zorder=5,
    )


# -- errors ---------------------------------------------------------------------------------------


def rms_picture(result: CalibrationResult) -> Picture:
    """RMS and held-out RMS at each magnification, with what the paper reports."""
    rms = rms_by_magnification(result.fit)
    g = np.array(list(rms))
    values = np.array(list(rms.values()))
    held = np.array([result.held_out_rms_px.get(float(x), np.nan) for x in g])
    figure = new_figure(4.6, 3.6)
    axes = figure.add_subplot()
    tidy(axes, xlabel="magnification", ylabel="RMS error (px)")
    for value, style in zip(PAPER_RMS_PX, ("--", "-."), strict=True):
        axes.axhline(
            value, color=REFERENCE, linestyle=style, linewidth=1.2, label=f"paper: {value:g} px"
        )
    axes.plot(g, values, "o-", color=OURS, markersize=4, linewidth=1.2, label="all views fitted")
    _plot_held_out(axes, g, held)
    magnification_axis(axes, g[0], g[-1])
    shown = np.concatenate([values, held[np.isfinite(held)], PAPER_RMS_PX])
    shown = shown[shown > 0.0]
    log_axis_y(axes, 0.5 * float(shown.min()), 6.0 * float(shown.max()))
    legend(axes, loc="upper center", ncols=2)
    return picture_of_figure(
        figure,
        f"RMS error against magnification, {values.min():.3f} to {values.max():.3f} px, "
        f"beside the paper's {PAPER_RMS_PX[0]:g} and {PAPER_RMS_PX[1]:g} px.",
        "Held out: the images of this magnification, judged by a calibration from all other "
        "magnifications. Hollow: the lowest and highest one, which are extrapolated in this test.",
    )


def _plot_held_out(axes: Axes, g: Array, held: Array) -> None:
    if len(g) < 2 or not np.any(np.isfinite(held)):
        return
    inner = np.isfinite(held)
    inner[[0, -1]] = False
    ends = np.isfinite(held) & ~inner
    axes.plot(g[inner], held[inner], "s", color=SECOND, markersize=4.5, label="held out")
    axes.plot(
        g[ends],
        held[ends],
        "s",
        color=SECOND,
        markersize=5,
        markerfacecolor="none",
        label="held out, extrapolated",
    )


# -- parameters -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Panel:
    """One parameter as a reader sees it: ``factor * value - offset`` in ``unit``."""

    title: str
    unit: str
    factor: float = 1.0
    offset: float = 0.0


# In the order of the camera's parameters, the first one relative to nominal.
_PANELS = (
    _Panel("Scale, deviation from nominal", "%", 100.0, 100.0),
    _Panel("Aspect ratio minus 1", "10⁻³", 1e3, 1e3),
    _Panel("Skew ratio", "10⁻³", 1e3),
    _Panel("Principal point, column", "px"),
    _Panel("Principal point, row", "px"),
    _Panel("Inverse distance of the scan pivot", "1/m"),
    _Panel("Radial distortion", "10⁻³", 1e3),
    _Panel("Tangential distortion", "10⁻³", 1e3),
    _Panel("Distortion centre, column", "px"),
    _Panel("Distortion centre, row", "px"),
)


def _values_and_sigmas(model: CalibrationModel, cameras: list[ScanCamera]) -> tuple[Array, Array]:
    """(G, 10) parameters of all cameras and their 1-sigma, the scale relative to nominal."""
    values = np.stack([c.parameters for c in cameras])
    variances = [np.zeros(10) if c.covariance is None else np.diag(c.covariance) for c in cameras]
    sigmas = np.sqrt(np.maximum(np.stack(variances), 0.0))
    nominal = np.array([model.nominal_px_per_m(c.magnification) for c in cameras])
    values[:, 0] /= nominal
    sigmas[:, 0] /= nominal
    return values, sigmas


def parameter_pictures(model: CalibrationModel) -> list[Picture]:
    """Each camera parameter against the magnification with its 1-sigma band."""
    cameras = _sampled(model)
    g = np.array([c.magnification for c in cameras])
    values, sigmas = _values_and_sigmas(model, cameras)
    return [
        _parameter_picture(
            model, panel, g, panel.factor * values[:, k] - panel.offset, panel.factor * sigmas[:, k]
        )
        for k, panel in enumerate(_PANELS)
    ]


def _parameter_picture(
    model: CalibrationModel, panel: _Panel, g: Array, values: Array, sigmas: Array
) -> Picture:
    figure = new_figure(4.0, 2.4)
    axes = figure.add_subplot()
    tidy(axes, xlabel="magnification", ylabel=panel.unit)
    _curve(axes, g, values, sigmas, OURS)
    magnification_axis(axes, g[0], g[-1])
    _wide_enough(axes, values, sigmas)
    _rug(axes, model)
    axes.ticklabel_format(axis="y", useOffset=False)
    span = f"{values[0]:.4g} at {g[0]:g}x to {values[-1]:.4g} at {g[-1]:g}x"
    return picture_of_figure(
        figure,
        f"{panel.title}: {span} {panel.unit}; largest 1-sigma {sigmas.max():.2g} {panel.unit}.",
        f"{panel.title} ({panel.unit})",
    )


def _curve(axes: Axes, g: Array, values: Array, sigmas: Array, color: str, label: str = "") -> None:
    """Line with its 1-sigma band, or a point with a bar where there is one magnification only."""
    if len(g) == 1:
        axes.errorbar(g, values, yerr=sigmas, fmt="o", color=color, capsize=4, label=label or None)
        return
    axes.fill_between(g, values - sigmas, values + sigmas, color=color, alpha=0.25, linewidth=0)
    axes.plot(g, values, color=color, linewidth=1.4, label=label or None)


def _wide_enough(axes: Axes, values: Array, sigmas: Array) -> None:
    """Limits with room, also for a constant that is exactly known."""
    low, high = float(np.min(values - sigmas)), float(np.max(values + sigmas))
    room = max(0.12 * (high - low), 1e-4 * max(abs(low), abs(high)), 1e-6)
    axes.set_ylim(low - room, high + room)


# -- pixel size -----------------------------------------------------------------------------------


def pixel_size_pictures(model: CalibrationModel) -> list[Picture]:
    """Size of a pixel against the magnification, and how well it is known."""
    cameras = _sampled(model)
    g = np.array([c.magnification for c in cameras])
    sizes = np.array([c.pixel_size_m for c in cameras])
    sigmas = np.array([_size_sigma(c) for c in cameras])
    nominal = np.array([1.0 / model.nominal_px_per_m(float(x)) for x in g])
    return [
        _size_picture(model, g, sizes),
        _size_interval_picture(model, g, sizes / nominal[:, None], sigmas / nominal[:, None]),
    ]


_DIRECTIONS = (("x (horizontal)", OURS), ("y (vertical)", SECOND))


def _size_picture(model: CalibrationModel, g: Array, sizes: Array) -> Picture:
    figure = new_figure(4.6, 3.2)
    axes = figure.add_subplot()
    tidy(axes, xlabel="magnification", ylabel="nm per pixel")
    style = "o" if len(g) == 1 else "-"
    for k, (label, color) in enumerate(_DIRECTIONS):
        axes.plot(
            g, 1e9 * sizes[:, k], style, color=color, linewidth=1.4 + 1.2 * (1 - k), label=label
        )
    magnification_axis(axes, g[0], g[-1])
    log_axis_y(axes, 0.8e9 * float(sizes.min()), 1.25e9 * float(sizes.max()))
    _rug(axes, model)
    legend(axes, loc="upper right")
    ends = [f"{format_length(sizes[k, 0])} at {g[k]:g}×" for k in (0, -1)]
    span = f"from {ends[0]} to {ends[1]}" if len(g) > 1 else ends[0]
    return picture_of_figure(
        figure, f"Pixel size against magnification, in x {span}.", f"Size of a pixel; in x {span}."
    )


def _size_interval_picture(
    model: CalibrationModel, g: Array, ratio: Array, sigma: Array
) -> Picture:
    figure = new_figure(4.6, 3.2)
    axes = figure.add_subplot()
    tidy(axes, xlabel="magnification", ylabel="pixel size relative to nominal (%)")
    percent, half = 100.0 * (ratio - 1.0), 196.0 * sigma
    for k, (label, color) in enumerate(_DIRECTIONS):
        _curve(axes, g, percent[:, k], half[:, k], color, label)
    magnification_axis(axes, g[0], g[-1])
    _wide_enough(axes, percent, half)
    _rug(axes, model)
    legend(axes, loc="best")
    worst = float(np.max(half / ratio))
    return picture_of_figure(
        figure,
        f"Deviation of the pixel size from nominal with its 95 % interval, at most {worst:.2g} % "
        "to either side.",
        "Deviation from the nominal size, with the 95 % interval, which is at most "
        f"±{worst:.2g} %. Errors of the grid itself are not included.",
    )


def _size_sigma(camera: ScanCamera) -> tuple[float, float]:
    return (0.0, 0.0) if camera.covariance is None else camera.pixel_size_sigma_m


# -- predicted uncertainty ------------------------------------------------------------------------


def shape_sigma_px(camera: ScanCamera, xy: Array) -> Array:
    """(n,) predicted 1-sigma, px, of positions relative to the image centre, worse axis.

    The points lie in the reference plane and are seen at ideal pixels ``xy``. A common shift of the
    image drops out: it trades off against the position of the specimen, which no measurement inside
    of one image needs.
    """
    if camera.covariance is None:
        return np.zeros(len(xy))
    centre = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    points = camera.sem_from_ideal(np.concatenate([centre, xy]))
    jacobian = project_points_with_jacobians(camera.parameters, points, camera.norm_px).d_parameters
    difference = jacobian[1:] - jacobian[:1]
    covariance = np.einsum("nip,pq,njq->nij", difference, camera.covariance, difference)
    known = np.all(np.isfinite(covariance), axis=(1, 2))
    out = np.full(len(xy), np.nan)
    largest = np.linalg.eigvalsh(covariance[known])[:, -1]
    out[known] = np.sqrt(np.maximum(largest, 0.0))
    return out


def sigma_picture(model: CalibrationModel) -> Picture:
    """Predicted error inside of the field against the magnification."""
    cameras = _sampled(model)
    g = np.array([c.magnification for c in cameras])
    width, height = model.image_size
    x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
    lattice = np.stack([x.ravel(), y.ravel()], axis=1)
    sigma = np.stack([shape_sigma_px(c, lattice) for c in cameras])
    figure = new_figure(4.6, 3.2)
    axes = figure.add_subplot()
    tidy(axes, xlabel="magnification", ylabel="predicted 1-sigma (px)")
    style = "o" if len(g) == 1 else "-"
    worst, typical = np.nanmax(sigma, axis=1), np.sqrt(np.nanmean(sigma**2, axis=1))
    axes.plot(g, worst, style, color=SECOND, linewidth=1.4, label="worst point of the field")
    axes.plot(g, typical, style, color=ACCENT, linewidth=1.4, label="RMS over the field")
    magnification_axis(axes, g[0], g[-1])
    axes.set_ylim(0.0, max(1.35 * float(worst.max()), 1e-6))
    _rug(axes, model)
    legend(axes, loc="upper center", ncols=2)
    return picture_of_figure(
        figure,
        "Predicted error of positions relative to the image centre, "
        f"at most {worst.max():.3g} px over field and range.",
        f"Predicted error of positions relative to the image centre: at most {worst.max():.3g} px. "
        "It contains the scale, which the error of the fit does not: a wrong scale and a wrong "
        "height of the grid look alike. Marks on the axis are the calibrated magnifications.",
    )
