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

"""Measure the positions of known surface points in all views against one template.

Tracks that were passed from keyframe to keyframe have wandered. With poses, points and normals
known to a fraction of a pixel, the surface patch around each point is cut out of every view that
faces it, with its foreshortening and bend undone. The mean over the other views is the template;
the remaining shift is measured by least squares. So every observation of a point refers to the same
texture, and points are found again wherever they are in view.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from semcal_ros.applications.reconstruction.adjustment import Observations
from semcal_ros.applications.reconstruction.appearance import Shading, fit_shading
from semcal_ros.applications.reconstruction.feature_tracks import TrackKeyframe, project_to_plane
from semcal_ros.applications.reconstruction.thresholds import (
    PATCH_GAIN_MIN,
    POINTS_AT_ONCE,
    SHADING_POINTS,
    WINDOW,
)
from semcal_ros.core.arrays import Array, Image, Indices, Mask
from semcal_ros.core.camera.scan_timing import ScanTiming

#: As :func:`itertools.starmap`.
Starmap = Callable[[Callable[..., Any], Iterable[Sequence[Any]]], Iterator[Any]]


def compute_displacement_m(
    frame: TrackKeyframe, scan: ScanTiming | None, raw: Array, xy_m: Array
) -> Array:
    """Compute how far the specimen has moved, (n, 2) in m, since the centre of the acquisition when
    raw pixels (n, 2) are scanned that show the sem-frame points ``xy_m`` (n, 2).
    """
    if scan is None:
        return np.zeros_like(xy_m)
    height, width = frame.image.shape[:2]
    offset = scan.pixel_offset_s(raw[:, 1], raw[:, 0], height, width) - scan.centre_offset_s
    velocity = xy_m @ frame.velocity[:, :2].T + frame.velocity[:, 2]
    return np.asarray(velocity * offset[:, None], dtype=np.float64)


def project_to_plane_at_centre(frame: TrackKeyframe, scan: ScanTiming | None, raw: Array) -> Array:
    """Project raw pixels (n, 2) to sem-frame X, Y (n, 2) in m at the centre of the acquisition."""
    seen = project_to_plane(frame.camera, raw)
    return seen - compute_displacement_m(frame, scan, raw, seen)


@dataclass(frozen=True)
class PatchSettings:
    """Settings of the comparison of patches.

    Attributes
    ----------
    half_px
        Half the width of a patch, px.
    steepest_rad
        Largest angle between the beam and the normal: beyond it, a patch is strongly foreshortened
        and touches the bright limb, which does not move with the specimen.
    least_correlation
        Least correlation with the template.
    largest_shift_px
        Largest shift from where the structure predicts the point.
    rounds
        Number of resamplings at the shifted position.
    floor_px
        Least 1-sigma of an observation, added in quadrature.
    smoothing_px
        Sigma of the smoothing of patches, px.
    """

    half_px: int = 7
    steepest_rad: float = float(np.radians(58.0))
    least_correlation: float = 0.5
    largest_shift_px: float = 2.5
    rounds: int = 2
    floor_px: float = 0.03
    smoothing_px: float = 1.3


@dataclass(frozen=True, eq=False)
class PosedSurface:
    """The structure from which patches are cut out.

    Attributes
    ----------
    rotations, translations_m
        (views, 3, 3), (views, 3).
    points_m, normals, curvature_1_m
        (points, 3), (points, 3) outward, (points,).
    """

    rotations: Array
    translations_m: Array
    points_m: Array
    normals: Array
    curvature_1_m: Array


@dataclass(frozen=True, eq=False)
class _Cut:
    """Patches of one view."""

    points: Indices
    centres: Array  # raw px
    by_patch: Array  # (n, 2, 2) raw px per patch px
    bend: Array  # (n, 2) raw px per squared patch px
    inside: Mask
    slope: Array  # (n, 2) X and Y of the normal in the sem frame
    slope_by_patch: Array  # (n, 2, 2) their change per patch px


def measure_patches(
    frames: Sequence[TrackKeyframe],
    log_greys: Sequence[Image],
    scan: ScanTiming | None,
    posed: PosedSurface,
    settings: PatchSettings,
    starmap: Starmap = itertools.starmap,
) -> Observations:
    """Measure every point in every view that faces it and agrees with the template.

    ``starmap`` compares the patches, some points at a time.
    """
    size_m = float(np.mean([np.mean(f.camera.pixel_size_m) for f in frames]))
    grid = _make_patch_grid(settings.half_px)
    cuts = [
        _cut_patches(view, frame, scan, posed, size_m, settings)
        for view, frame in enumerate(frames)
    ]
    shape = (len(frames), len(posed.points_m))
    shift = np.zeros((*shape, 2))
    seen = np.zeros(shape, dtype=bool)
    for view, cut in enumerate(cuts):
        seen[view, cut.points[cut.inside]] = True
    found: _Matched | None = None
    shading: Shading | None = None
    for _ in range(settings.rounds):
        patches = np.zeros((*shape, len(grid)), dtype=np.float32)
        for view, cut in enumerate(cuts):
            drawn = _sample_patches(log_greys[view], cut, shift[view, cut.points], grid)
            patches[view, cut.points] = _smooth_patches(drawn, settings)
        if shading is None:
            shading = _measure_shading(cuts, patches, seen, settings.half_px)
        for view, cut in enumerate(cuts):
            everything = np.arange(len(cut.points))
            patches[view, cut.points] -= shading.evaluate(_compute_slopes(cut, everything, grid))
        _normalise(patches, seen)
        found = _match_patches(patches, seen, settings.half_px, starmap)
        shift += np.where(seen[..., None], np.clip(found.shift, -1.0, 1.0), 0.0)
    assert found is not None
    good = seen & (found.correlation >= settings.least_correlation)
    good &= np.linalg.norm(shift, axis=2) <= settings.largest_shift_px
    good &= np.linalg.norm(found.shift, axis=2) < 0.7
    return _collect_observations(
        frames, scan, cuts, shift, found.covariance, good, settings.floor_px
    )


def _make_patch_grid(half: int) -> Array:
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def _choose_tangents(normals: Array) -> tuple[Array, Array]:
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(normals, first)


def _cut_patches(
    view: int,
    frame: TrackKeyframe,
    scan: ScanTiming | None,
    posed: PosedSurface,
    size_m: float,
    settings: PatchSettings,
) -> _Cut:
    rotation, translation = posed.rotations[view], posed.translations_m[view]
    towards_gun = -(posed.normals @ rotation[2])
    points = np.flatnonzero(towards_gun > np.cos(settings.steepest_rad))
    at, normal = posed.points_m[points], posed.normals[points]
    first, second = _choose_tangents(normal)
    step = settings.half_px * size_m
    places = np.concatenate(
        [at, at + step * first, at - step * first, at + step * second, at - step * second]
        + [at + step * normal, at - step * normal]
    )
    sem = places @ rotation.T + translation
    raw = frame.camera.project(sem)
    sem[:, :2] += compute_displacement_m(frame, scan, np.nan_to_num(raw), sem[:, :2])
    raw = frame.camera.project(sem).reshape(7, -1, 2)
    span = 2.0 * settings.half_px
    by_patch = np.stack([(raw[1] - raw[2]) / span, (raw[3] - raw[4]) / span], axis=2)
    by_normal = (raw[5] - raw[6]) / span
    bend = -0.5 * by_normal * (posed.curvature_1_m[points] * size_m)[:, None]
    height, width = frame.image.shape[:2]
    border = settings.half_px + 3.0
    inside = np.all(np.isfinite(raw[0]), axis=1)
    inside &= np.all(raw[0] > border, axis=1)
    inside &= np.all(raw[0] < np.array([width, height]) - 1.0 - border, axis=1)
    turn = (posed.curvature_1_m[points] * size_m)[:, None, None]
    return _Cut(
        points,
        np.nan_to_num(raw[0]),
        by_patch,
        bend,
        inside,
        normal @ rotation[:2].T,
        turn * np.stack([first @ rotation[:2].T, second @ rotation[:2].T], axis=2),
    )


def _sample_patches(log_grey: Image, cut: _Cut, shift: Array, grid: Array) -> Image:
    """Sample (n, grid) patches."""
    if not len(cut.points):
        return np.zeros((0, len(grid)), dtype=np.float32)
    local = grid[None] + shift[:, None]
    # The bend belongs to the surface: a shift moves the texture over it.
    xy = cut.centres[:, None] + local @ np.swapaxes(cut.by_patch, 1, 2)
    xy = xy + np.sum(grid**2, axis=1)[None, :, None] * cut.bend[:, None]
    x, y = (np.ascontiguousarray(xy[..., k], dtype=np.float32) for k in (0, 1))
    drawn = cv2.remap(log_grey, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(drawn, dtype=np.float32).reshape(len(local), len(grid))


def _smooth_patches(patches: Image, settings: PatchSettings) -> Image:
    """Smooth (n, grid) patches on the surface.

    In the image, the same smoothing would reach further over the surface on the side of the limb: that
    moves the texture of a ball of radius R towards its middle, by about ``(sigma / R)^2`` of R.
    """
    half = settings.half_px
    at = np.arange(2 * half + 1)
    kernel = np.exp(-0.5 * ((at[:, None] - at) / settings.smoothing_px) ** 2)
    kernel = (kernel / kernel.sum(axis=1, keepdims=True)).astype(np.float32)
    square = patches.reshape(-1, len(at), len(at))
    return np.asarray(kernel @ square @ kernel.T, dtype=np.float32).reshape(patches.shape)


def _normalise(patches: Image, seen: Mask) -> None:
    """Bring patches to zero mean and unit standard deviation, in place."""
    part = patches[seen]
    part -= part.mean(axis=1, keepdims=True)
    patches[seen] = part / (part.std(axis=1, keepdims=True) + 1e-6)


def _compute_slopes(cut: _Cut, chosen: Indices, grid: Array) -> Array:
    """Compute X and Y of the normals at the samples, (n, grid, 2)."""
    return cut.slope[chosen][:, None] + grid[None] @ np.swapaxes(cut.slope_by_patch[chosen], 1, 2)


def _measure_shading(cuts: Sequence[_Cut], patches: Image, seen: Mask, half: int) -> Shading:
    """Fit the shading to some samples of the patches of some points."""
    side = 2 * half + 1
    pick = np.arange(side * side).reshape(side, side)[1::3, 1::3].ravel()
    grid = _make_patch_grid(half)[pick]
    points = np.flatnonzero(seen.sum(axis=0) >= 3)
    points = points[:: max(1, len(points) // SHADING_POINTS)]
    slopes, greys, names = [], [], []
    for view, cut in enumerate(cuts):
        chosen = np.flatnonzero(np.isin(cut.points, points) & seen[view, cut.points])
        slopes.append(_compute_slopes(cut, chosen, grid))
        greys.append(patches[view][np.ix_(cut.points[chosen], pick)])
        names.append(cut.points[chosen])
    grey = np.concatenate(greys).astype(np.float64)
    return fit_shading(np.concatenate(slopes), grey, np.concatenate(names))


@dataclass(frozen=True, eq=False)
class _Matched:
    shift: Array
    covariance: Array
    correlation: Array


def _match_patches(patches: Image, seen: Mask, half: int, starmap: Starmap) -> _Matched:
    """Measure the shift of every patch (views, points) against the mean of the others, patch px."""
    parts = [slice(k, k + POINTS_AT_ONCE) for k in range(0, patches.shape[1], POINTS_AT_ONCE)]
    matched = list(starmap(match_points, ((patches[:, p], seen[:, p], half) for p in parts)))
    return _Matched(*(np.concatenate(arrays, axis=1) for arrays in zip(*matched, strict=True)))


def match_points(patches: Image, seen: Mask, half: int) -> tuple[Array, Array, Array]:
    """Shift, covariance and correlation of the patches of some points, as in :class:`_Matched`."""
    views, points, _size = patches.shape
    side = 2 * half + 1
    window = np.exp(-0.5 * np.sum(_make_patch_grid(half) ** 2, axis=1) / (WINDOW * half) ** 2)
    shift = np.zeros((views, points, 2))
    covariance = np.tile(np.eye(2), (views, points, 1, 1))
    correlation = np.zeros((views, points))
    for point in range(points):
        at = np.flatnonzero(seen[:, point])
        if len(at) < 3:
            continue
        stack = patches[at, point].astype(np.float64)
        template = _average_template(stack)
        others = (template[None] * len(at) - stack) / (len(at) - 1)
        image = template.reshape(side, side)
        slope_v, slope_u = np.gradient(image)
        slope = np.stack([slope_u.ravel(), slope_v.ravel()], axis=1)
        normal = (slope * window[:, None]).T @ slope
        if np.linalg.cond(normal) > 100.0:
            continue
        inverse = np.linalg.inv(normal)
        power = np.sum(window * others**2, axis=1)
        both = np.sum(window * others * stack, axis=1)
        gain = np.maximum(both / power, PATCH_GAIN_MIN)
        error = stack / gain[:, None] - others
        shift[at, point] = -(error * window) @ slope @ inverse
        fitted = error + shift[at, point] @ slope.T
        variance = np.sum(window * fitted**2, axis=1) / window.sum()
        covariance[at, point] = variance[:, None, None] * inverse
        power_seen = np.sum(window * stack**2, axis=1)
        correlation[at, point] = both / np.sqrt(power * power_seen)
    return shift, covariance, correlation


def _average_template(stack: Array) -> Array:
    """Average patches (views, size) without those that disagree with most others."""
    mean = stack.mean(axis=0)
    for _ in range(2):
        like = stack @ mean / (np.linalg.norm(stack, axis=1) * np.linalg.norm(mean) + 1e-12)
        good = like > 0.6 * np.median(like)
        mean = stack[good].mean(axis=0)
    return np.asarray(mean, dtype=np.float64)


def _collect_observations(
    frames: Sequence[TrackKeyframe],
    scan: ScanTiming | None,
    cuts: Sequence[_Cut],
    shift: Array,
    covariance: Array,
    good: Mask,
    floor_px: float,
) -> Observations:
    views, points, xy, root = [], [], [], []
    for view, (frame, cut) in enumerate(zip(frames, cuts, strict=True)):
        use = good[view, cut.points]
        index = cut.points[use]
        raw = cut.centres[use] + np.einsum("nij,nj->ni", cut.by_patch[use], shift[view, index])
        plane = project_to_plane_at_centre(frame, scan, raw)
        known = np.all(np.isfinite(plane), axis=1)
        ideal = frame.camera.project_ideal(
            np.column_stack([plane[known], np.zeros(np.count_nonzero(known))])
        )
        turned = cut.by_patch[use][known]
        spread = turned @ covariance[view, index[known]] @ np.swapaxes(turned, 1, 2)
        spread = spread + floor_px**2 * np.eye(2)
        views.append(np.full(len(ideal), view))
        points.append(index[known])
        xy.append(ideal)
        root.append(np.linalg.inv(np.linalg.cholesky(spread)))
    return Observations(
        np.concatenate(views), np.concatenate(points), np.concatenate(xy), np.concatenate(root)
    )
