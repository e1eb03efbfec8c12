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

"""Poses that a specimen stage sets: its readings, how they constrain a view, and what its moves show of the pixels.

The stage tilts about one axis that lies in the image plane, and turns the specimen about its own
normal before the tilt (a rotation on top of the tilt, as in every eucentric SEM stage). With the
direction ``alpha`` of the axis, the tilt ``t``, the rotation ``r`` and the scan rotation ``s``, the
specimen's orientation in the sem frame is

    R = Rz(s) Rz(alpha) Rx(t) Rz(-alpha) Rz(r) W

``W`` is a small wedge between the specimen and the stage. The plane of the specimen keeps its
distance from the axis. With the axis at the lateral distance ``u`` from the beam and ``z0`` below
the untilted specimen, a plane of slope ``grad z`` crosses the beam at

    h = z0 (1 - 1 / n_z) - u . grad z,    grad z = -(n_x, n_y) / n_z

where ``n`` is the normal of the plane; both terms vanish without a tilt.

A specimen that is moved by d (m) is seen to move by ``s = M d`` in rectified pixels. Where stage and image axes lie to
each other is not known, so M is a rotation or reflection over the pixel size; ``M M'`` is the unit matrix over the
square of the pixel size, whatever that rotation is. A drift at constant velocity is estimated beside M.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.thresholds import FRAMES_MIN, ONE_LINE_RATIO, ONE_SIGMA
from semcal_ros.core.camera.plane_geometry import cross_products, rotations_from_vectors
from semcal_ros.core.errors import InvalidValueError

OFFSET_NAMES: tuple[str, ...] = (
    "stage_tilt",
    "stage_axis",
    "stage_rotation",
    "stage_wedge_x",
    "stage_wedge_y",
)
"""Constant errors of a stage, rad: what is added to its tilt, to the direction of its axis and to
its rotation, and the two angles of the wedge."""


@dataclass(frozen=True)
class StageReading:
    """What the stage said about one view; None where it does not say.

    Attributes
    ----------
    tilt_rad, rotation_rad, scan_rotation_rad
        See the module.
    x_m, y_m
        Position of the specimen on the stage.
    """

    tilt_rad: float | None = None
    rotation_rad: float | None = None
    scan_rotation_rad: float | None = None
    x_m: float | None = None
    y_m: float | None = None

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is not None and not np.isfinite(value):
                expected = "a finite angle, rad" if item.name.endswith("_rad") else "finite m"
                raise InvalidValueError(f"{item.name} {value}", expected=expected)


@dataclass(frozen=True)
class StageAxis:
    """The stage of a microscope, and how far its readings are trusted.

    Attributes
    ----------
    tilt_axis_rad
        Direction of the tilt axis in the image without scan rotation, from +x towards +y.
    tilt_sigma_rad, rotation_sigma_rad
        1-sigma of the readings, without their constant offsets.
    """

    tilt_axis_rad: float = 0.0
    tilt_sigma_rad: float = 0.0035
    rotation_sigma_rad: float = 0.0087


@dataclass(frozen=True)
class Attitudes:
    """Orientations that V views are presumed to have.

    Attributes
    ----------
    tilt_rad, rotation_rad, scan_rotation_rad
        (V,) readings, zero where there is none.
    axis_rad
        Direction of the tilt axis.
    sigma_rad
        (V, 3) 1-sigma about the tilt axis, across it in the specimen's plane, and about the
        specimen's normal; infinite where nothing is known.
    """

    tilt_rad: Array
    rotation_rad: Array
    scan_rotation_rad: Array
    axis_rad: float
    sigma_rad: Array

    @property
    def say_anything(self) -> bool:
        """Whether an orientation or a scan rotation of any view is known."""
        return bool(np.any(np.isfinite(self.sigma_rad)) or np.any(self.scan_rotation_rad))

    def chosen(self, keep: Mask) -> Attitudes:
        """Return those of some of the views."""
        return Attitudes(
            self.tilt_rad[keep],
            self.rotation_rad[keep],
            self.scan_rotation_rad[keep],
            self.axis_rad,
            self.sigma_rad[keep],
        )


def attitudes(
    readings: list[StageReading | None],
    untilted: list[bool],
    axis: StageAxis,
    untilted_sigma_rad: float,
) -> Attitudes:
    """Collect what is known about the orientations of views.

    Parameters
    ----------
    readings
        One for each view, or None.
    untilted
        Whether each view without a reading of its tilt is known not to be tilted.
    axis
        The stage.
    untilted_sigma_rad
        1-sigma of the tilt of such a view, in both directions.
    """
    count = len(readings)
    values, sigma = np.zeros((3, count)), np.full((count, 3), np.inf)
    for v, (reading, flat) in enumerate(zip(readings, untilted, strict=True)):
        if reading is not None and reading.scan_rotation_rad is not None:
            values[2, v] = reading.scan_rotation_rad
        if reading is not None and reading.tilt_rad is not None:
            values[0, v] = reading.tilt_rad
            sigma[v, :2] = axis.tilt_sigma_rad
            if reading.rotation_rad is not None:
                values[1, v] = reading.rotation_rad
                sigma[v, 2] = axis.rotation_sigma_rad
        elif flat:
            sigma[v, :2] = untilted_sigma_rad
    return Attitudes(values[0], values[1], values[2], axis.tilt_axis_rad, sigma)


def _about_beam(angles_rad: Array) -> Array:
    """Return the (V, 3, 3) rotations about z, from x towards y."""
    out = np.zeros((len(angles_rad), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(angles_rad)
    out[:, 1, 0] = np.sin(angles_rad)
    out[:, 0, 1] = -out[:, 1, 0]
    out[:, 2, 2] = 1.0
    return out


def stage_rotations(known: Attitudes, offsets: Array) -> tuple[Array, Array]:
    """Return the (V, 3, 3) orientations for ``offsets`` (5,), and their (V, 3, 5) derivative.

    The derivative is that of the rotation vector in the sem frame, by ``OFFSET_NAMES``.
    """
    count = len(known.tilt_rad)
    scan = _about_beam(known.scan_rotation_rad)
    direction = known.axis_rad + offsets[1]
    axis = np.array([np.cos(direction), np.sin(direction), 0.0])
    lean = scan @ rotations_from_vectors((known.tilt_rad + offsets[0])[:, None] * axis)
    wedge = rotations_from_vectors(np.array([[offsets[3], offsets[4], 0.0]]))[0]
    turned = lean @ _about_beam(known.rotation_rad + offsets[2])
    beam = np.array([0.0, 0.0, 1.0])
    derivative = np.empty((count, 3, 5))
    derivative[:, :, 0] = scan @ axis
    derivative[:, :, 1] = beam - lean @ beam
    derivative[:, :, 2] = lean @ beam
    derivative[:, :, 3:] = turned[:, :, :2]
    return turned @ wedge, derivative


def _turn_between_normals(expected: Array, rotations: Array) -> Array:
    """Return the (V, 3) smallest rotation vectors between the normals of orientations."""
    ours, theirs = rotations[:, :, 2], expected[:, :, 2]
    across = cross_products(theirs, ours)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.sum(ours * theirs, axis=1))
    return across * (angle / np.maximum(sine, 1e-300))[:, None]


def attitude_residuals(
    known: Attitudes, offsets: Array, rotations: Array
) -> tuple[Array, Array, Array]:
    """Compare orientations (V, 3, 3) with those that are presumed.

    Returns
    -------
    residuals
        (V, 3) rotation that is left, in sigmas; zero where nothing is known.
    by_turn
        (V, 3, 3) derivative of minus the residuals by a small turn of the views in the sem frame.
    by_offset
        (V, 3, 5) derivative of minus the residuals by the offsets.
    """
    expected, derivative = stage_rotations(known, offsets)
    direction = known.axis_rad + offsets[1] + known.scan_rotation_rad
    along = np.stack([np.cos(direction), np.sin(direction), np.zeros_like(direction)], axis=1)
    normal = expected[:, :, 2]
    frame = np.stack([along, cross_products(normal, along), normal], axis=1)
    # Without a rotation there is no telling which way the grid lies: its turn is not compared.
    told = np.isfinite(known.sigma_rad[:, 2])
    left = _turn_between_normals(expected, rotations)
    if np.any(told):
        turn = rotations[told] @ np.swapaxes(expected[told], 1, 2)
        left[told] = Rotation.from_matrix(turn).as_rotvec()
    weighted = frame / known.sigma_rad[:, :, None]
    return -np.einsum("vij,vj->vi", weighted, left), weighted, -weighted @ derivative


def height_of_tilt(
    known_scan_rad: Array, rotations: Array, translations_m: Array, miss_m: Array
) -> tuple[Array, Array, Array]:
    """Compare the heights of planes on the beam with those that their tilts cause.

    Parameters
    ----------
    known_scan_rad
        (V,) scan rotation of each view.
    rotations, translations_m
        (V, 3, 3) and (V, 3) poses.
    miss_m
        (3,) where the axis lies: its lateral distance (x, y) from the beam, without scan rotation,
        and how far below the untilted specimen.

    Returns
    -------
    height_m
        (V,) height of each plane on the beam, without what the tilt causes.
    by_pose
        (V, 6) derivative of ``height_m`` by a small turn and by a shift of each view.
    by_miss
        (V, 3) derivative by ``miss_m``.
    """
    normal = rotations[:, :, 2]
    nx, ny, nz = normal.T
    c, s = np.cos(known_scan_rad), np.sin(known_scan_rad)
    ux, uy = c * miss_m[0] - s * miss_m[1], s * miss_m[0] + c * miss_m[1]
    tx, ty, tz = translations_m.T
    lateral = (nx * (tx - ux) + ny * (ty - uy)) / nz
    height = tz + lateral - miss_m[2] * (1.0 - 1.0 / nz)
    by_normal = np.stack([(tx - ux) / nz, (ty - uy) / nz, -(lateral + miss_m[2] / nz) / nz], axis=1)
    by_shift = normal / nz[:, None]
    by_miss = np.stack(
        [-(c * nx + s * ny) / nz, -(-s * nx + c * ny) / nz, -(1.0 - 1.0 / nz)], axis=1
    )
    return height, np.concatenate([cross_products(normal, by_normal), by_shift], axis=1), by_miss


@dataclass(frozen=True)
class StageIsotropy:
    """Size and shape of the pixels against the moves of a stage.

    Attributes
    ----------
    scale_x, scale_y
        nm per px of the calibration over the one that the stage says, less one, along x and y of the rectified image.
    skew
        Cosine of the angle between the axes of the image, on the specimen.
    scale_x_sigma, scale_y_sigma, skew_sigma
        Their 1-sigma from the scatter of the positions about the fit; the stage's own errors are not in them.
    scatter_m
        1-sigma of a position of the stage per axis: its repeatability, and the errors of the registration.
    frames
        Number of frames that were used.
    """

    scale_x: float
    scale_y: float
    skew: float
    scale_x_sigma: float
    scale_y_sigma: float
    skew_sigma: float
    scatter_m: float
    frames: int


def fit_stage_moves(
    position_m: Array, shift_px: Array, time_s: Array, pixel_size_m: float
) -> StageIsotropy:
    """Compare shifts of rectified images with the positions of the stage.

    Parameters
    ----------
    position_m
        (n, 2) x and y of the stage, without tilt.
    shift_px
        (n, 2) where in the rectified image the specimen lies, against any one frame.
    time_s
        (n,) when.
    pixel_size_m
        Size of a rectified pixel by the calibration.

    Raises
    ------
    InvalidValueError
        If there are fewer than five frames, or their positions lie on one line.
    """
    count = len(position_m)
    if count < FRAMES_MIN:
        raise InvalidValueError(f"{count} positions of the stage", expected=f"{FRAMES_MIN}")
    centred = position_m - position_m.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if not spread[1] > ONE_LINE_RATIO * spread[0]:
        raise InvalidValueError(
            "positions of the stage on one line", expected="moves along x and along y"
        )
    span = np.ptp(time_s)
    late = (time_s - time_s.mean()) / (span if span > 0.0 else 1.0)
    design = np.column_stack([centred / spread[0], np.ones(count), late])
    # Of frames at one time, the drift is open, and zero.
    inverse = np.linalg.pinv(design)
    fitted = inverse @ shift_px
    rest = shift_px - design @ fitted
    freedom = count - int(np.linalg.matrix_rank(design))
    variance = np.sum(rest**2, axis=0) / max(freedom, 1)
    # Both axes of the image share the scatter of the stage.
    common = float(np.mean(variance))
    matrix = fitted[:2].T * (pixel_size_m / spread[0])
    covariance = common * (inverse @ inverse.T)[:2, :2] * (pixel_size_m / spread[0]) ** 2
    length = np.linalg.norm(matrix, axis=1)
    unit = matrix / length[:, None]
    skew = float(unit[0] @ unit[1])
    # A few residuals do not tell their own sigma well.
    wide = float(stdtrit(2 * max(freedom, 1), ONE_SIGMA))
    sigma = [float(np.sqrt(u @ covariance @ u)) for u in unit]
    across = [
        (unit[1] - skew * unit[0]) / length[0],
        (unit[0] - skew * unit[1]) / length[1],
    ]
    skew_sigma = float(np.sqrt(sum(a @ covariance @ a for a in across)))
    return StageIsotropy(
        float(length[0] - 1.0),
        float(length[1] - 1.0),
        skew,
        wide * sigma[0],
        wide * sigma[1],
        wide * skew_sigma,
        float(np.sqrt(common)) * pixel_size_m,
        count,
    )
