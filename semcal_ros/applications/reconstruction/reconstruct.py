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

"""Reconstruct points, poses and normals, with their uncertainty, from keyframes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from semcal_ros.applications.reconstruction.adjustment import (
    AdjustedStructure,
    Observations,
    adjust,
)
from semcal_ros.applications.reconstruction.appearance import compute_log_grey
from semcal_ros.applications.reconstruction.factorization import (
    Tracks,
    factorize,
    mirror_structure,
    upgrade_to_metric,
)
from semcal_ros.applications.reconstruction.feature_tracks import TrackKeyframe
from semcal_ros.applications.reconstruction.patches import (
    PatchSettings,
    PosedSurface,
    Starmap,
    measure_patches,
    project_to_plane_at_centre,
)
from semcal_ros.applications.reconstruction.surface import compute_spacing_m, fit_local_surface
from semcal_ros.applications.reconstruction.thresholds import POINT_MISFIT_MAX, WINDOW
from semcal_ros.core.arrays import Array, Image, Indices, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import StructureError
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class StructureSettings:
    """Settings of the reconstruction.

    Attributes
    ----------
    patches
        Comparison of patches.
    most_passes
        Largest number of times that patches are measured and adjusted.
    converged_sigma
        The passes end when one moves the points along their normals by less than this many of their 1-sigma (RMS).
        Along the surface they may creep on: each pass puts a point where its texture is on average, and takes
        the texture anew from there.
    least_track
        Least number of keyframes in which a feature was followed.
    least_views
        Least number of observations of a point in the result.
    separation_px
        Points closer than this are merged.
    height_sigma_m
        1-sigma of the differences in height of the specimen between views, m.
    worst_sigma_px
        Largest 1-sigma of a point in any direction; worse points are left out.
    """

    patches: PatchSettings = field(default_factory=PatchSettings)
    most_passes: int = 10
    converged_sigma: float = 0.5
    least_track: int = 4
    least_views: int = 6
    separation_px: float = 4.0
    height_sigma_m: float = 5e-6
    worst_sigma_px: float = 1.0


@dataclass(frozen=True, eq=False)
class Structure:
    """The specimen in its own frame, whose axes are those of the sem frame in the reference view.

    Attributes
    ----------
    points_m, normals, curvature_1_m
        (points, 3) m, (points, 3) outward unit normals, (points,) mean curvature 1/m.
    adjustment
        Poses, uncertainty, residuals.
    observations
        Observations that were adjusted.
    frames
        (views,) numbers of the frames in the recording.
    cameras
        Camera of every view.
    tracked
        Number of features that were followed long enough.
    unplaced
        Keyframes that could not be linked to the others.
    relief_condition
        Condition of the metric upgrade, see :class:`.MetricUpgrade`.
    relief_sigma
        Relative 1-sigma of a stretch of depth in the reference view: the remaining bas-relief
        ambiguity.
    convexity
        Fraction of the points about which the surface bulges towards the gun. It decides between
        the two mirror images: an opaque surface is seen from outside.
    mirror_sigma
        By how many sigma the perspective of the camera prefers this structure to its mirror image;
        near 0 it cannot decide, and negative values speak against the choice.
    patch_sigma_m
        Sigma of the window in which a patch is compared, m: closer points share pixels and noise.
    passes, converged
        Number of passes, and whether the last one moved the points along their normals by less than
        ``converged_sigma``.
    """

    points_m: Array
    normals: Array
    curvature_1_m: Array
    adjustment: AdjustedStructure
    observations: Observations
    frames: Indices
    cameras: tuple[ScanCamera, ...]
    tracked: int
    unplaced: int
    relief_condition: float
    relief_sigma: float
    convexity: float
    mirror_sigma: float
    patch_sigma_m: float
    passes: int
    converged: bool

    @property
    def normal_sigma_m(self) -> Array:
        """(points,) 1-sigma along the normal, m."""
        variance = np.einsum(
            "pi,pij,pj->p", self.normals, self.adjustment.point_covariance_m2, self.normals
        )
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float64)


def reconstruct(
    keyframes: Sequence[TrackKeyframe],
    scan: ScanTiming | None = None,
    settings: StructureSettings | None = None,
    *,
    on_step: Callable[[str], object] = lambda _: None,
    starmap: Starmap = itertools.starmap,
) -> Structure:
    """Reconstruct points and poses from the keyframes of a :class:`.SequenceTracker`.

    Parameters
    ----------
    keyframes
        At least three, of a specimen that turns.
    scan
        Raster timing; without it, movement during a frame is not corrected.
    settings
        Settings of the reconstruction.
    on_step
        Called with the name of every step.
    starmap
        As :func:`itertools.starmap`, for the comparison of patches; another one may share the work
        with other processes.

    Raises
    ------
    StructureError
        If the views cannot be linked or show no depth.
    """
    chosen = settings or StructureSettings()
    on_step("factorizing")
    tracks = collect_tracks(keyframes, scan, chosen.least_track)
    affine = factorize(tracks)
    metric = upgrade_to_metric(affine)
    views = np.flatnonzero(affine.views_placed)
    points = np.flatnonzero(affine.points_placed)
    placed = Tracks(
        tracks.xy_m[np.ix_(views, points)].copy(), tracks.seen[np.ix_(views, points)].copy()
    )
    cameras = tuple(keyframes[int(v)].camera for v in views)
    work = _Refinement(
        [keyframes[int(v)] for v in views],
        cameras,
        scan,
        chosen,
        metric.rotations[views],
        metric.translations_m[views],
        metric.points_m[points],
        Observations.from_tracks(placed, cameras, 0.3),
        starmap,
    )
    on_step("adjusting")
    work.adjust_tracks()
    work.log_greys = [compute_log_grey(frame.image) for frame in work.keyframes]
    while not work.converged and work.passes < chosen.most_passes:
        on_step(f"measuring, pass {work.passes + 1}")
        work.refine()
    on_step("uncertainty")
    return work.structure(len(keyframes), tracks.seen.shape[1], metric.condition)


def collect_tracks(
    keyframes: Sequence[TrackKeyframe], scan: ScanTiming | None, least: int = 3
) -> Tracks:
    """Collect the tracks seen in at least ``least`` keyframes, in the plane of the specimen."""
    if len(keyframes) < 3:
        raise StructureError(
            counted(len(keyframes), "keyframe"),
            expected="at least 3 of a ball that turns: the specimen hardly turns",
            do="record it while it turns by 10 degrees and more; for two or three images at known tilts, give --tilts",
        )
    ids = np.concatenate([frame.ids for frame in keyframes])
    names, counts = np.unique(ids, return_counts=True)
    names = names[counts >= least]
    xy = np.zeros((len(keyframes), len(names), 2))
    seen = np.zeros((len(keyframes), len(names)), dtype=bool)
    for view, frame in enumerate(keyframes):
        known = np.isin(frame.ids, names)
        plane = project_to_plane_at_centre(frame, scan, frame.xy[known])
        finite = np.all(np.isfinite(plane), axis=1)
        column = np.searchsorted(names, frame.ids[known][finite])
        xy[view, column], seen[view, column] = plane[finite], True
    return Tracks(xy, seen)


def mirror_poses(
    rotations: Array, translations_m: Array, points_m: Array
) -> tuple[Array, Array, Array]:
    """Return the mirror structure, which parallel projection cannot tell from the given one."""
    turned, points = mirror_structure(rotations, points_m)
    return turned, translations_m * np.array([1.0, 1.0, -1.0]), points


class _Refinement:
    """The structure during refinement; views and points that fail are dropped on the way."""

    def __init__(
        self,
        keyframes: list[TrackKeyframe],
        cameras: tuple[ScanCamera, ...],
        scan: ScanTiming | None,
        settings: StructureSettings,
        rotations: Array,
        translations: Array,
        points: Array,
        observations: Observations,
        starmap: Starmap,
    ) -> None:
        self.starmap = starmap
        self.keyframes, self.cameras, self.scan = keyframes, cameras, scan
        self.settings = settings
        self.rotations, self.translations, self.points = rotations, translations, points
        self.seen = observations
        self.log_greys: list[Image] = []
        self.adjusted: AdjustedStructure | None = None
        self.ids = np.arange(len(points))
        self.passes, self.converged = 0, False
        self.pixel_m = float(np.mean([np.mean(camera.pixel_size_m) for camera in cameras]))

    def adjust_tracks(self) -> None:
        """Adjust the tracks, drop what does not fit, choose between the mirror images."""
        self._prune(self.settings.least_track)
        for _ in range(2):
            self._adjust()
            assert self.adjusted is not None
            self.seen = self.seen.select(self.adjusted.weights > 0.3)
            self._prune(self.settings.least_track, worst_px=4.0 * self.settings.worst_sigma_px)
        self._merge()
        _normals, curvature = self._surface(wide=True)
        if np.count_nonzero(curvature > 0.0) < 0.5 * len(curvature):
            self.rotations, self.translations, self.points = mirror_poses(
                self.rotations, self.translations, self.points
            )

    def refine(self) -> None:
        """Measure all patches against their templates, and adjust."""
        ids, before = self.ids, self.points
        normals, curvature = self._surface()
        posed = PosedSurface(self.rotations, self.translations, self.points, normals, curvature)
        self.seen = measure_patches(
            self.keyframes, self.log_greys, self.scan, posed, self.settings.patches, self.starmap
        )
        self._prune(self.settings.least_views)
        adjusted = self.ids
        self._adjust()
        assert self.adjusted is not None
        rigid = self._find_rigid_points()
        self.seen = self.seen.select((self.adjusted.weights > 0.25) & rigid[self.seen.point])
        self._prune(self.settings.least_views, worst_px=self.settings.worst_sigma_px)
        self.passes += 1
        kept = np.isin(ids, self.ids)
        covariance = self.adjusted.point_covariance_m2[np.isin(adjusted, self.ids)]
        change = self._measure_change_in_sigma(before[kept], normals[kept], covariance)
        self.converged = change < self.settings.converged_sigma

    def _find_rigid_points(self) -> Mask:
        """Find the points that move with the others.

        An outline, of the tip that holds a ball for example, moves over the surface as this turns. Each of
        its observations is near enough to be trusted in part, so all of them together bend the poses.
        """
        done = self.adjusted
        assert done is not None
        white = np.einsum("nij,nj->ni", self.seen.root, done.residuals)
        count = np.bincount(self.seen.point, minlength=len(self.points))
        square = np.bincount(self.seen.point, np.sum(white**2, axis=1), len(self.points))
        mean = square / np.maximum(count, 1)
        usual = np.median(mean[count > 0])
        return np.asarray(mean <= POINT_MISFIT_MAX * usual, dtype=bool)

    def _measure_change_in_sigma(self, before: Array, normals: Array, covariance: Array) -> float:
        """Return the RMS change along the normals over the RMS 1-sigma there, after a rigid alignment."""
        old, new = before - before.mean(axis=0), self.points - self.points.mean(axis=0)
        turn, _ = Rotation.align_vectors(old, new)
        change = np.sum(normals * (turn.apply(new) - old), axis=1)
        variance = np.einsum("pi,pij,pj->p", normals, covariance, normals)
        return float(np.sqrt(np.mean(change**2) / np.mean(variance)))

    def _adjust(self, tolerance: float = 1e-4) -> None:
        self.adjusted = adjust(
            self.seen,
            self.cameras,
            self.rotations,
            self.translations,
            self.points,
            reference=len(self.cameras) // 2,
            height_sigma_m=self.settings.height_sigma_m,
            tolerance=tolerance,
        )
        done = self.adjusted
        self.rotations, self.translations = done.rotations, done.translations_m
        self.points = done.points_m

    def _prune(self, least: int, worst_px: float | None = None) -> None:
        """Drop points that are uncertain or seen in few views, and views that see few points."""
        certain = np.ones(len(self.points), dtype=bool)
        if worst_px is not None and self.adjusted is not None:
            largest = np.linalg.eigvalsh(self.adjusted.point_covariance_m2)[:, -1]
            certain = np.sqrt(largest) < worst_px * self.pixel_m
        views = np.ones(len(self.cameras), dtype=bool)
        for _ in range(20):
            use = certain[self.seen.point] & views[self.seen.view]
            counts = np.bincount(self.seen.point[use], minlength=len(self.points))
            per_view = np.bincount(
                self.seen.view[use & (counts >= least)[self.seen.point]],
                minlength=len(self.cameras),
            )
            better = certain & (counts >= least), views & (per_view >= 8)
            if np.array_equal(better[0], certain) and np.array_equal(better[1], views):
                break
            certain, views = better
        self._keep(certain, views)

    def _keep(self, points: Mask, views: Mask) -> None:
        if np.count_nonzero(points) < 12 or np.count_nonzero(views) < 3:
            raise StructureError(
                f"{counted(np.count_nonzero(points), 'point')} in {counted(np.count_nonzero(views), 'view')} "
                "that agree",
                expected="at least 12 points in 3 views",
                do="record more texture, slower movements or larger turns",
            )
        use = points[self.seen.point] & views[self.seen.view]
        new_point, new_view = np.cumsum(points) - 1, np.cumsum(views) - 1
        seen = self.seen.select(use)
        self.seen = replace(seen, view=new_view[seen.view], point=new_point[seen.point])
        self.points, self.ids = self.points[points], self.ids[points]
        self.rotations, self.translations = self.rotations[views], self.translations[views]
        kept = np.flatnonzero(views)
        self.keyframes = [self.keyframes[int(v)] for v in kept]
        self.cameras = tuple(self.cameras[int(v)] for v in kept)
        self.log_greys = [self.log_greys[int(v)] for v in kept] if self.log_greys else []

    def _merge(self) -> None:
        """Among points too close for patches to tell apart, keep the one seen most."""
        counts = np.bincount(self.seen.point, minlength=len(self.points))
        near = cKDTree(self.points).query_ball_point(
            self.points, self.settings.separation_px * self.pixel_m
        )
        keep = np.ones(len(self.points), dtype=bool)
        for point in np.argsort(-counts, kind="stable"):
            if keep[point]:
                others = [p for p in near[point] if p != point]
                keep[others] = False
        self._keep(keep, np.ones(len(self.cameras), dtype=bool))

    def _surface(self, *, wide: bool = False) -> tuple[Array, Array]:
        """Compute the normals, oriented towards the gun, and the mean curvature."""
        spread = float(np.sqrt(np.mean(np.var(self.points, axis=0))))
        radius = 0.5 * spread if wide else max(3.0 * compute_spacing_m(self.points), 0.2 * spread)
        surface = fit_local_surface(self.points, self.points, radius, steps=1)
        towards = np.zeros((len(self.points), 3))
        np.add.at(towards, self.seen.point, -self.rotations[self.seen.view, 2])
        surface = surface.orient(towards)
        return surface.normals, surface.curvature_1_m

    def structure(self, keyframes: int, tracked: int, condition: float) -> Structure:
        self._adjust(1e-7)
        done = self.adjusted
        assert done is not None
        normals, curvature = self._surface()
        depth = done.points_m @ done.rotations[done.reference][2]
        depth = depth - depth.mean()
        gradient = np.outer(depth / np.sum(depth**2), done.rotations[done.reference][2])
        other = adjust(
            self.seen,
            self.cameras,
            *mirror_poses(done.rotations, done.translations_m, done.points_m),
            reference=done.reference,
            height_sigma_m=self.settings.height_sigma_m,
            max_iterations=8,
        )
        # Each cost is half a squared sigma on its own scale; compare both on one scale.
        preference = other.cost * other.sigma**2 / done.sigma**2 - done.cost
        _, bulge = self._surface(wide=True)
        return Structure(
            points_m=done.points_m,
            normals=normals,
            curvature_1_m=curvature,
            adjustment=done,
            observations=self.seen,
            frames=np.array([frame.index for frame in self.keyframes]),
            cameras=self.cameras,
            tracked=tracked,
            unplaced=keyframes - len(self.cameras),
            relief_condition=condition,
            relief_sigma=float(np.sqrt(done.propagate_variance(gradient))),
            convexity=float(np.mean(bulge > 0.0)),
            mirror_sigma=float(np.sign(preference) * np.sqrt(2.0 * abs(preference))),
            patch_sigma_m=WINDOW * self.settings.patches.half_px * self.pixel_m,
            passes=self.passes,
            converged=self.converged,
        )
