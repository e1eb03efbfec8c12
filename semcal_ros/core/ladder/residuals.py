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

"""What is made small in a ladder: the distance between where a place is seen and where it should be.

A place that picture i shows at the raw pixel u_i is found on the specimen, which is a plane, and projected into
picture j; the residual is the pixel u_j at which it was found there minus that. Derivatives go through the analytic
Jacobians of the camera, the place on the specimen as an implicit function: dx = -(du_i/dx)^-1 du_i/dq.

The time at which picture j shows the place is that of the pixel where it is predicted. At the pixel where it was found,
which has noise, a drift along the frame would explain a part of that noise, and the likelihood would prefer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.camera.projection import (
    ProjectionJacobians,
    project_points,
    project_points_with_jacobians,
)
from semcal_ros.core.camera.residual_field import FieldSlice
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import Raster
from semcal_ros.core.ladder.thresholds import POSE_SIZE, TIME_STEPS
from semcal_ros.core.ladder.unknowns import LadderSetup, LadderState


@dataclass(frozen=True, eq=False)
class Link:
    """Correspondences between two pictures, prepared for the adjustment.

    Attributes
    ----------
    first, second
        Numbers of the pictures.
    first_xy, second_xy
        (n, 2) raw pixels without the residual field.
    first_time, second_time
        (n,) times of these pixels, from -1/2 to 1/2 of their frames.
    time_slope
        (2,) change of the time along x and y of the second picture, per px.
    weight
        (n, 2, 2) matrices with which residuals have the variance one.
    share
        Part of what these tell that no other link tells: pictures that are in several links bring their noise to all.
    """

    first: int
    second: int
    first_xy: Array
    second_xy: Array
    first_time: Array
    second_time: Array
    time_slope: Array
    weight: Array
    share: float = 1.0

    def __len__(self) -> int:
        return len(self.first_xy)


@dataclass(frozen=True, eq=False)
class PairRows:
    """Residuals of a link, over their sigmas, and their derivatives.

    Attributes
    ----------
    values
        (2 n,) observed minus predicted.
    columns
        (L,) unknowns on which they depend.
    jacobian
        (2 n, L) derivatives of the prediction by these.
    """

    values: Array
    columns: Indices
    jacobian: Array


def make_link(
    setup: LadderSetup,
    numbers: tuple[int, int],
    first_xy: Array,
    second_xy: Array,
    covariance: Array,
    time_of: Sequence[Array],
) -> Link:
    """Prepare correspondences; ``covariance`` (n, 2, 2) is that of the pixels of the second picture."""
    points = []
    for number, xy in zip(numbers, (first_xy, second_xy), strict=True):
        field = field_of(setup, setup.pictures[number].magnification)
        if field is not None:
            raster = Raster.of(*setup.image_size)
            q = (xy - np.array(raster.middle_px)) / raster.norm_px
            xy = xy + raster.norm_px * field.displacement(q)
        points.append(xy)
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    # Times are linear in the pixels.
    offset = points[1] - points[1].mean(axis=0)
    slope = np.linalg.lstsq(offset, time_of[1] - time_of[1].mean(), rcond=None)[0]
    weight = np.swapaxes(root, 1, 2).copy()
    return Link(*numbers, points[0], points[1], time_of[0], time_of[1], slope, weight)


def field_of(setup: LadderSetup, magnification: float) -> FieldSlice | None:
    """The residual field of the calibration, as it stands."""
    return setup.model.at(magnification).residual if setup.model.residual is not None else None


def camera_of(state: LadderState, picture: int) -> ScanCamera:
    """The camera of a picture, with the scale of its visit and without a residual field."""
    setup = state.setup
    width, height = setup.image_size
    values = dict(zip(setup.names, state.parameters[picture].tolist(), strict=True))
    return ScanCamera(
        magnification=setup.pictures[picture].magnification,
        **values,
        norm_px=0.5 * width,
        width=width,
        height=height,
    )


def _turn(angle: float) -> tuple[Array, Array]:
    """A rotation from x to y, and its derivative by the angle."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])


@dataclass(frozen=True, eq=False)
class _Seen:
    """Pixels of places, with derivatives by the sem frame, the place, the parameters of the camera, pose, slope and
    drift.
    """

    xy: Array
    by_flat: Array
    by_place: Array
    by_camera: Array
    by_pose: Array
    by_slope: Array
    by_drift: Array


def _see(state: LadderState, picture: int, places: Array, time: Array) -> _Seen:
    setup, pose, slope = state.setup, state.poses[picture], state.slope
    pixel = setup.pixel_m(setup.pictures[picture].magnification)
    turn, turned = _turn(float(pose[0]))
    seen: ProjectionJacobians = project_points_with_jacobians(
        state.parameters[picture],
        _in_sem_frame(state, picture, places, time),
        Raster.of(*setup.image_size),
    )
    by_flat, by_height = seen.d_xyz[:, :, :2], seen.d_xyz[:, :, 2]
    by_place = by_flat @ turn + by_height[:, :, None] * slope
    by_pose = np.empty((len(places), 2, POSE_SIZE))
    moved = places + pixel * time[:, None] * state.drifts[picture]
    by_pose[:, :, 0] = np.einsum("nij,nj->ni", by_flat, moved @ turned.T)
    by_pose[:, :, 1:3] = pixel * by_flat
    by_pose[:, :, 3:5] = pixel * time[:, None, None] * by_flat
    by_slope = by_height[:, :, None] * places[:, None, :]
    by_drift = pixel * time[:, None, None] * (by_flat @ turn)
    return _Seen(seen.xy, by_flat, by_place, seen.d_parameters, by_pose, by_slope, by_drift)


def _in_sem_frame(state: LadderState, picture: int, places: Array, time: Array) -> Array:
    pose = state.poses[picture]
    pixel = state.setup.pixel_m(state.setup.pictures[picture].magnification)
    turn, _ = _turn(float(pose[0]))
    moved = places + pixel * time[:, None] * state.drifts[picture]
    flat = moved @ turn.T + pixel * (pose[1:3] + time[:, None] * pose[3:5])
    return np.column_stack([flat, places @ state.slope])


def place_on_specimen(state: LadderState, picture: int, xy: Array, time: Array) -> Array:
    """Places (n, 2) on the specimen, m, of raw pixels (n, 2) without the residual field at their times (n,)."""
    camera, pose = camera_of(state, picture), state.poses[picture]
    pixel = state.setup.pixel_m(state.setup.pictures[picture].magnification)
    turn, _ = _turn(float(pose[0]))
    flat = camera.sem_from_ideal(camera.undistort(xy))[:, :2]
    places = (flat - pixel * (pose[1:3] + time[:, None] * pose[3:5])) @ turn
    places = places - pixel * time[:, None] * state.drifts[picture]
    if np.any(state.slope):
        # A point of height z is 1 + rho z times as far from the axis: z = slope . (place + rho z turn' flat).
        from_axis = flat @ turn
        height = places @ state.slope / (1.0 - camera.rho * (from_axis @ state.slope))
        places = places + camera.rho * height[:, None] * from_axis
    return np.asarray(places)


def pair_values(state: LadderState, link: Link) -> Array:
    """(2 n,) residuals of a link over their sigmas, observed minus predicted."""
    places = place_on_specimen(state, link.first, link.first_xy, link.first_time)
    seen, _ = _predict(state, link, places)
    return np.einsum("nij,nj->ni", link.weight, link.second_xy - seen).reshape(-1)


def _predict(state: LadderState, link: Link, places: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) of the second picture where places are seen, and their times (n,)."""
    parameters, raster = state.parameters[link.second], Raster.of(*state.setup.image_size)
    pose, time = state.poses[link.second], link.second_time
    turn, _ = _turn(float(pose[0]))
    # How much later a pixel is where the drift carries it in a frame, in pixels of the nominal size.
    later = float((turn @ state.drifts[link.second] + pose[3:5]) @ link.time_slope)
    for _ in range(TIME_STEPS):
        xyz = _in_sem_frame(state, link.second, places, time)
        seen = project_points(parameters, xyz, raster)
        reached = link.second_time + (seen - link.second_xy) @ link.time_slope
        before, time = time, time + (reached - time) / (1.0 - later)
    return seen, before


def _follow_time(state: LadderState, link: Link, seen: _Seen) -> _Seen:
    """The same with derivatives that contain that of the time by the pixel: (I - du/dX drift dtau/du) du = ..."""
    setup, number = state.setup, link.second
    turn, _ = _turn(float(state.poses[number, 0]))
    pixel = setup.pixel_m(setup.pictures[number].magnification)
    drift = pixel * (turn @ state.drifts[number] + state.poses[number, 3:5])
    moved = np.einsum("nij,j->ni", seen.by_flat, drift)
    by = np.linalg.inv(np.eye(2) - moved[:, :, None] * link.time_slope)
    parts = (
        seen.by_flat,
        seen.by_place,
        seen.by_camera,
        seen.by_pose,
        seen.by_slope,
        seen.by_drift,
    )
    return _Seen(seen.xy, *(by @ part for part in parts))


def pair_rows(state: LadderState, link: Link) -> PairRows:
    """Residuals of a link and their derivatives."""
    setup, first, second = state.setup, link.first, link.second
    places = place_on_specimen(state, first, link.first_xy, link.first_time)
    here = _see(state, first, places, link.first_time)
    _, time = _predict(state, link, places)
    there = _follow_time(state, link, _see(state, second, places, time))
    # By the place in the first picture: how the second pixel follows a change of the first one.
    follow = -there.by_place @ np.linalg.inv(here.by_place)
    functions = setup.theta_columns
    count = len(link)
    blocks: list[tuple[Indices, Array]] = []
    total = np.zeros((count, 2, functions.shape[1]))
    visits: dict[int, tuple[Array, Array]] = {}
    nothing = np.zeros((count, 2))
    crept = np.zeros((count, 2, 1))
    for number, seen in ((first, here), (second, there)):
        by_camera, by_pose, by_drift = seen.by_camera, seen.by_pose, seen.by_drift
        if number == first:
            by_camera, by_pose, by_drift = (
                follow @ part for part in (by_camera, by_pose, by_drift)
            )
        scale = 1.0 + state.visit_scales[number]
        design = setup.design(setup.pictures[number].magnification) @ functions
        design[0] *= scale
        total += by_camera @ design
        visit = int(setup.visit_of[number])
        by_scale = by_camera[:, :, 0] * (state.parameters[number, 0] / scale)
        crept[:, :, 0] += setup.order[number] * by_scale
        before = visits.get(visit, (nothing, np.zeros((count, 2, 2))))
        visits[visit] = before[0] + by_scale, before[1] + by_drift
        start = setup.bounds[5].start + POSE_SIZE * number
        blocks.append((np.arange(start, start + POSE_SIZE), by_pose))
    slopes = setup.bounds[4]
    blocks.append((np.arange(slopes.start, slopes.stop), there.by_slope + follow @ here.by_slope))
    for visit, (by_scale, by_drift) in visits.items():
        blocks.append((np.array([setup.bounds[3].start + visit]), by_scale[:, :, None]))
        start = setup.bounds[6].start + 2 * visit
        blocks.append((np.arange(start, start + 2), by_drift))
    blocks.append((np.arange(setup.bounds[7].start, setup.bounds[7].stop), crept))
    columns = np.concatenate([np.arange(functions.shape[1]), *(part for part, _ in blocks)])
    jacobian = np.concatenate([total, *(values for _, values in blocks)], axis=2)
    residual = link.second_xy - there.xy
    weighted = np.einsum("nij,nj->ni", link.weight, residual)
    return PairRows(
        weighted.reshape(-1), columns, (link.weight @ jacobian).reshape(2 * count, len(columns))
    )
