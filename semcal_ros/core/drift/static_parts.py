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

"""What does not show the specimen and never moves: what is drawn into the frames, and what else stays in place.

The first is looked for in the first frames and now and then (:mod:`.overlay`), the second as soon as the specimen has
moved (:mod:`.fixed_parts`). Both are left out of a frame, and out of keyframes that were made before they were found.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import AnyImage, Array, Mask
from semcal_ros.core.drift.fixed_parts import (
    find_fixed_parts,
    share_of_gradients,
    to_levels,
)
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.overlay import find_overlay, remove_overlay
from semcal_ros.core.drift.stripes import (
    Stripes,
    find_lone_lines,
    find_stripes,
    suspect_stripes,
)
from semcal_ros.core.drift.thresholds import (
    FIXED_EVERY_FRAMES_MAX,
    FIXED_FIRST,
    FIXED_MOVE_PX_MIN,
    NEWLY_FIXED,
    OVERLAY_EVERY_FRAMES,
    OVERLAY_FIRST_FRAMES,
    OVERLAY_LOOKS_KEPT,
    STRIPE_MOVE_PX_MAX,
)
from semcal_ros.core.registration.agreement import MovingTiles


@dataclass(frozen=True)
class EarlierFrame:
    """A frame to compare later ones with: its image as it came, and its drift (2,), px.

    ``px_from_unit`` (2, 2) tells its scale, and ``since`` is the number of frames that were measured since.
    """

    image: AnyImage
    drift_px: Array
    px_from_unit: Array
    since: int = 0

    def is_like(self, image: AnyImage, px_from_unit: Array) -> bool:
        """Whether an image has its size, colours and scale."""
        is_alike = self.image.shape == image.shape
        return is_alike and bool(np.allclose(self.px_from_unit, px_from_unit))


@dataclass(frozen=True)
class StaticParts:
    """What is known of what never moves.

    Attributes
    ----------
    frames
        Number of frames since the first.
    before
        The last frame as it came, where the next one is compared with it.
    drawn
        (h, w) for how many more looks a pixel is taken for drawn into all frames; None where none is.
    fixed
        (h, w) what else stays in place; None where nothing was found.
    earlier
        The frame that the next one is compared with for that.
    comparisons
        Number of such comparisons.
    stripes
        Directions in which brightness does not move with the specimen.
    anchor
        The frame that later ones are compared with for that: stripes are seen once the specimen has moved by a part of
        their period.
    """

    frames: int = 0
    before: AnyImage | None = None
    drawn: NDArray[np.uint8] | None = None
    fixed: Mask | None = None
    earlier: EarlierFrame | None = None
    comparisons: int = 0
    stripes: Stripes = field(default_factory=Stripes)
    anchor: EarlierFrame | None = None

    @property
    def overlay(self) -> Mask | None:
        """(h, w) what is drawn into all frames; None where nothing was found."""
        return None if self.drawn is None else self.drawn > 0

    def remove_from(self, frame: ScanFrame) -> ScanFrame:
        """The frame with the place of what does not show the specimen filled from around, as far as it is known, and
        without stripes.
        """
        fixed = self._mask(frame.image)
        if fixed is not None:
            frame = replace(frame, image=remove_overlay(frame.image, fixed), fixed=fixed)
        if self.stripes:
            frame = replace(frame, image=self.stripes.remove_from(frame.image))
        return frame

    def _mask(self, image: AnyImage) -> Mask | None:
        """(h, w) the pixels of an image that do not show the specimen, as far as they are known; None where all do."""
        masks = [m for m in (self.overlay, self.fixed) if m is not None]
        masks = [m for m in masks if m.shape == image.shape[:2]]
        fixed = np.logical_or.reduce(masks) if masks else np.zeros(1, dtype=bool)
        return fixed if np.any(fixed) else None

    def look_for_overlay(self, image: AnyImage) -> tuple[StaticParts, bool]:
        """Look in one frame more for what is drawn into them; whether any was found for the first time."""
        frames = self.frames + 1
        parts = replace(self, frames=frames)
        looks = frames <= OVERLAY_FIRST_FRAMES or frames % OVERLAY_EVERY_FRAMES == 0
        if not looks or self.before is None or np.array_equal(self.before, image):
            return parts, False
        found, known = find_overlay(self.before, image), self.drawn
        drawn = np.zeros(image.shape[:2], dtype=np.uint8)
        if known is not None and known.shape == drawn.shape:
            # A part of which one look is not sure has not gone.
            drawn = np.maximum(known, 1) - np.uint8(1)
        if found is not None:
            drawn[found] = OVERLAY_LOOKS_KEPT
        is_new = found is not None and self.overlay is None
        return replace(parts, drawn=drawn if np.any(drawn) else None), is_new

    def keep(self, image: AnyImage) -> StaticParts:
        """Keep a frame as it came, where the next one is compared with it."""
        if self.frames < OVERLAY_FIRST_FRAMES or (self.frames + 1) % OVERLAY_EVERY_FRAMES == 0:
            return replace(self, before=image.copy())
        return self

    def begin_again(self, *, is_in_doubt: bool) -> StaticParts:
        """What is known where the drift goes on from a prediction: no frame before is one to compare with.

        What stays in place is forgotten if it is in doubt: where no frame has matched what was left without it, it may
        be the specimen.
        """
        return replace(self, earlier=None, anchor=None, fixed=None if is_in_doubt else self.fixed)

    def _look_for_stripes(
        self, image: AnyImage, drift_px: Array
    ) -> tuple[StaticParts, Array | None]:
        """Look for stripes in a frame, as it came; and by how much new ones may have pulled the drift, px."""
        anchor = self.anchor
        if (
            anchor is None
            or anchor.image.shape != image.shape
            or (self.stripes.lines and self.stripes.columns)
        ):
            return self, None
        moved_px = drift_px - anchor.drift_px
        pair, mask = [anchor.image, image], self._mask(image)
        if mask is not None:
            pair = [remove_overlay(one, mask) for one in pair]
        found = self.stripes | find_stripes(to_levels(pair[0]), to_levels(pair[1]), moved_px)
        if found == self.stripes:
            return self, None
        # To where they went: nowhere, or by any part of a period.
        return replace(self, stripes=found), moved_px

    @property
    def looks_for_stripes(self) -> bool:
        """Whether it is time to try a frame without what may be stripes."""
        return self.frames <= OVERLAY_FIRST_FRAMES or self.frames % OVERLAY_EVERY_FRAMES == 0

    def suspect_stripes(
        self, image: AnyImage, moving: MovingTiles | None, least: float
    ) -> StaticParts:
        """The same, with stripes in all directions in which a frame, as it came, may have them: of ``least`` of its
        cells, where nothing is ``moving``.
        """
        found = suspect_stripes(to_levels(image), self._hidden(image, moving), least)
        return replace(self, stripes=self.stripes | found)

    def find_lone_lines(self, image: AnyImage, moving: MovingTiles | None) -> Stripes:
        """In which directions a frame, as it came, has lines through all of it, where nothing is ``moving``."""
        return find_lone_lines(to_levels(image), self._hidden(image, moving))

    def _hidden(self, image: AnyImage, moving: MovingTiles | None) -> Mask | None:
        """(h, w) what of an image is not the specimen, or is ``moving``; None where all is and nothing does."""
        hidden = self._mask(image)
        if moving is None:
            return hidden
        height, width = image.shape[:2]
        tool = moving.grown().draw((width, height)) > 0
        return tool if hidden is None else hidden | tool

    def look_for_fixed(
        self, image: AnyImage, drift_px: Array, px_from_unit: Array
    ) -> tuple[StaticParts, Array | None]:
        """Look for what stays in place between a frame that was measured, as it came, and an earlier one, once the
        specimen has moved.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) frame.
        drift_px
            (2,) its drift.
        px_from_unit
            (2, 2) its scale.

        Returns
        -------
        What is known now, and (2,) by how much what is new has pulled the drift, px: towards its own place, by its part
        of the structure. None where nothing is new.
        """
        parts, earlier, pulled_px = self, self.earlier, None
        if earlier is not None and earlier.is_like(image, px_from_unit):
            since = earlier.since + 1
            every = min(1 + max(0, self.comparisons - FIXED_FIRST), FIXED_EVERY_FRAMES_MAX)
            moved_px = drift_px - earlier.drift_px
            if since < every or np.hypot(*moved_px) < FIXED_MOVE_PX_MIN:
                return replace(self, earlier=replace(earlier, since=since)), None
            parts = replace(self, comparisons=self.comparisons + 1)
            parts, pulled_px = parts._look_for_stripes(image, drift_px)
            found = find_fixed_parts(earlier.image, image, moved_px)
            if found is not None:
                known = np.zeros_like(found.stays) if self.fixed is None else self.fixed
                parts = replace(parts, fixed=found.stays | (known & ~found.moves))
                # What is drawn is left out already.
                stays, drawn = found.stays, self.overlay
                if drawn is not None and drawn.shape == stays.shape:
                    stays = stays & ~drawn
                if float(np.mean(stays & ~known)) > NEWLY_FIXED:
                    pulled_px = share_of_gradients(image, stays & ~known) * moved_px
        elif self.fixed is not None and self.fixed.shape != image.shape[:2]:
            parts = replace(self, fixed=None)
        latest = EarlierFrame(image.copy(), drift_px, px_from_unit)
        anchor = parts.anchor
        if (
            anchor is None
            or not anchor.is_like(image, px_from_unit)
            or np.hypot(*(drift_px - anchor.drift_px)) > STRIPE_MOVE_PX_MAX
        ):
            parts = replace(parts, anchor=latest)
        return replace(parts, earlier=latest), pulled_px
