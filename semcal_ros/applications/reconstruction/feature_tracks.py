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

"""Follow features through a recording, and keep the frames that add information as keyframes.

Every frame is tracked against the last keyframe (pyramidal Lucas-Kanade, checked backwards), so
errors do not add up from frame to frame. A frame becomes a keyframe when the points have moved
enough against each other (a common shift is drift and says nothing about depth), when too many
are lost, or when the magnification changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.reconstruction.appearance import (
    Appearance,
    convert_for_tracking,
    prepare_appearance,
)
from semcal_ros.applications.reconstruction.epipolar import fit_epipolar
from semcal_ros.applications.reconstruction.thresholds import FEATURES_MIN
from semcal_ros.core.arrays import Array, Indices, Mask, check_positive
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the feature tracker.

    Attributes
    ----------
    spacing_px
        Least distance between features, px.
    max_features
        Largest number of features per frame.
    window_px, levels
        Window and number of levels of the pyramid tracker.
    backwards_px
        Largest distance between a feature and its position after tracking forth and back.
    parallax_px
        Median movement relative to the common shift above which a frame is kept.
    lost_fraction
        Fraction of lost features above which a frame is kept.
    epipolar_px
        Largest distance from the epipolar geometry of two keyframes.
    noise_factor
        Least corner response of a feature, over what noise alone gives.
    smoothing_px
        Sigma of the smoothing before tracking: a fast scan has only some ten electrons per pixel.
    border_px
        Least distance of features from the border of the frame.
    room_px
        Only the area up to this distance from the features of the last frame is processed.
    """

    spacing_px: float = 5.0
    max_features: int = 1500
    window_px: int = 21
    levels: int = 3
    backwards_px: float = 0.7
    parallax_px: float = 1.0
    lost_fraction: float = 0.3
    epipolar_px: float = 2.0
    noise_factor: float = 3.0
    smoothing_px: float = 1.8
    border_px: int = 14
    room_px: int = 48

    def __post_init__(self) -> None:
        check_positive(self.spacing_px, "spacing_px =")


@dataclass(frozen=True, eq=False)
class TrackKeyframe:
    """A frame that takes part in the reconstruction.

    Attributes
    ----------
    index
        Number of the frame in the recording.
    time_s
        Start of its acquisition.
    image
        (h, w) grey levels; (0, 0) where the tracker does not keep them.
    camera
        Calibrated camera of its magnification and size.
    ids, xy
        (n,) numbers of the tracks, (n, 2) their positions, raw px.
    velocity
        (2, 3) velocity field of the specimen in the sem frame, ``v = velocity @ (X, Y, 1)`` in m/s
        with X, Y in m.
    """

    index: int
    time_s: float
    image: NDArray[Any]
    camera: ScanCamera
    ids: Indices
    xy: Array
    velocity: Array


def project_to_plane(camera: ScanCamera, raw: Array) -> Array:
    """Project raw pixels (n, 2) to sem-frame X, Y (n, 2) in m at height 0; NaN if impossible."""
    return camera.sem_from_ideal(camera.undistort(raw))[:, :2]


def _project_from_plane(camera: ScanCamera, xy_m: Array) -> Array:
    return camera.project(np.column_stack([xy_m, np.zeros(len(xy_m))]))


@dataclass(eq=False)
class _Reference:
    """The last keyframe while frames are tracked against it."""

    grey: NDArray[np.uint8]
    frame: TrackKeyframe
    latest_m: Array
    alive: Mask
    before: Array | None
    after: Array | None


class SequenceTracker:
    """Takes the frames of a recording one by one.

    Parameters
    ----------
    settings
        Settings of the tracker.
    keep_images
        Whether keyframes keep their images, which take memory in proportion to the recording.

    Attributes
    ----------
    keyframes
        Keyframes so far.
    frames
        Number of frames taken.
    """

    def __init__(
        self, settings: TrackerSettings | None = None, *, keep_images: bool = True
    ) -> None:
        self.settings = settings or TrackerSettings()
        self._keep_images = keep_images
        self.keyframes: list[TrackKeyframe] = []
        self.frames = 0
        self._next_id = 0
        self._reference: _Reference | None = None
        self._last_time_s = -np.inf

    def add(self, image: NDArray[Any], camera: ScanCamera, time_s: float) -> bool:
        """Track the next frame; return True if it became a keyframe.

        Raises
        ------
        InvalidValueError
            If the image is not grey, not of the camera's size, or not later than the last.
        """
        if image.shape != (camera.height, camera.width):
            raise InvalidValueError(
                f"an image of shape {image.shape}",
                expected=f"grey levels of shape {(camera.height, camera.width)}",
            )
        if not time_s > self._last_time_s:
            raise InvalidValueError(
                f"a frame at {time_s} s after one at {self._last_time_s} s",
                expected="frames in the order of their times",
            )
        seen = self._prepare_frame(image, camera)
        grey = convert_for_tracking(seen)
        index, self.frames = self.frames, self.frames + 1
        previous_s, self._last_time_s = self._last_time_s, time_s
        reference = self._reference
        if reference is None:
            ids, xy = self._detect(seen, np.empty((0, 2)))
            self._keep(index, time_s, image, camera, grey, ids, xy, None)
            return True
        start = reference.latest_m
        raw, found = self._track(reference, grey, camera)
        now_m = project_to_plane(camera, raw)
        found &= np.all(np.isfinite(now_m), axis=1)
        motion = _fit_affine_motion(start[found], now_m[found], time_s - previous_s)
        if reference.after is None and index == reference.frame.index + 1:
            reference.after = motion
        reference.alive = found
        # A lost feature moves with the others, in case it comes back.
        common = np.median((now_m - start)[found], axis=0) if found.any() else np.zeros(2)
        reference.latest_m = np.where(found[:, None], now_m, start + common)
        if not self._is_new(reference, found, now_m, camera):
            return False
        good = self._check_epipolar(reference, found, now_m, camera)
        kept_ids, kept = reference.frame.ids[good], raw[good]
        ids, xy = self._detect(seen, kept)
        self._keep(
            index,
            time_s,
            image,
            camera,
            grey,
            np.concatenate([kept_ids, ids]),
            np.concatenate([kept, xy]),
            motion,
        )
        return True

    def finish(self) -> list[TrackKeyframe]:
        """Return all keyframes, each with the movement during its acquisition."""
        self._finish_motions()
        return self.keyframes

    # -- tracking ---------------------------------------------------------------------------------

    def _prepare_frame(self, image: NDArray[Any], camera: ScanCamera) -> Appearance:
        """Prepare the image for tracking; zero far from the expected features, to save time."""
        box = self._expect_box(camera)
        seen = prepare_appearance(image[box], smoothing_px=self.settings.smoothing_px)
        if seen.smooth.shape == image.shape:
            return seen
        smooth, texture = np.zeros((2, *image.shape), dtype=np.float32)
        smooth[box], texture[box] = seen.smooth, seen.texture
        return Appearance(smooth, texture, seen.noise, seen.smoothing_px)

    def _expect_box(self, camera: ScanCamera) -> tuple[slice, slice]:
        """Return rows and columns around the last features, with room to move and for new ones."""
        reference = self._reference
        everything = (slice(0, camera.height), slice(0, camera.width))
        if reference is None or np.count_nonzero(reference.alive) < FEATURES_MIN:
            return everything
        raw = _project_from_plane(camera, reference.latest_m[reference.alive])
        return _make_box(raw, camera, self.settings.room_px)[0]

    def _track(
        self, reference: _Reference, grey: NDArray[np.uint8], camera: ScanCamera
    ) -> tuple[Array, Mask]:
        """Track the reference's features: raw positions (n, 2), and which were found."""
        if not len(reference.frame.xy):
            return np.empty((0, 2)), np.empty(0, dtype=bool)
        s = self.settings
        options: dict[str, Any] = {
            "winSize": (s.window_px, s.window_px),
            "maxLevel": s.levels,
            "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
            "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        }
        at = reference.frame.xy.astype(np.float32)
        guess = np.nan_to_num(_project_from_plane(camera, reference.latest_m)).astype(np.float32)
        # Pyramids only of the part of the image that contains the features.
        box, corner = _make_box(np.concatenate([at, guess]), camera, s.room_px)
        first, second = (
            np.ascontiguousarray(reference.grey[box]),
            np.ascontiguousarray(grey[box]),
        )
        at, guess = at - corner, guess - corner
        forward, ok, _ = cv2.calcOpticalFlowPyrLK(first, second, at, guess.copy(), **options)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(second, first, forward, at.copy(), **options)
        raw = forward.astype(np.float64) + corner
        found = (ok.ravel() == 1) & (ok_back.ravel() == 1)
        found &= np.linalg.norm(back - at, axis=1) < s.backwards_px
        found &= _find_inside(raw, camera, s.border_px)
        return raw, found

    def _is_new(self, reference: _Reference, found: Mask, now_m: Array, camera: ScanCamera) -> bool:
        total, number = len(found), int(np.count_nonzero(found))
        if camera.magnification != reference.frame.camera.magnification or not number:
            return True
        if number < (1.0 - self.settings.lost_fraction) * total:
            return True
        moved = (now_m - project_to_plane(reference.frame.camera, reference.frame.xy))[
            found
        ] * camera.m
        against = moved - np.median(moved, axis=0)
        return float(np.median(np.linalg.norm(against, axis=1))) > self.settings.parallax_px

    def _check_epipolar(
        self, reference: _Reference, found: Mask, now_m: Array, camera: ScanCamera
    ) -> Mask:
        """Select the found features that agree with the epipolar geometry of the two keyframes."""
        index = np.flatnonzero(found)
        if len(index) < 12:
            return found
        before_m = project_to_plane(reference.frame.camera, reference.frame.xy[index])
        tolerance_m = self.settings.epipolar_px / camera.m
        geometry = fit_epipolar(before_m, now_m[index], tolerance_m)
        good = np.zeros_like(found)
        good[index[geometry.inliers]] = True
        return good

    # -- features ---------------------------------------------------------------------------------

    def _detect(self, seen: Appearance, taken: Array) -> tuple[Indices, Array]:
        """Detect new features away from existing ones: their numbers and positions (raw px)."""
        s = self.settings
        response, from_noise = seen.corner_response()
        mask = np.zeros(response.shape, dtype=np.uint8)
        # Parts of the image that were not processed are zero; their edge is not a feature.
        unseen = cv2.dilate((seen.smooth == 0.0).astype(np.uint8), np.ones((15, 15), np.uint8))
        response = np.where(unseen > 0, 0.0, response)
        mask[s.border_px : -s.border_px, s.border_px : -s.border_px] = 255
        mask[response < s.noise_factor * from_noise] = 0
        for x, y in np.rint(taken).astype(int):
            cv2.circle(mask, (int(x), int(y)), round(s.spacing_px), 0, -1)
        room = s.max_features - len(taken)
        if room < 1 or not mask.any():
            return np.empty(0, dtype=np.intp), np.empty((0, 2))
        corners = cv2.goodFeaturesToTrack(
            seen.smooth, room, 1e-6, s.spacing_px, mask=mask, blockSize=7
        )
        xy = np.empty((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        ids = np.arange(self._next_id, self._next_id + len(xy), dtype=np.intp)
        self._next_id += len(xy)
        return ids, xy

    # -- keyframes --------------------------------------------------------------------------------

    def _keep(
        self,
        index: int,
        time_s: float,
        image: NDArray[Any],
        camera: ScanCamera,
        grey: NDArray[np.uint8],
        ids: Indices,
        xy: Array,
        motion: Array | None,
    ) -> None:
        self._finish_motions()
        kept = image.copy() if self._keep_images else np.zeros((0, 0), dtype=image.dtype)
        frame = TrackKeyframe(index, time_s, kept, camera, ids, xy, np.zeros((2, 3)))
        self.keyframes.append(frame)
        latest = project_to_plane(camera, xy)
        self._reference = _Reference(
            grey, frame, latest, np.ones(len(ids), dtype=bool), motion, None
        )

    def _finish_motions(self) -> None:
        """Set the velocity of the last keyframe: the mean of those before and after it."""
        reference = self._reference
        if reference is None:
            return
        known = [v for v in (reference.before, reference.after) if v is not None]
        if known:
            velocity = np.mean(known, axis=0)
            self.keyframes[-1] = replace(reference.frame, velocity=velocity)


def _make_box(
    raw: NDArray[Any], camera: ScanCamera, room: int
) -> tuple[tuple[slice, slice], NDArray[np.float32]]:
    """Return rows and columns around raw pixels, and the first corner (x, y)."""
    size = np.array([camera.width, camera.height])
    low = np.clip(np.nanmin(raw, axis=0) - room, 0, size - 1).astype(int)
    high = np.clip(np.nanmax(raw, axis=0) + room, low + 1, size).astype(int)
    return (slice(low[1], high[1]), slice(low[0], high[0])), low.astype(np.float32)


def _find_inside(raw: Array, camera: ScanCamera, border: int) -> Mask:
    size = np.array([camera.width, camera.height]) - 1.0 - border
    return np.asarray(np.all((raw > border) & (raw < size), axis=1))


def _fit_affine_motion(before_m: Array, after_m: Array, seconds: float) -> Array | None:
    """Fit a (2, 3) affine velocity field to points (n, 2), m/s; None if there are too few."""
    if len(before_m) < 6 or not np.isfinite(seconds):
        return None
    middle = 0.5 * (before_m + after_m)
    velocity = (after_m - before_m) / seconds
    centre, spread = middle.mean(axis=0), float(middle.std()) or 1.0
    design = np.column_stack([(middle - centre) / spread, np.ones(len(middle))])
    weight = np.ones(len(design))
    found: Array = np.zeros((3, 2))
    for _ in range(4):
        rows, right = design * weight[:, None], velocity * weight[:, None]
        found = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
        error = np.linalg.norm(velocity - design @ found, axis=1)
        limit = max(2.0 * float(np.median(error)), 1e-18)
        weight = np.sqrt(limit / np.maximum(error, limit))
    slope = found[:2].T / spread
    return np.column_stack([slope, found[2] - slope @ centre])
