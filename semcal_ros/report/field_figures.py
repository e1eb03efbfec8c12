"""Figures over the image field: where the corners are, how they fit, what the distortion does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from semcal_ros.core.calibrate import CalibrationResult
from semcal_ros.core.camera import ScanCamera
from semcal_ros.report.encode import Picture, picture_of_figure
from semcal_ros.report.style import (
    INK,
    MUTED,
    OURS,
    SECOND,
    field_axes,
    log_ticks,
    new_figure,
    nice_factor,
    tidy,
)

__all__ = [
    "coverage_picture",
    "displacement_field",
    "distortion_picture",
    "empty_share",
    "mean_residual_picture",
    "pose_picture",
    "residual_picture",
    "tilts_deg",
]

Array = NDArray[np.float64]

_CELLS = 24
_RESIDUAL_CELLS = 12
_MAX_ARROWS = 700
# Corners in a cell below which the mean of its residuals says little.
_MIN_IN_CELL = 5


@dataclass(frozen=True)
class _Cells:
    """A lattice of nearly square cells over the field, with the cell of every corner."""

    columns: int
    rows: int
    index: NDArray[np.intp]
    centres: Array

    @property
    def counts(self) -> NDArray[np.intp]:
        """(columns * rows,) number of corners in each cell."""
        return np.bincount(self.index, minlength=self.columns * self.rows)


def empty_share(result: CalibrationResult, across: int = 12) -> float:
    """Share of the field, in cells of which ``across`` are side by side, without any corner."""
    counts = _cells(result, np.concatenate([v.image_xy for v in result.views]), across).counts
    return float(np.mean(counts == 0))


def _cells(result: CalibrationResult, xy: Array, across: int) -> _Cells:
    width, height = result.model.image_size
    rows = max(1, round(across * height / width))
    size = np.array([width / across, height / rows])
    ij = np.floor((xy + 0.5) / size).astype(np.intp)
    ij = np.clip(ij, 0, [across - 1, rows - 1])
    j, i = np.mgrid[0:rows, 0:across]
    centres = (np.stack([i.ravel(), j.ravel()], axis=1) + 0.5) * size - 0.5
    return _Cells(across, rows, ij[:, 1] * across + ij[:, 0], centres)


def _corners(result: CalibrationResult) -> tuple[Array, Array]:
    """All corners (n, 2) with their residuals (n, 2), px."""
    return (
        np.concatenate([v.image_xy for v in result.views]),
        np.concatenate(result.fit.residuals_px),
    )


def coverage_picture(result: CalibrationResult) -> Picture:
    """How many corners of all views lie in each cell of the field."""
    xy, _ = _corners(result)
    cells = _cells(result, xy, _CELLS)
    counts = cells.counts
    grid = counts.reshape(cells.rows, cells.columns).astype(np.float64)
    empty = int(np.sum(counts == 0))
    width, height = result.model.image_size
    figure = new_figure(4.2, 0.6 + 2.8 * min(height / width, 1.6))
    axes = figure.add_subplot()
    shown = axes.imshow(
        np.where(grid > 0.0, grid, np.nan),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap="viridis",
        vmin=0.0,
        interpolation="nearest",
    )
    field_axes(axes, width, height)
    axes.grid(False)
    _color_bar(axes, shown, "corners per cell")
    share = f"{empty} of {counts.size} cells have no corner"
    return picture_of_figure(
        figure,
        f"Map of the image field with the number of corners per cell; {share}.",
        f"Corners of all {len(result.views)} views; {share} (white). "
        "Where there are none, the distortion is extrapolated.",
    )


def tilts_deg(result: CalibrationResult) -> tuple[Array, Array]:
    """Tilt of the grid in each view, and direction of its normal in the image, degrees."""
    normals = result.fit.rotations[:, :, 2]
    upright = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    tilt = np.degrees(np.arccos(np.clip(upright[:, 2], -1.0, 1.0)))
    return tilt, np.degrees(np.arctan2(upright[:, 1], upright[:, 0]))


def pose_picture(result: CalibrationResult) -> Picture:
    """Tilt of the grid and its direction in every view."""
    tilt, azimuth = tilts_deg(result)
    figure = new_figure(4.6, 3.2)
    axes = figure.add_subplot()
    limit = max(5.0, 1.1 * float(tilt.max()))
    circle = np.linspace(0.0, 2.0 * np.pi, 121)
    step = nice_factor(1.0, limit / 2.0)
    for radius in np.arange(step, limit * 1.001, step):
        axes.plot(radius * np.cos(circle), radius * np.sin(circle), color="#c8ced6", linewidth=0.8)
        axes.annotate(
            f"{radius:g}°", (0.0, -radius), fontsize=8, color=MUTED, ha="center", va="bottom"
        )
    low, high = result.model.magnification_range
    angle = np.radians(azimuth)
    dots = axes.scatter(
        tilt * np.cos(angle),
        tilt * np.sin(angle),
        c=result.fit.magnifications,
        cmap="viridis",
        norm=LogNorm(low, high) if high > low else None,
        s=22,
        edgecolors="white",
        linewidths=0.4,
        zorder=3,
    )
    tidy(
        axes, xlabel="tilt towards the right of the image (°)", ylabel="tilt towards the bottom (°)"
    )
    axes.grid(False)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(limit, -limit)
    axes.set_aspect("equal")
    bar = _color_bar(axes, dots, "magnification")
    if high > low:
        bar.ax.yaxis.set_major_locator(FixedLocator(log_ticks(low, high)))
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda g, _: f"{g:g}×"))
        bar.ax.yaxis.set_minor_locator(NullLocator())
    span = f"from {tilt.min():.1f} to {tilt.max():.1f} degrees"
    return picture_of_figure(
        figure,
        f"Tilt and tilt direction of the grid in each view, {span}.",
        f"Tilts of the grid, {span}. Tilts in different directions separate scale, height and "
        "perspective.",
    )


def mean_residual_picture(result: CalibrationResult) -> Picture:
    """Mean residual vector in each cell: what the model cannot describe, without the noise."""
    xy, residuals = _corners(result)
    cells = _cells(result, xy, _RESIDUAL_CELLS)
    size = cells.columns * cells.rows
    counts = cells.counts
    sums = np.stack([np.bincount(cells.index, residuals[:, k], size) for k in (0, 1)], axis=1)
    enough = counts >= _MIN_IN_CELL
    means = sums[enough] / counts[enough, None]
    lengths = np.hypot(means[:, 0], means[:, 1])
    width, height = result.model.image_size
    figure = new_figure(4.2, 0.6 + 3.6 * min(height / width, 1.6))
    axes = figure.add_subplot()
    field_axes(axes, width, height)
    if not len(means):
        return picture_of_figure(
            figure,
            "No cell of the field has enough corners for a mean residual.",
            f"No cell of the field has {_MIN_IN_CELL} corners.",
        )
    factor = nice_factor(float(lengths.max()), width / _RESIDUAL_CELLS)
    _arrows(axes, cells.centres[enough], means, factor, OURS)
    text = f"largest {lengths.max():.3f} px, RMS of the means {np.sqrt(np.mean(lengths**2)):.3f} px"
    return picture_of_figure(
        figure,
        f"Mean residual vectors in {len(means)} cells of the field, drawn {factor:g} times as "
        f"long; {text}.",
        f"Mean residual in each cell, arrows {factor:g} times as long as the error; {text}. "
        "A pattern here is a distortion that the model does not describe.",
    )


def residual_picture(result: CalibrationResult) -> Picture:
    """Residual vectors of single corners, at most some of them, the same ones every time."""
    xy, residuals = _corners(result)
    chosen = np.arange(len(xy))
    if len(xy) > _MAX_ARROWS:
        chosen = np.random.default_rng(0).choice(len(xy), _MAX_ARROWS, replace=False)
    lengths = np.hypot(residuals[:, 0], residuals[:, 1])
    width, height = result.model.image_size
    factor = nice_factor(float(np.quantile(lengths, 0.95)), width / 12)
    figure = new_figure(4.2, 0.6 + 3.6 * min(height / width, 1.6))
    axes = figure.add_subplot()
    field_axes(axes, width, height)
    _arrows(axes, xy[chosen], residuals[chosen], factor, SECOND)
    part = f"{len(chosen)} of {len(xy)} corners"
    return picture_of_figure(
        figure,
        f"Residual vectors of {part} over the field, drawn {factor:g} times as long.",
        f"Residuals (found minus predicted) of {part}, arrows {factor:g} times as long as the "
        f"error; half of all are below {np.median(lengths):.3f} px, the longest is "
        f"{lengths.max():.3f} px.",
    )


def _color_bar(axes: Axes, shown: ScalarMappable, label: str) -> Colorbar:
    """Colour bar as high as the axes, at their right."""
    figure = axes.figure
    bar = figure.colorbar(shown, cax=axes.inset_axes((1.04, 0.0, 0.05, 1.0)))
    bar.set_label(label, fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, colors=INK)
    return bar


def _arrows(axes: Axes, xy: Array, vectors: Array, factor: float, color: str) -> None:
    # angles="xy" follows the downward y axis; scale 1 in data units makes the stated factor true.
    axes.quiver(
        xy[:, 0],
        xy[:, 1],
        factor * vectors[:, 0],
        factor * vectors[:, 1],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=color,
        width=0.0035,
        headwidth=3.5,
        headlength=4.0,
        headaxislength=3.6,
    )


def displacement_field(camera: ScanCamera, across: int = 13) -> tuple[Array, Array]:
    """Ideal pixels on a lattice over the field with their displacement; NaN where there is none."""
    down = max(2, round(across * camera.height / camera.width))
    x, y = np.meshgrid(
        np.linspace(0, camera.width - 1, across), np.linspace(0, camera.height - 1, down)
    )
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    return xy, camera.distort(xy) - xy


def distortion_picture(camera: ScanCamera) -> Picture:
    """Displacement of the pixels by the distortion at one magnification."""
    xy, moved = displacement_field(camera)
    known = np.all(np.isfinite(moved), axis=1)
    lengths = np.hypot(moved[known, 0], moved[known, 1])
    largest = float(lengths.max()) if lengths.size else 0.0
    factor = nice_factor(largest, camera.width / 7)
    figure = new_figure(4.2, 0.6 + 3.6 * min(camera.height / camera.width, 1.6))
    axes = figure.add_subplot()
    field_axes(axes, camera.width, camera.height)
    axes.grid(False)
    _arrows(axes, xy[known], moved[known], factor, OURS)
    axes.plot([camera.ex], [camera.ey], "+", color=SECOND, markersize=12, markeredgewidth=2)
    g = f"{camera.magnification:.5g}"
    return picture_of_figure(
        figure,
        f"Displacement of pixels by the distortion at {g}x, at most {largest:.3g} px, arrows "
        f"{factor:g} times as long.",
        f"{g}×: at most {largest:.3g} px; arrows {factor:g} times as long, + is the centre of the "
        "distortion.",
    )
