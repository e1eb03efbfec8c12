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

"""Stripes: brightness that whole lines or columns have in common, and that does not move with the specimen.

The mains put hum on the detector's signal, an amplifier or a charged specimen gives each line its own brightness, a
converter gives each column its own. Stripes that stay, or roll, pull a shift to their own one, however weak they are:
they have the same phase all over the image, where the specimen's gradients only add up by their squares.

They show in what a shift leaves of two images: strips of it beside each other have noise of their own, and stripes in
common.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Image, Mask
from semcal_ros.core.drift.fixed_parts import look_beside
from semcal_ros.core.drift.thresholds import (
    LONE_LINE_AROUND,
    STRIPE_CELLS_MIN,
    STRIPE_CLIP,
    STRIPE_PARTS,
    STRIPE_PROFILE_MIN,
    STRIPE_SHADING,
    STRIPE_SHARE_MAX,
    STRIPE_SMOOTHED_PX,
    STRIPE_STRIPS,
)


@dataclass(frozen=True)
class Stripes:
    """In which directions an image has stripes.

    Attributes
    ----------
    lines, columns
        Whether the lines have brightness of their own, and the columns.
    """

    lines: bool = False
    columns: bool = False

    def __str__(self) -> str:
        """The directions in words, or nothing."""
        named = (("lines", self.lines), ("columns", self.columns))
        return " and ".join(name for name, has in named if has)

    def __bool__(self) -> bool:
        return self.lines or self.columns

    def __and__(self, other: Stripes) -> Stripes:
        return Stripes(self.lines and other.lines, self.columns and other.columns)

    def __or__(self, other: Stripes) -> Stripes:
        return Stripes(self.lines or other.lines, self.columns or other.columns)

    def remove_from(self, image: AnyImage) -> AnyImage:
        """The image (h, w) or (h, w, 3) with the same median in all lines, or columns, in single precision."""
        if not self:
            return image
        out = image.astype(np.float32)
        for axis, has in ((1, self.lines), (0, self.columns)):
            if has:
                # A tool may cover nearly half of a line. As numpy.median, in a fifth of its time.
                ordered = np.sort(np.ascontiguousarray(np.moveaxis(out, axis, -1)))
                middle = out.shape[axis] // 2
                out -= np.expand_dims(ordered[..., [middle, -middle - 1]].mean(axis=-1), axis)
        return out


def find_stripes(before: Image, now: Image, shift_px: Array) -> Stripes:
    """In which directions two images (h, w) have stripes that did not move by ``shift_px`` (2,) as the specimen did.

    Lines of the specimen along a direction have brightness in common, too, but move with it. For how often noise is
    taken for stripes, see `STRIPE_CELLS_MIN`.
    """
    height, width = now.shape
    margins = np.ceil(np.abs(shift_px)).astype(int) + 2
    if np.any(4 * margins > np.array([width, height])):
        return Stripes()
    # Of sharp edges, interpolation leaves more.
    first, second = (
        np.asarray(cv2.GaussianBlur(image, (0, 0), STRIPE_SMOOTHED_PX), dtype=np.float32)
        for image in (before, now)
    )
    moved = look_beside(first, -shift_px)
    inside = (
        slice(margins[1], height - margins[1]),
        slice(margins[0], width - margins[0]),
    )
    own, there = second[inside], moved[inside]
    own, there = own - own.mean(), there - there.mean()
    gain = float(np.vdot(own, there)) / max(float(np.vdot(there, there)), 1e-30)
    left = own - np.float32(gain) * there
    return Stripes(_has_stripes(left, own), _has_stripes(left.T, own.T))


def suspect_stripes(
    image: Image, hidden: Mask | None = None, least: float = STRIPE_CELLS_MIN
) -> Stripes:
    """In which directions an image (h, w) has lines with brightness in common: stripes, or a specimen of such lines.

    What is ``hidden`` (h, w) by something else does not count, as a tool, whose edges would be in many lines. ``least``
    is the part of the cells that agree.
    """
    seen = np.ones(image.shape, np.float32) if hidden is None else np.asarray(~hidden, np.float32)
    pairs = (image, seen), (image.T, seen.T)
    return Stripes(*(_measure_common(*pair, least) is not None for pair in pairs))


def find_lone_lines(image: Image, hidden: Mask | None = None) -> Stripes:
    """In which directions an image (h, w) has a line through all of it that is brighter than those around it, or
    darker: that of a cross-hair which was recorded with noise, or of a specimen.

    It is so by :data:`STRIPE_CLIP` in each strip: by chance, none is. What is ``hidden`` (h, w) does not count.
    """
    seen = np.ones(image.shape, np.float32) if hidden is None else np.asarray(~hidden, np.float32)
    return Stripes(_has_lone_line(image, seen), _has_lone_line(image.T, seen.T))


def _has_lone_line(image: Image, seen: Image) -> bool:
    profiles, is_seen = _unclipped_profile(image, seen, LONE_LINE_AROUND)
    if profiles.shape[1] < STRIPE_PROFILE_MIN:
        return False
    limits = [_clip_limit(*pair) for pair in zip(profiles, is_seen, strict=True)]
    signs = np.sign(profiles) * (np.abs(profiles) > np.array(limits)[:, None])
    through = [np.all((signs == sign) | ~is_seen, axis=0) for sign in (-1.0, 1.0)]
    return bool(np.any((through[0] | through[1]) & np.any(is_seen, axis=0)))


def _has_stripes(left: Image, image: Image) -> bool:
    """Whether the lines of what a shift has ``left`` of an image share brightness that is no structure of it."""
    seen = np.ones(image.shape, np.float32)
    common = _measure_common(left, seen, STRIPE_CELLS_MIN)
    if common is None:
        return False
    # A specimen of lines leaves some of them where the shift is a little off, and nothing else tells its place.
    whole = _profile(image, seen)[0].mean(axis=0)
    # What is left of both images is the noise of both.
    own, noise = (float(np.sum(np.diff(each, axis=0) ** 2)) for each in (image, left))
    of_specimen = max(own - 0.5 * noise, 1e-3 * own)
    share = image.shape[1] * float(np.sum(np.diff(whole) ** 2)) / of_specimen
    return share < STRIPE_SHARE_MAX or float(np.sum(common**2)) > 0.5 * float(np.sum(whole**2))


def _measure_common(image: Image, seen: Image, least: float) -> Array | None:
    """(lines,) brightness that the lines of an image have in common over its width, of what is ``seen`` (1, else 0);
    None where it is that of chance, or less than half is seen.

    Each strip is compared with the mean of the others in parts of its length. Stripes are everywhere: nearly all of
    these cells agree in sign, where noise does in half of them, and a tool or the edge of a shadow are in some.
    """
    profiles, is_seen = _profile(image, seen)
    strips, count = profiles.shape
    if count < STRIPE_PROFILE_MIN:
        return None
    common = profiles.mean(axis=0)
    others = (strips * common - profiles) / (strips - 1)
    starts = np.linspace(0, count, STRIPE_PARTS, endpoint=False).astype(int)
    cells = np.add.reduceat(profiles * others, starts, axis=1)
    tells = np.logical_or.reduceat(is_seen, starts, axis=1)
    if 2 * np.count_nonzero(tells) < tells.size:
        return None
    return common if np.mean(cells[tells] > 0.0) >= least else None


def _profile(image: Image, seen: Image) -> tuple[Array, Mask]:
    """As :func:`_unclipped_profile`, without lines of something else."""
    width = max(3, int(STRIPE_SHADING * len(image)) | 1)
    profiles, is_seen = _unclipped_profile(image, seen, width)
    for profile, has in zip(profiles, is_seen, strict=True):
        limit = _clip_limit(profile, has)
        np.clip(profile, -limit, limit, out=profile)
    return profiles, is_seen


def _unclipped_profile(image: Image, seen: Image, width: int) -> tuple[Array, Mask]:
    """(strips, lines) means of the lines of an image in strips beside each other, of what is ``seen`` (1, else 0) and
    without the mean of ``width`` lines around; and where half of the line is seen. Elsewhere they are 0.
    """
    share = _average_strips(seen)
    # The mean of a small part is that of another place.
    is_seen = share >= 0.5
    means = _average_strips(np.asarray(image, dtype=np.float32) * seen) / np.maximum(share, 0.5)
    slow, count = (
        cv2.blur(np.asarray(each, np.float32), (width, 1), borderType=cv2.BORDER_REFLECT)
        for each in (means * is_seen, is_seen)
    )
    profiles = (means - slow / np.maximum(count, 0.5 / width)) * is_seen
    return profiles.astype(np.float64), is_seen


def _clip_limit(profile: Array, is_seen: Mask) -> float:
    """Beyond which the mean of a line is something else; infinite where none is seen."""
    if not np.any(is_seen):
        return np.inf
    return STRIPE_CLIP * 1.4826 * float(np.median(np.abs(profile[is_seen])))


def _average_strips(image: Image) -> Image:
    """(strips, lines) means of the lines of an image in strips beside each other."""
    strips = np.array_split(image, STRIPE_STRIPS, axis=1)
    return np.array([strip.mean(axis=1) for strip in strips])
