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

"""Repeatability of the deflections of the same poses across several magnifications."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.applications.cantilever.series import Series
from semcal_ros.applications.cantilever.thresholds import OTHER_WIDTH, SPREAD_RATIO
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class Repeatability:
    """Deflections by magnification and pose, m.

    Attributes
    ----------
    magnifications
        (m,) of the series.
    deflection_m, sigma_m
        (m, p) means over the frames of each pose, in calibrated metres, and 1-sigma.
    by_length_m, by_length_sigma_m
        The same in metres of the known length; NaN where base and end are not both in view.
    spread_m, by_length_spread_m
        (p,) standard deviation among the magnifications (NaN for one); that of the reference pose
        is zero by definition.
    rms_spread_m, by_length_rms_spread_m
        Root of its mean square over the poses but the first.
    expected_spread_m
        Value of ``rms_spread_m`` that the 1-sigmas predict.
    """

    magnifications: tuple[float, ...]
    deflection_m: Array
    sigma_m: Array
    by_length_m: Array
    by_length_sigma_m: Array
    spread_m: Array
    by_length_spread_m: Array
    rms_spread_m: float
    by_length_rms_spread_m: float
    expected_spread_m: float


def group_frames(frames: int, poses: int | None) -> list[list[int]]:
    """Group ``frames`` frames, in the order of time, into ``poses`` equal parts.

    With None each frame is a pose of its own.

    Raises
    ------
    InvalidValueError
        If the frames cannot be divided equally.
    """
    count = frames if poses is None else poses
    if not isinstance(count, (int, np.integer)) or count < 1 or frames % count:
        raise InvalidValueError(
            f"{counted(frames, 'frame')} for {count} poses",
            expected="the same number of frames in each pose",
            do="correct --poses, or cut the recording",
        )
    each = frames // count
    return [list(range(k * each, (k + 1) * each)) for k in range(count)]


def compare_series(series: Sequence[Series], poses: int | None = None) -> Repeatability:
    """Compare series whose k-th poses are the same.

    Parameters
    ----------
    series
        One per magnification.
    poses
        As for :func:`group_frames`.

    Raises
    ------
    InvalidValueError
        If they have different numbers of poses.
    """
    if not series:
        raise InvalidValueError("no series", expected="at least one magnification")
    groups = [group_frames(len(s.frames), poses) for s in series]
    counts = sorted({len(g) for g in groups})
    if len(counts) > 1:
        seen = ", ".join(f"{s.magnification:g}: {len(s.frames)}" for s in series)
        raise InvalidValueError(
            f"different numbers of frames by magnification ({seen})",
            expected="the same poses at each magnification",
            do="state --poses, or cut the recordings",
        )
    value, sigma = _average_poses(series, groups, by_length=False)
    known, known_sigma = _average_poses(series, groups, by_length=True)
    spread, known_spread = _compute_spread(value), _compute_spread(known)
    return Repeatability(
        tuple(s.magnification for s in series),
        value,
        sigma,
        known,
        known_sigma,
        spread,
        known_spread,
        _compute_rms(spread),
        _compute_rms(known_spread),
        _compute_rms(np.sqrt(np.mean(sigma**2, axis=0))) if len(series) > 1 else float("nan"),
    )


def describe_disagreement(series: Sequence[Series], found: Repeatability) -> list[str]:
    """Return notes where the magnifications did not measure the same thing.

    Parameters
    ----------
    series, found
        One series per magnification, and the comparison of them.
    """
    notes = []
    widths = np.array([2.0 * one.undeformed.axis.half_width_m for one in series])
    if widths.max() > OTHER_WIDTH * widths.min():
        listed = ", ".join(
            f"{1e6 * width:.3g} um at {one.magnification:g}x"
            for width, one in zip(widths, series, strict=True)
        )
        notes.append(
            f"the beam is {listed} wide: not all of these are the same body. Look at --strip, or give base and tip"
        )
    if found.rms_spread_m > SPREAD_RATIO * found.expected_spread_m:
        # A pose that was measured at less than two magnifications has no spread.
        known = np.flatnonzero(np.isfinite(found.spread_m))
        away = found.deflection_m[:, known] - np.nanmedian(found.deflection_m[:, known], axis=0)
        row, place = np.unravel_index(int(np.nanargmax(np.abs(away))), away.shape)
        column = int(known[place])
        notes.append(
            f"the magnifications differ by {1e9 * found.rms_spread_m:.2g} nm RMS where their sigmas predict "
            f"{1e9 * found.expected_spread_m:.2g} nm, most at {found.magnifications[row]:g}x in pose {column + 1}, by "
            f"{1e9 * away[row, place]:+.2g} nm: were the poses the same?"
        )
    return notes


def _average_poses(
    series: Sequence[Series], groups: list[list[list[int]]], *, by_length: bool
) -> tuple[Array, Array]:
    value = np.full((len(series), len(groups[0])), np.nan)
    sigma = np.full_like(value, np.nan)
    for row, (one, parts) in enumerate(zip(series, groups, strict=True)):
        for column, frames in enumerate(parts):
            chosen = [one.frames[k] for k in frames]
            chosen = [f for f in chosen if np.isfinite(f.noise_m)]
            if not chosen:
                continue
            weight = np.array([1.0 / max(f.noise_m, 1e-15) ** 2 for f in chosen])
            weight /= weight.sum()
            parts_m = [(f.by_length_m, f.by_length_sigma_m) for f in chosen]
            if not by_length:
                parts_m = [(f.deflection_m, f.sigma_m) for f in chosen]
            values, sigmas = np.array(parts_m).T
            value[row, column] = float(weight @ values)
            # Part of the noise is the reference's; the error of the scale is common to all frames.
            noise = np.array([f.noise_m for f in chosen])
            share = 1.0 / (len(parts[0]) + 1.0)
            common = float(weight @ (sigmas**2 - noise**2)) + share * float(weight @ noise**2)
            independent = (1.0 - share) * float(np.sum(weight**2 * noise**2))
            sigma[row, column] = float(np.sqrt(max(common + independent, 0.0)))
    return value, sigma


def _compute_spread(value: Array) -> Array:
    if len(value) < 2:
        return np.full(value.shape[1], np.nan)
    return np.asarray(np.std(value, axis=0, ddof=1))


def _compute_rms(values: Array) -> float:
    """Compute the RMS over all poses but the first, which is the reference."""
    rest = values[1:]
    known = rest[np.isfinite(rest)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
