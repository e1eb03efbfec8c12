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

"""Deflections of a cantilever in the frames of one magnification."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.applications.cantilever.background_drift import Background, follow_background
from semcal_ros.applications.cantilever.bending import (
    Bending,
    Shape,
    evaluate_bending,
    expect_point_load,
    fit_bending,
    fit_common_shape,
    locate_end,
    locate_load,
    parse_shape,
)
from semcal_ros.applications.cantilever.edges import (
    EdgeFit,
    StepFit,
    find_unchanged_width,
    fit_edges,
)
from semcal_ros.applications.cantilever.finding import Strip, find_strip
from semcal_ros.applications.cantilever.plane import Axis, PlaneMap
from semcal_ros.applications.cantilever.thresholds import (
    BASE_SLIP_PX,
    BASE_SLIP_SIGMAS,
    DEFLECTION_ABSURD,
    DEFLECTION_MAX,
    INTERVAL_MIN,
    LENGTH_MAX,
    LENGTH_SIGMAS,
    LINE_POINTS,
    MAKER_TOLERANCE,
    NAMED_MAX,
    REACH_PX,
    SAME_STEP,
    SHAPE_SIGMAS,
    SLIP_PX,
    UNTRACKED_M,
)
from semcal_ros.applications.cantilever.tip import find_apex
from semcal_ros.applications.cantilever.undeformed import (
    PixelSamples,
    UndeformedBeam,
    fit_base_edge,
    measure_undeformed_beam,
)
from semcal_ros.core.arrays import AnyImage, Array, Indices, check_positive
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import counted, omit_numbers


@dataclass(frozen=True)
class SeriesSettings:
    """How a cantilever is measured.

    Attributes
    ----------
    length_m
        Length of the cantilever, from its maker.
    shape
        One of :data:`~semcal_ros.applications.cantilever.bending.SHAPES`; ``"free"`` fits one shape
        to all frames.
    base_px, tip_px
        (2,) raw pixels of both ends of the centre line in the first frame; None finds them.
    largest_m
        Largest deflection in the search; None: a 25th of the length.
    """

    length_m: float
    shape: str = "free"
    base_px: ArrayLike | None = None
    tip_px: ArrayLike | None = None
    largest_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("length_m", "largest_m"):
            if getattr(self, name) is not None or name == "length_m":
                check_positive(getattr(self, name), name)
        parse_shape(self.shape)

    @property
    def reach_m(self) -> float:
        """Largest deflection in the search, m."""
        return DEFLECTION_MAX * self.length_m if self.largest_m is None else self.largest_m


@dataclass(frozen=True)
class Deflection:
    """The deflection in one frame.

    Attributes
    ----------
    deflection_m, sigma_m
        Deflection of the end against the reference in calibrated metres, positive to the right as
        seen from the base (where rows grow downwards), and its 1-sigma: noise, drift, reference,
        and the scale of the calibration.
    noise_m
        The 1-sigma without the error of the scale, which all frames of the magnification share.
    by_length_m, by_length_sigma_m
        The same in metres of the known length; NaN where base and end are not both in view.
    tip_px
        (2,) raw pixel of the end of the beam in this frame.
    line_px
        (n, 2) raw pixels of the visible part of the centre line in this frame.
    bending
        The fit.
    """

    deflection_m: float
    sigma_m: float
    noise_m: float
    by_length_m: float
    by_length_sigma_m: float
    tip_px: Array
    line_px: Array
    bending: Bending


@dataclass(frozen=True)
class Series:
    """All frames of one magnification.

    Attributes
    ----------
    magnification
        Magnification g.
    undeformed
        The undeformed beam.
    frames
        One result for each frame.
    shape
        Shape of the bending (see :mod:`~semcal_ros.applications.cantilever.bending`).
    drift
        Drift of the background.
    notes
        Remarks for the user.
    """

    magnification: float
    undeformed: UndeformedBeam
    frames: tuple[Deflection, ...]
    shape: Shape
    drift: DriftPath
    notes: tuple[str, ...]


def measure_series(
    images: Sequence[AnyImage],
    times_s: Sequence[float],
    camera: ScanCamera,
    timing: ScanTiming | None,
    settings: SeriesSettings,
    *,
    reference: Sequence[int] = (0,),
    on_frame: Callable[[], None] = lambda: None,
) -> Series:
    """Measure the deflection of the free end in each frame.

    Parameters
    ----------
    images
        (h, w) raw grey images of one size, in the order of time; nothing touches the cantilever
        in the first one.
    times_s
        Start time of each acquisition.
    camera
        Calibrated camera of the magnification.
    timing
        Raster timing; None treats each frame as an instant.
    settings
        The cantilever.
    reference
        Frames that count as straight.
    on_frame
        Called twice for each frame.

    Raises
    ------
    InvalidValueError
        If the images differ in size, their times do not grow, or no cantilever is found.
    """
    _check(images, times_s, reference)
    height, width = images[0].shape
    timing, early = _check_timing(timing, times_s)
    plane = PlaneMap(camera.resized(width, height), timing)
    field_m = max(width, height) * plane.pixel_m
    if settings.length_m > LENGTH_MAX * field_m:
        raise InvalidValueError(
            f"a cantilever of {settings.length_m:g} m where {1e6 * field_m:.3g} um are in view",
            expected="its length in m, such as 35e-6",
            do="check --length",
        )
    strip = find_strip(
        images[0],
        base_px=settings.base_px,
        tip_px=settings.tip_px,
        length_px=settings.length_m / plane.pixel_m,
    )
    if strip.is_dark:
        images = [_invert(image) for image in images]
    chosen = _measure_strip(strip, images, times_s, plane, settings, tuple(reference), on_frame)
    notes = early
    for rival in strip.rivals:
        try:
            other = _measure_strip(rival, images, times_s, plane, settings, tuple(reference))
        except InvalidValueError:
            # It is no beam.
            continue
        chosen = max(chosen, other, key=_rate_bending)
        notes = (
            *early,
            "several strips of that length are in view, and the one that bends was measured; for another one, give "
            "base and tip",
        )
    return replace(chosen, notes=chosen.notes + notes)


def _rate_bending(series: Series) -> float:
    """Return the largest deflection of a series in its sigmas."""
    rated = [abs(f.deflection_m) / f.sigma_m for f in series.frames if np.isfinite(f.sigma_m)]
    return max((value for value in rated if np.isfinite(value)), default=0.0)


def _measure_strip(
    strip: Strip,
    images: Sequence[AnyImage],
    times_s: Sequence[float],
    plane: PlaneMap,
    settings: SeriesSettings,
    reference: tuple[int, ...],
    on_frame: Callable[[], None] = lambda: None,
) -> Series:
    """Measure a bright strip in all frames."""
    rough = _extend_to_apex(_make_rough_axis(strip, plane, settings.length_m), plane, images[0])
    margin_m = 2.0 * REACH_PX * plane.pixel_m
    background = follow_background(images, times_s, plane, rough, margin_m, on_frame)
    work = _SeriesMeasurement(images, plane, background.path, settings, rough)
    undeformed = measure_undeformed_beam(
        rough, [work.sample(rough, k) for k in reference], settings.length_m, plane.pixel_m
    )
    _check_length(undeformed, settings.length_m, plane.camera)
    frames, shape, doubts = work.deflections(undeformed, reference, on_frame)
    notes = _collect_notes(undeformed, frames, background, reference, settings) + doubts
    return Series(
        plane.camera.magnification, undeformed, tuple(frames), shape, background.path, notes
    )


def _check(images: Sequence[AnyImage], times_s: Sequence[float], reference: Sequence[int]) -> None:
    if not images or len(images) != len(times_s):
        raise InvalidValueError(
            f"{counted(len(images), 'image')} at {counted(len(times_s), 'time')}",
            expected="one time for each",
        )
    if len(times_s) > 1 and not np.min(np.diff(times_s)) > 0.0:
        raise InvalidValueError(
            "frames of one magnification whose times do not grow",
            expected="a time of its own for each, in the order of time",
            do="give --frame-interval, or record anew",
        )
    shapes = sorted({image.shape for image in images})
    if len(shapes) > 1 or len(shapes[0]) != 2:
        raise InvalidValueError(f"images of shapes {shapes}", expected="grey images of one size")
    if not reference or not all(0 <= k < len(images) for k in reference):
        raise InvalidValueError(
            f"reference frames {list(reference)}", expected=f"indices from 0 to {len(images) - 1}"
        )


def _check_timing(
    timing: ScanTiming | None, times_s: Sequence[float]
) -> tuple[ScanTiming | None, tuple[str, ...]]:
    """Treat frames as instants, with a remark, if their times cannot be those of their scans."""
    if timing is None or len(times_s) < 2:
        return timing, ()
    interval_s = float(np.min(np.diff(times_s)))
    if interval_s >= INTERVAL_MIN * timing.acquisition_time_s:
        return timing, ()
    return None, (
        f"frames are {interval_s:.3g} s apart and take {timing.acquisition_time_s:.3g} s each, so their times are not "
        "those of the scans: each frame is treated as an instant, and the drift within it stays",
    )


def _invert(image: AnyImage) -> AnyImage:
    """Return the negative: a dark beam becomes a bright one. It is the same for all images of a type."""
    return np.asarray(np.invert(image) if image.dtype.kind == "u" else np.negative(image))


def _check_length(undeformed: UndeformedBeam, length_m: float, camera: ScanCamera) -> None:
    """Refuse a length that contradicts what is seen."""
    axis, whole = undeformed.axis, bool(np.isfinite(undeformed.length_m))
    # Where only a part of the beam is in view, it cannot be longer than all of it.
    seen_m = undeformed.length_m if whole else axis.visible_m[1] - axis.visible_m[0]
    ends_m = undeformed.length_sigma_m if whole else undeformed.zero_sigma_m
    scale = scale_covariance(camera, seen_m * axis.direction, np.zeros(2))[:2, :2]
    maker_m = MAKER_TOLERANCE / np.sqrt(3.0) * length_m
    sigma_m = float(np.sqrt(ends_m**2 + axis.direction @ scale @ axis.direction + maker_m**2))
    difference_m = seen_m - length_m
    if (abs(difference_m) if whole else difference_m) > LENGTH_SIGMAS * sigma_m:
        raise InvalidValueError(
            f"a length of {1e6 * length_m:.4g} um for a cantilever that is {'' if whole else 'at least '}"
            f"{1e6 * seen_m:.4g} um long according to the calibration",
            expected=f"at most {1e6 * LENGTH_SIGMAS * sigma_m:.2g} um of difference ({LENGTH_SIGMAS:g} sigma: "
            f"both ends, the scale, and {100.0 * MAKER_TOLERANCE:g} % for the maker)",
            do="check --length, --base and --tip, and whether the calibration is that of this microscope",
        )


def _make_rough_axis(strip: Strip, plane: PlaneMap, length_m: float) -> Axis:
    """Convert the strip to the sem frame, with provisional arc lengths."""
    ends = plane.sem_of(np.stack([strip.base_px, strip.tip_px]))
    seen_m = float(np.hypot(*(ends[1] - ends[0])))
    direction = (ends[1] - ends[0]) / seen_m
    half_m = strip.half_width_px * plane.pixel_m
    base_at = length_m - seen_m if strip.tip_seen and not strip.base_seen else 0.0
    origin = ends[0] - base_at * direction
    visible = (base_at, base_at + seen_m)
    return Axis(origin, direction, half_m, visible, strip.base_seen, strip.tip_seen)


def _extend_to_apex(axis: Axis, plane: PlaneMap, image: AnyImage) -> Axis:
    """Move the end from where the edges of the beam fade to the apex of its tip."""
    if not axis.end_seen:
        return axis
    along, across = axis.coordinates(plane.x_m.ravel(), plane.y_m.ravel())
    samples = along, across, image.ravel().astype(np.float64)
    first, last = axis.visible_m
    apex_m = find_apex(samples, last, axis.half_width_m, plane.pixel_m)
    return replace(axis, visible_m=(first, max(apex_m, last - axis.half_width_m)))


def _compare_shapes(given: Shape, common: Shape) -> tuple[Shape, str | None]:
    """Return the given shape with the uncertainty that the frames' common one shows, and a remark if it is wrong."""
    deviation = abs(common.value - given.value)
    if not deviation > SHAPE_SIGMAS * common.sigma:
        return given, None
    # What is wrong is known, and yet the given shape was asked for: it is stated as if it were a sigma.
    return replace(given, sigma=deviation, relative=common.relative), (
        f"the beam does not bend as --shape says: its third order is {common.value:.2f} +- {common.sigma:.2f} of the "
        f"deflection and not {given.value:.2f}; the sigmas contain the difference, and --shape free avoids it"
    )


def _collect_notes(
    undeformed: UndeformedBeam,
    frames: Sequence[Deflection],
    background: Background,
    reference: tuple[int, ...],
    settings: SeriesSettings,
) -> tuple[str, ...]:
    path = background.path
    notes = list(undeformed.notes)
    if unseen := sum(not np.isfinite(f.deflection_m) for f in frames):
        notes.append(
            f"the beam is not found in {unseen} of {counted(len(frames), 'frame')}; its end is looked for up to "
            f"{1e6 * settings.reach_m:.3g} um from where it rests"
        )
    if lost := sum(not _is_tied(path, frame, reference) for frame in range(len(path))):
        left = (
            "they rest on the base alone"
            if undeformed.axis.base_seen
            else "neither drift nor base holds them, and their sigma says so"
        )
        notes.append(
            f"no drift in {lost} of {counted(len(path), 'frame')} ({_name_reasons(path)}): {left}"
        )
        notes.extend(_name_lost_regions(background))
    if abs(undeformed.length_m / settings.length_m - 1.0) > MAKER_TOLERANCE:
        notes.append(
            f"according to the calibration the cantilever is {1e6 * undeformed.length_m:.4g} um long, not "
            f"{1e6 * settings.length_m:.4g} um: check the length, or give base and tip"
        )
    return tuple(notes)


def _is_tied(path: DriftPath, frame: int, reference: tuple[int, ...]) -> bool:
    """Whether the drift between a frame and the reference frames is known."""
    return bool(path.trusted[[frame, *reference]].all())


def _name_reasons(path: DriftPath) -> str:
    """Return why frames have no drift, the most frequent reason first."""
    counts = Counter(
        omit_numbers(update.reason) or "after a frame whose drift was only predicted"
        for update, trusted in zip(path.updates, path.trusted, strict=True)
        if not trusted
    )
    return "; ".join(reason for reason, _ in counts.most_common())


def _name_lost_regions(background: Background) -> list[str]:
    """Return which parts of the ground were not followed in most frames, and why; the worst first."""
    lost = [r for r in background.regions if 2 * r.lost > len(r.failures)]
    if not lost:
        return []
    lost.sort(key=lambda region: -region.lost)
    named = []
    for region in lost[:NAMED_MAX]:
        left, top, right, bottom = region.box_px
        named.append(f"x {left} to {right}, y {top} to {bottom} px ({region.reason})")
    more = ["..."] if len(lost) > len(named) else []
    return [
        f"{len(lost)} of {counted(len(background.regions), 'region')} of the ground could not be followed in most "
        "frames: " + "; ".join(named + more)
    ]


class _SeriesMeasurement:
    """The images of a series and the measurement of each."""

    def __init__(
        self,
        images: Sequence[AnyImage],
        plane: PlaneMap,
        path: DriftPath,
        settings: SeriesSettings,
        rough: Axis,
    ) -> None:
        self._images, self._plane, self._path = images, plane, path
        self._settings = settings
        self._pixels = self._near_beam(rough)
        self._seen: dict[int, tuple[Array, Array]] = {}

    def _near_beam(self, axis: Axis) -> Indices:
        """Return flat indices of the pixels that may show the beam in any frame."""
        along, across = axis.coordinates(self._plane.x_m, self._plane.y_m)
        moved = float(np.max(np.hypot(*self._path.drift_m.T), initial=0.0))
        room = 5.0 * REACH_PX * self._plane.pixel_m + moved
        wide = axis.half_width_m + room + self._settings.reach_m
        first, last = axis.visible_m
        near = (np.abs(across) < wide) & (along > first - room) & (along < last + room)
        return np.flatnonzero(near)

    def sample(self, axis: Axis, frame: int) -> PixelSamples:
        """Return pixels in coordinates of the axis, corrected for drift, and their grey levels."""
        x, y = self._plane.specimen(self._pixels, self._path[frame].raster)
        grey = self._images[frame].ravel()[self._pixels].astype(np.float64)
        return (*axis.coordinates(x, y), grey)

    def deflections(
        self, undeformed: UndeformedBeam, reference: tuple[int, ...], on_frame: Callable[[], None]
    ) -> tuple[list[Deflection], Shape, tuple[str, ...]]:
        """Measure all frames in the order of time, each starting from the last; fit their shape.

        Also returns remarks: where the frames do not bend as the shape that was given, or what was measured is not a
        clamped beam.
        """
        edges, free, ends_m, bases = [], [], [], []
        terms = np.zeros(2)
        for frame in range(len(self._images)):
            samples = self.sample(undeformed.axis, frame)
            ends_m.append(self._find_end(samples, undeformed))
            bases.append(self._find_base(samples, undeformed))
            terms = np.zeros(2) if frame in reference else self._nearby(samples, undeformed, terms)
            edges.append(self._edges(samples, undeformed, terms))
            free.append(self._bending(frame, edges[-1], undeformed, reference, None))
            if np.isfinite(free[-1].deflection_m):
                terms = free[-1].coefficients[2:]
            on_frame()
        shape = parse_shape(self._settings.shape)
        others = [f for k, f in enumerate(free) if k not in reference]
        variances = [free[k].covariance[1, 1] for k in reference]
        common = fit_common_shape(
            others, float(np.sqrt(np.mean(variances) / len(variances))), len(variances)
        )
        misfit = None
        if shape is None:
            u = undeformed.model.centres_m / self._settings.length_m
            shape = expect_point_load(common, locate_load(u, others))
        else:
            shape, misfit = _compare_shapes(shape, common)
        bendings = [
            self._bending(k, fit, undeformed, reference, shape) for k, fit in enumerate(edges)
        ]
        doubts = [
            misfit,
            self._describe_end_slip(np.array(ends_m), reference),
            self._describe_base_slip(bases, reference),
        ]
        results = [self._result(k, one, undeformed) for k, one in enumerate(bendings)]
        return results, shape, tuple(doubt for doubt in doubts if doubt is not None)

    def _find_end(self, samples: PixelSamples, undeformed: UndeformedBeam) -> float:
        """Find roughly where the strip ends in a frame, m; NaN if its end is out of view."""
        axis = undeformed.axis
        if not axis.end_seen:
            return float("nan")
        return find_apex(samples, axis.visible_m[1], axis.half_width_m, self._plane.pixel_m)

    def _find_base(self, samples: PixelSamples, undeformed: UndeformedBeam) -> StepFit:
        """Find where the holder begins in a frame; infinite sigma if that does not show."""
        axis = undeformed.axis
        if not axis.base_seen:
            return StepFit(float("nan"), float("inf"), 0.0)
        return fit_base_edge(samples, axis.visible_m[0], undeformed.model, self._plane.pixel_m)

    def _measure_slip(self, places_m: Array, reference: tuple[int, ...]) -> Array:
        """Measure by how much a place lies elsewhere than in the references, m, where the drift is known."""
        tied = [_is_tied(self._path, frame, reference) for frame in range(len(places_m))]
        slip_m = places_m - np.mean(places_m[list(reference)])
        others = np.delete(slip_m, reference)[np.delete(tied, reference)]
        return np.asarray(others[np.isfinite(others)], dtype=np.float64)

    def _describe_end_slip(self, ends_m: Array, reference: tuple[int, ...]) -> str | None:
        """Return a remark if the end moves along the strip, as that of a pusher does."""
        slip_m = np.abs(self._measure_slip(ends_m, reference))
        if not (slip_m.size and np.median(slip_m) > SLIP_PX * self._plane.pixel_m):
            return None
        return (
            f"the end of what was measured moves along it, by {1e6 * np.median(slip_m):.2g} um in half of the "
            "frames, and that of a clamped beam does not: is it the pusher? Look at --strip, or give base and tip"
        )

    def _describe_base_slip(
        self, bases: Sequence[StepFit], reference: tuple[int, ...]
    ) -> str | None:
        """Return a remark if the base moves against the ground."""
        slip_m = np.abs(self._measure_slip(np.array([b.place_m for b in bases]), reference))
        sigma_m = float(np.median([b.sigma_m for b in bases]))
        limit_m = max(BASE_SLIP_PX * self._plane.pixel_m, BASE_SLIP_SIGMAS * sigma_m)
        if not (slip_m.size and np.median(slip_m) > limit_m):
            return None
        return (
            f"the base of what was measured moves, by {1e9 * np.median(slip_m):.2g} nm in half of the frames, and "
            "that of a cantilever stands still: is it the pusher? Look at --strip, or give base and tip"
        )

    def _nearby(self, samples: PixelSamples, undeformed: UndeformedBeam, terms: Array) -> Array:
        """Find a bending to start from: the one with most contrast along the beam's edges."""
        model, reach = undeformed.model, self._settings.reach_m
        along, across, grey = samples
        line = evaluate_bending(np.array([1.5, -0.5]), along / self._settings.length_m)
        centres = model.centres_m
        inside = (along > centres[0]) & (along < centres[-1])
        inside &= np.abs(across) < model.half_width_m + reach + model.reach_m
        across, line, grey = across[inside], line[inside], grey[inside]
        now, step = float(terms.sum()), 0.5 * model.reach_m
        count = int(np.ceil(2.0 * reach / step))
        ends = now + step * np.arange(-count, count + 1)
        best, found = -np.inf, now
        for end in ends[np.abs(ends) <= reach]:
            away = np.abs(across - end * line) - model.half_width_m
            within = (away < 0.0) & (away > -model.reach_m)
            outside = (away > 0.0) & (away < model.reach_m)
            if not (within.any() and outside.any()):
                continue
            contrast = float(grey[within].mean() - grey[outside].mean())
            if contrast > best:
                best, found = contrast, float(end)
        return terms if abs(found - now) < step else found * np.array([1.5, -0.5])

    def _edges(self, samples: PixelSamples, undeformed: UndeformedBeam, terms: Array) -> EdgeFit:
        """Fit the edges of a frame, then twice again around the bending that was found."""
        length, model = self._settings.length_m, undeformed.model
        u = model.centres_m / length
        fit = fit_edges(*samples, model, undeformed.across_m + evaluate_bending(terms, u)[:, None])
        for _ in range(2):
            rough = fit_bending(
                u, fit.across_m - undeformed.across_m, fit.sigma_m, length, UNTRACKED_M
            )
            if not np.isfinite(rough.deflection_m):
                break
            r0, r1 = rough.coefficients[:2]
            expected = r0 + r1 * u + rough.curve(u)
            fit = fit_edges(*samples, model, undeformed.across_m + expected[:, None])
        return fit

    def _bending(
        self,
        frame: int,
        fit: EdgeFit,
        undeformed: UndeformedBeam,
        reference: tuple[int, ...],
        shape: Shape | None,
    ) -> Bending:
        """Fit the bending of a frame against the reference."""
        length, normal, path = self._settings.length_m, undeformed.axis.normal, self._path
        covariance = path.covariance[:, :2, :2]
        # It is infinite where nothing was tracked at all.
        covariance = np.where(np.isfinite(covariance), covariance, UNTRACKED_M**2)
        before = np.mean([normal @ covariance[k] @ normal for k in reference]) / len(reference)
        offset = float(np.sqrt(max(normal @ covariance[frame] @ normal + before, 0.0)))
        if not _is_tied(path, frame, reference):
            offset = max(offset, UNTRACKED_M)
        # A single reference frame, compared with itself, has only its own noise.
        alone = frame in reference and len(reference) == 1
        noise = fit.sigma_m if alone else np.hypot(fit.sigma_m, undeformed.sigma_m)
        ratio = fit.step / np.maximum(undeformed.step, 1e-12)
        same = (ratio > SAME_STEP[0]) & (ratio < SAME_STEP[1]) & np.isfinite(undeformed.sigma_m)
        noise = np.where(same, noise, np.inf)
        moved = fit.across_m - undeformed.across_m
        noise = np.where(find_unchanged_width(moved, noise)[:, None], noise, np.inf)
        u = undeformed.model.centres_m / length
        found = fit_bending(u, moved, noise, length, offset, shape)
        if abs(found.deflection_m) > DEFLECTION_ABSURD * self._settings.reach_m:
            # This is not the beam: treat the frame as if nothing had been seen.
            return fit_bending(u, moved, np.full_like(noise, np.inf), length, offset, shape)
        return found

    def _result(self, frame: int, bending: Bending, undeformed: UndeformedBeam) -> Deflection:
        length, axis, camera = self._settings.length_m, undeformed.axis, self._plane.camera
        value, noise = bending.deflection_m, bending.sigma_m
        known = 0.0 if np.isnan(value) else value
        scale = scale_covariance(camera, known * axis.normal, np.zeros(2))[:2, :2]
        # Where the beam ends is common to all frames, as the scale: its slope there tells the effect.
        ends = np.nan_to_num(bending.coefficients[2:]) @ [2.0, 3.0] / length
        shared = axis.normal @ scale @ axis.normal + (ends * undeformed.zero_sigma_m) ** 2
        sigma = float(np.sqrt(noise**2 + shared))
        factor, relative = (
            length / undeformed.length_m,
            undeformed.length_sigma_m / undeformed.length_m,
        )
        terms = np.nan_to_num(bending.coefficients[2:])
        end = axis.point(np.array([locate_end(terms, length)]), np.array([known]))
        along = np.linspace(*axis.visible_m, LINE_POINTS)
        line = axis.point(along, evaluate_bending(terms, along / length))
        drift = self._path.drift_m[frame]
        return Deflection(
            value,
            sigma,
            noise,
            factor * value,
            float(factor * np.hypot(noise, relative * known)),
            self._plane.raw_of(end + drift)[0],
            self._plane.raw_of(line + drift),
            bending,
        )
