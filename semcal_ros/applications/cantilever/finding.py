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

"""Find the cantilever in an image: the strongest strip between two parallel edges, bright or dark.

For every direction, the gradient across it is summed along lines (a Radon transform of the signed
derivative). Texture averages out; a strip leaves a rising and a falling line close together.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.applications.cantilever.thresholds import (
    ALIKE_PART,
    APART_RAD,
    BLUR_PX,
    BORDER_PX,
    COARSE_PX,
    DARK_PART,
    EDGE_PART,
    FINE_RAD,
    GAP_MAX,
    LENGTH_MIN,
    LENGTH_TOLERANCE,
    NOWHERE,
    SEARCHED_PX,
    STEP_RAD,
    STRENGTH_MIN,
    STRIPS_MAX,
    WIDTH_MAX,
    WIDTH_MIN_PX,
)
from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.errors import InvalidValueError

_GIVE_CLICKS = "give two points on its centre line, the base and the free end, as base and tip"


@dataclass(frozen=True)
class Strip:
    """A cantilever in raw pixels.

    Attributes
    ----------
    base_px, tip_px
        (2,) ends of the visible part of the centre line.
    half_width_px
        Half the width of the strip.
    base_seen, tip_seen
        Whether each end is an end of the cantilever and not the place where it leaves the image.
    is_dark
        Whether the strip is darker than what lies beside it.
    rivals
        Other strips of the same kind that have the length of the cantilever, too.
    """

    base_px: Array
    tip_px: Array
    half_width_px: float
    base_seen: bool
    tip_seen: bool
    is_dark: bool = False
    rivals: tuple[Strip, ...] = ()


@dataclass(frozen=True)
class _Lines:
    """Gradient of an image, prepared for sums along lines."""

    gx: Array
    gy: Array
    x: Array
    y: Array
    size: tuple[int, int]
    # Several strips may lie in one direction.
    known: dict[float, tuple[Array, float]] = field(default_factory=dict)

    def across(self, angle: float) -> tuple[Array, float]:
        """Sum along lines in a direction: sums by distance from the origin, first distance."""
        if angle not in self.known:
            c, s = np.cos(angle), np.sin(angle)
            distance = (self.y * c)[:, None] - self.x * s
            first = float(np.floor(distance.min()))
            distance -= first
            place = np.rint(distance, out=distance).astype(np.intp).ravel()
            sums = np.bincount(place, (self.gy * c - self.gx * s).ravel())
            self.known[angle] = np.asarray(sums, dtype=np.float64), first
        return self.known[angle]


def find_strip(
    image: NDArray[np.generic],
    *,
    base_px: ArrayLike | None = None,
    tip_px: ArrayLike | None = None,
    length_px: float | None = None,
) -> Strip:
    """Find a cantilever on a darker ground, or on a clearly brighter one.

    The strongest strip is taken, or, if several have two ends in view, one that has the length of the cantilever.

    Parameters
    ----------
    image
        (h, w) grey image in which nothing touches the cantilever.
    base_px, tip_px
        (2,) raw pixels of the two ends of the centre line, good to a few pixels; they may lie
        outside the image where the end is out of view. None finds them.
    length_px
        Length of the cantilever in pixels, to tell it from other bodies; None if it is not known.

    Raises
    ------
    InvalidValueError
        If there is no strip, or its base and free end cannot be told apart.
    """
    if (base_px is None) != (tip_px is None):
        raise InvalidValueError("only one end of the cantilever", expected="both or none")
    shrink = max(1, int(np.ceil(max(image.shape) / SEARCHED_PX)))
    grey = np.asarray(image, dtype=np.float32)
    if shrink > 1:
        height, width = (n // shrink * shrink for n in grey.shape)
        size = (width // shrink, height // shrink)
        grey = np.asarray(
            cv2.resize(grey[:height, :width], size, interpolation=cv2.INTER_AREA), np.float32
        )
    smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), BLUR_PX), dtype=np.float64)
    if base_px is None or tip_px is None:
        is_dark, found = _choose_strip(smooth, None if length_px is None else length_px / shrink)
    else:
        clicks = [(np.asarray(p, dtype=np.float64) + 0.5) / shrink - 0.5 for p in (base_px, tip_px)]
        is_dark, found = _follow_clicks(smooth, clicks[0], clicks[1])
    rivals = tuple(_enlarge(rival, shrink, is_dark) for rival in found.rivals)
    return replace(_enlarge(found, shrink, is_dark), rivals=rivals)


def _enlarge(strip: Strip, shrink: int, is_dark: bool) -> Strip:
    """Convert a strip that was found in a reduced image."""
    return Strip(
        (strip.base_px + 0.5) * shrink - 0.5,
        (strip.tip_px + 0.5) * shrink - 0.5,
        strip.half_width_px * shrink,
        strip.base_seen,
        strip.tip_seen,
        is_dark,
    )


def _no_strip() -> InvalidValueError:
    return InvalidValueError("no strip in the image", expected="a cantilever", do=_GIVE_CLICKS)


def _prepare_lines(smooth: Array) -> _Lines:
    # The border of the image is not an edge.
    gy, gx = (np.asarray(part)[3:-3, 3:-3] for part in np.gradient(smooth))
    height, width = smooth.shape
    return _Lines(gx, gy, np.arange(3.0, width - 3), np.arange(3.0, height - 3), (width, height))


def _find_best_pair(rise: Array, fall: Array, low: int, high: int) -> tuple[float, int, int]:
    """Find a rising and a falling line after it, of which the weaker one is strongest, with no such pair between."""
    best = (0.0, 0, 0)
    for width in range(low, min(high, len(rise) - 1)):
        pair = np.minimum(rise[:-width], fall[width:])
        first = int(pair.argmax())
        if pair[first] > best[0]:
            best = (float(pair[first]), first, first + width)
    strength, first, last = best
    least = ALIKE_PART * strength
    # The falling line that belongs to the first edge, and the rising line that belongs to the last one.
    inner_fall = first + low + _find_peak(fall[first + low : last - low + 1], least)
    inner_rise = last - low - _find_peak(rise[first + low : last - low + 1][::-1], least)
    if first + low <= inner_fall < inner_rise <= last - low:
        left = min(float(rise[first]), float(fall[inner_fall])), first, inner_fall
        right = min(float(rise[inner_rise]), float(fall[last])), inner_rise, last
        return max(left, right)
    return best


def _find_peak(values: Array, least: float) -> int:
    """Return the index of the first peak that is at least so high, or a large one if there is none."""
    high = np.flatnonzero(values >= least)
    if not high.size:
        return NOWHERE
    k = int(high[0])
    while k + 1 < len(values) and values[k + 1] > values[k]:
        k += 1
    return k


def _widen(sums: Array) -> Array:
    """Sum over three neighbouring lines: an edge is some pixels wide and may be slightly bent."""
    return np.asarray(np.convolve(sums, np.ones(3), mode="same"), dtype=np.float64)


def _choose_strip(smooth: Array, length_px: float | None) -> tuple[bool, Strip]:
    """Find the strip that has the known length, or else the strongest that has ends: whether it is dark, and the strip.

    Between a beam and a pusher of the same kind lies a strip of the other, with edges as strong; it
    is short.
    """
    refusals: list[InvalidValueError] = []
    strongest: dict[bool, tuple[bool, Strip]] = {}
    fitting: list[tuple[bool, Strip]] = []
    first_seen: set[bool] = set()
    most = 0.0
    lines = _prepare_lines(smooth)
    for is_dark, angle, point in _search_lines(smooth):
        is_first = is_dark not in first_seen
        first_seen.add(is_dark)
        signed = -smooth if is_dark else smooth
        strength, *line = _find_pair_near(lines, angle, point, is_dark)
        strength *= DARK_PART if is_dark else 1.0
        most = max(most, strength)
        if strength <= 0.0 or not (is_first or strength > STRENGTH_MIN * most):
            continue
        try:
            found = _find_ends(signed, *line)
        except InvalidValueError as error:
            if is_first:
                refusals.append(error)
            continue
        if length_px is not None and _has_length(found, length_px):
            fitting.append((is_dark, found))
        if is_first:
            strongest[is_dark] = is_dark, found
    if fitting:
        is_dark, chosen = fitting[0]
        # Between two beams lies a strip of the other kind.
        distinct = [chosen]
        for kind, other in fitting[1:]:
            if kind == is_dark and not any(_is_same(one, other) for one in distinct):
                distinct.append(other)
        return is_dark, replace(chosen, rivals=tuple(distinct[1:]))
    for choice in strongest.values():
        return choice
    # Of the stronger one.
    raise refusals[0] if refusals else _no_strip()


def _is_same(one: Strip, other: Strip) -> bool:
    """Whether two strips lie on each other."""
    away = 0.5 * (one.base_px + one.tip_px) - 0.5 * (other.base_px + other.tip_px)
    return float(np.hypot(*away)) < one.half_width_px + other.half_width_px


def _has_length(strip: Strip, length_px: float) -> bool:
    """Whether both ends of a strip are in view, as far apart as those of the cantilever."""
    if not (strip.base_seen and strip.tip_seen):
        return False
    excess = float(np.hypot(*(strip.tip_px - strip.base_px))) - length_px
    tolerance = LENGTH_TOLERANCE * length_px
    return -tolerance - 2.0 * strip.half_width_px < excess < tolerance


def _search_lines(smooth: Array) -> list[tuple[bool, float, Array]]:
    """Find the strongest bright and dark strips of several directions in a small image, the strongest first.

    Of each: whether it is dark, its direction, and a point on it.
    """
    shrink = max(1, int(np.ceil(max(smooth.shape) / COARSE_PX)))
    size = (smooth.shape[1] // shrink, smooth.shape[0] // shrink)
    part = smooth[: size[1] * shrink, : size[0] * shrink].astype(np.float32)
    small = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.float64)
    lines = _prepare_lines(small)
    high = int(WIDTH_MAX * min(small.shape))
    least = WIDTH_MIN_PX // shrink + 1
    best: list[tuple[float, bool, float]] = []
    # Half a turn is enough: in the opposite direction the two edges only change places.
    for turn in np.arange(0.0, np.pi, STEP_RAD):
        wide = _widen(lines.across(float(turn))[0])
        for dark, edges in ((False, wide), (True, -wide)):
            strength = _find_best_pair(edges, -edges, least, high)[0]
            best.append((strength * (DARK_PART if dark else 1.0), dark, float(turn)))
    directions: list[tuple[bool, float]] = []
    for strength, dark, angle in sorted(best, key=lambda one: -one[0]):
        alike = [turn for other, turn in directions if other == dark]
        apart = [abs((angle - turn + 0.5 * np.pi) % np.pi - 0.5 * np.pi) for turn in alike]
        if strength > 0.0 and len(alike) < STRIPS_MAX and min(apart, default=np.pi) >= APART_RAD:
            directions.append((dark, angle))
    middle = 0.5 * (np.array(size) - 1.0)
    found: list[tuple[float, bool, float, Array]] = []
    for dark, angle in directions:
        sums, first = lines.across(angle)
        edges = (-1.0 if dark else 1.0) * _widen(sums)
        rise, fall = edges.copy(), -edges
        across = np.array([-np.sin(angle), np.cos(angle)])
        # Beside the strongest strip there may be others in the same direction.
        for _ in range(STRIPS_MAX):
            strength, low, up = _find_best_pair(rise, fall, least, high)
            if strength <= 0.0:
                break
            offset = 0.5 * (low + up) + first
            point = middle + (offset - float(across @ middle)) * across
            factor = DARK_PART if dark else 1.0
            found.append((factor * strength, dark, angle, (point + 0.5) * shrink - 0.5))
            rise[max(low - 2, 0) : up + 3] = fall[max(low - 2, 0) : up + 3] = 0.0
    found.sort(key=lambda one: -one[0])
    return [(dark, angle, point) for _, dark, angle, point in found]


def _find_pair_near(
    lines: _Lines, nominal: float, point: Array, is_dark: bool
) -> tuple[float, float, float, float]:
    """Find strength, direction, distance from the origin and half width of the strip of this kind around a point."""
    reach = int(WIDTH_MAX * min(lines.size))
    best, found = 0.0, (0.0, nominal, 0.0, 0.0)
    for angle in nominal + FINE_RAD:
        sums, first = lines.across(float(angle))
        here = round(float(point[1] * np.cos(angle) - point[0] * np.sin(angle)) - first)
        wide = -_widen(sums) if is_dark else _widen(sums)
        left, right = max(here - reach, 0), min(here + reach, len(wide))
        if not left < here < right:
            continue
        rise, fall = wide[left:right].copy(), -wide[left:right]
        rise[here - left :], fall[: here - left] = -np.inf, -np.inf
        strength, low, up = _find_best_around(rise, fall, here - left)
        if strength > best:
            best = strength
            found = best, float(angle), 0.5 * (low + up) + left + first, 0.5 * (up - low)
    return found


def _find_best_around(rise: Array, fall: Array, here: int) -> tuple[float, int, int]:
    """Find the nearest rising line before a place and falling line after it that are as strong as any there."""
    strength = float(min(rise[:here].max(initial=0.0), fall[here:].max(initial=0.0)))
    low = here - 1 - _find_peak(rise[:here][::-1], ALIKE_PART * strength)
    up = here + _find_peak(fall[here:], ALIKE_PART * strength)
    if strength <= 0.0 or low < 0 or up >= len(fall) or up - low < WIDTH_MIN_PX:
        return 0.0, 0, 0
    return min(float(rise[low]), float(fall[up])), low, up


def _follow_clicks(smooth: Array, base: Array, tip: Array) -> tuple[bool, Strip]:
    """Find the strip around two points, whose positions along it are taken as its ends, and whether it is dark."""
    if not float(np.hypot(*(tip - base))) > 10.0:
        raise InvalidValueError("base and tip at the same place", expected="two ends of a beam")
    nominal = float(np.arctan2(tip[1] - base[1], tip[0] - base[0]))
    seen = [_is_inside(p, smooth.shape) for p in (base, tip)]
    # Points in view only: a click outside the image gives no more than the direction.
    points = [p for p, inside in zip((base, tip), seen, strict=True) if inside]
    inwards = [(tip - base) / 20.0, (base - tip) / 20.0]
    point = np.mean(points, axis=0) if points else 0.5 * (base + tip)
    if len(points) == 1:
        point = points[0] + inwards[0 if seen[0] else 1]
    lines = _prepare_lines(smooth)
    bright, dark = (_find_pair_near(lines, nominal, point, kind) for kind in (False, True))
    is_dark = DARK_PART * dark[0] > bright[0]
    strength, angle, offset, half = dark if is_dark else bright
    if strength <= 0.0:
        raise InvalidValueError(
            "no strip between base and tip", expected="two points on its centre line"
        )
    along = np.array([np.cos(angle), np.sin(angle)])
    across = offset * np.array([-along[1], along[0]])
    ends = [across + along * float(along @ p) for p in (base, tip)]
    return is_dark, Strip(*_clip_to_view(ends, smooth.shape), half, seen[0], seen[1])


def _clip_to_view(ends: list[Array], shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Clip a line to the image."""
    steps = np.linspace(0.0, 1.0, 2001)[:, None]
    points = ends[0] + steps * (ends[1] - ends[0])
    inside = np.flatnonzero(
        (points >= 0.0).all(axis=1) & (points <= [shape[1] - 1.0, shape[0] - 1.0]).all(axis=1)
    )
    if inside.size < 2:
        raise InvalidValueError(
            "a beam that is out of view between base and tip", expected="a beam in the image"
        )
    return points[inside[0]], points[inside[-1]]


def _is_inside(point: Array, shape: tuple[int, ...]) -> bool:
    x, y = point
    return bool(
        BORDER_PX <= x <= shape[1] - 1 - BORDER_PX and BORDER_PX <= y <= shape[0] - 1 - BORDER_PX
    )


def _sample(image: Array, points: Array) -> Array:
    """Interpolate grey levels at (n, 2) pixels; NaN outside the image."""
    maps = [np.ascontiguousarray(points[None, :, k], dtype=np.float32) for k in (0, 1)]
    out = cv2.remap(
        image.astype(np.float32),
        maps[0],
        maps[1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )
    return np.asarray(out[0], dtype=np.float64)


def _find_ends(smooth: Array, angle: float, offset: float, half: float) -> Strip:
    """Find where along its lines the strip begins and ends, and which end is free."""
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.array([c, s]), np.array([-s, c])
    reach = float(np.hypot(*smooth.shape))
    steps = np.arange(-reach, reach)
    line = offset * across + steps[:, None] * along
    places = (-half - 2.5, -half + 2.5, 0.0, half - 2.5, half + 2.5)
    levels = [_sample(smooth, line + d * across) for d in places]
    lower, upper = levels[1] - levels[0], levels[3] - levels[4]
    if half < 4.0:  # a narrow beam is brightest in its middle
        lower, upper = levels[2] - levels[0], levels[2] - levels[4]
    strength = np.minimum(lower, upper)
    known = np.isfinite(strength)
    weight = np.ones(9)
    filled = np.convolve(np.where(known, strength, 0.0), weight, mode="same")
    count = np.convolve(known.astype(float), weight, mode="same")
    mean = np.where(count > 4, filled / np.maximum(count, 1.0), -np.inf)
    strong = float(np.quantile(strength[known], 0.9)) if known.any() else 0.0
    run = _find_longest_run(mean > EDGE_PART * strong, max(4, int(GAP_MAX * min(smooth.shape))))
    side = min(smooth.shape)
    if run is None or strong <= 0.0 or run[1] - run[0] < LENGTH_MIN * side:
        raise InvalidValueError(
            "no long enough strip in the image", expected="a cantilever", do=_GIVE_CLICKS
        )
    ends = [offset * across + steps[k] * along for k in run]
    seen = [
        all(_is_inside(p, smooth.shape) for p in _get_corners(end, sign * along, across, half))
        for end, sign in zip(ends, (-1.0, 1.0), strict=True)
    ]
    free = [
        _measure_freedom(smooth, end, sign * along, across, half)
        for end, sign in zip(ends, (-1, 1), strict=True)
    ]
    return _decide_ends(ends, seen, free, half)


def _get_corners(end: Array, outwards: Array, across: Array, half: float) -> list[Array]:
    """Return points just beyond both corners of an end: a strip may leave the image at an angle."""
    return [end + 4.0 * outwards + side * (half + 3.0) * across for side in (-1.0, 1.0)]


def _find_longest_run(good: Mask, gap: int) -> tuple[int, int] | None:
    """Return the first and last index of the longest run; gaps of up to ``gap`` do not break it."""
    places = np.flatnonzero(good)
    if not places.size:
        return None
    breaks = np.flatnonzero(np.diff(places) > gap)
    firsts = np.append(0, breaks + 1)
    lasts = np.append(breaks, len(places) - 1)
    longest = int(np.argmax(places[lasts] - places[firsts]))
    return int(places[firsts[longest]]), int(places[lasts[longest]])


def _measure_freedom(
    image: Array, end: Array, outwards: Array, across: Array, half: float
) -> float:
    """Measure how dark it is beyond an end: 1 as beside the strip, 0 as on it, NaN out of view.

    It is the median of three places: ahead of the end, and ahead on its left and right. A tapered tip
    is bright ahead, and a pusher beside the tip on one side; a holder is bright in at least two.
    """
    spread = np.linspace(-0.5 * half, 0.5 * half, 5)
    beyond = np.linspace(8.0, 8.0 + max(half, 8.0), 9)
    away = half + 8.0

    def level(steps: Array, offsets: Array) -> float:
        points = end + steps[:, None, None] * outwards + offsets[None, :, None] * across
        values = _sample(image, points.reshape(-1, 2))
        return float(np.nanmean(values)) if np.isfinite(values).mean() > 0.5 else float("nan")

    inside = level(-beyond, spread)
    background = level(-beyond, np.concatenate([spread - away, spread + away]))
    outside = [level(beyond, spread + shift) for shift in (-away, 0.0, away)]
    known = [v for v in outside if np.isfinite(v)]
    if not np.isfinite(outside[1]) or not known:
        return float("nan")
    return (inside - float(np.median(known))) / max(inside - background, 1e-9)


def _decide_ends(ends: list[Array], seen: list[bool], free: list[float], half: float) -> Strip:
    """Decide which end is the base: the one that stays bright beyond, or that is out of view."""
    is_tip = [s and f > 0.5 for s, f in zip(seen, free, strict=True)]
    is_base = [s and f <= 0.5 for s, f in zip(seen, free, strict=True)]
    if is_tip[0] == is_tip[1] and is_base[0] == is_base[1]:
        raise InvalidValueError(
            "a strip whose base and free end cannot be told apart",
            expected="a cantilever with at least one of its ends in view",
            do=_GIVE_CLICKS,
        )
    tip = 0 if is_tip[0] or is_base[1] else 1
    return Strip(ends[1 - tip], ends[tip], half, is_base[1 - tip], is_tip[tip])
