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

"""Find the bar with text that a microscope writes below a picture, where no metadata tell its height.

A scanned row has noise, so that none of its grey values is the commonest by far. A row of a bar is mostly of one
value, that of its background, and its text stands out and stays from image to image. Below a specimen that ends within
the field, a detector may be clipped as evenly: nothing stands out there, or nothing that stays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.images import without_databar

# Part of a row that has its commonest value: in bars at least a half, but where text is dense; in pictures of 8 bits at
# most a third, but where they are clipped.
_OF_BAR, _OF_BAR_TYPICALLY, _OF_PICTURE = 0.45, 0.6, 0.4
# Rows of a bar, at least and as a part of the picture at most.
_FEWEST, _LARGEST_PART = 8, 0.25
# Text is drawn to be read: it differs from its background by so much of the range of the grey levels, and is so much of
# the bar at least. Noise of a detector that is clipped at its lower limit does not reach a quarter of the range.
_CONTRAST, _LEAST_TEXT = 0.25, 0.002
# Part of the text that must be the same in the next image. Text that moves since a number before it has got longer
# falls on itself in a fifth or more; of grey levels with a noise of 3 levels, 1 / (2 * 3 * sqrt(pi)) = 0.09 are the
# same again.
_STAYS = 0.1


def _is_even(pixels: NDArray[Any]) -> bool:
    return bool(pixels.min() == pixels.max())


def _one_channel(image: NDArray[Any]) -> NDArray[Any]:
    return image[..., 1] if image.ndim == 3 else image


def _is_text(bar: NDArray[Any], span: float) -> NDArray[np.bool_]:
    background = float(np.argmax(np.bincount(bar.ravel())))
    return np.asarray(np.abs(bar.astype(float) - background) > _CONTRAST * span)


def find_databar(image: NDArray[Any]) -> int:
    """Return the number of rows of a bar with text at the bottom, 0 where there is none.

    It fails where text is so dense that none of a row's grey values is the commonest by far, and for bars whose
    background has noise, as of a JPEG of low quality.

    Parameters
    ----------
    image
        (h, w) grey levels or (h, w, 3) colours of 8 or 16 bits, as stored.
    """
    if image.dtype not in (np.uint8, np.uint16):
        return 0
    image = _one_channel(image)
    height = len(image)
    most = int(_LARGEST_PART * height)
    lowest = image[height - min(2 * most, height) :]
    share = np.array([np.bincount(row).max() for row in lowest]) / image.shape[1]
    low = np.flatnonzero(share < _OF_BAR)
    rows = len(share) - 1 - int(low[-1]) if len(low) else len(share)
    if not _FEWEST <= rows <= most or np.median(share[-rows:]) < _OF_BAR_TYPICALLY:
        return 0
    above = share[max(0, len(share) - 2 * rows) : len(share) - rows]
    if np.median(above) >= _OF_PICTURE:
        return 0
    span = float(lowest.max()) - float(lowest.min())
    return rows if np.mean(_is_text(lowest[-rows:], span)) >= _LEAST_TEXT else 0


class DatabarFinder:
    """Finds the bar of the images of a stream, which is decided for all of them that have one size.

    Attributes
    ----------
    rows
        Height of the bar, 0 for none, None while it is not decided.
    candidate
        What the images seen so far suggest: for who has no more of them.
    """

    def __init__(self) -> None:
        self.rows: int | None = None
        self.candidate = 0
        self._size: tuple[int, ...] = ()
        self._bar: NDArray[Any] | None = None

    def find_rows(self, image: NDArray[Any]) -> int | None:
        """Return the rows of a bar below this image, or None if the next image has to tell.

        An image without a bar decides at once, one with a bar by the text that it shares with the next one. Of an image
        that is even, as of a blanked beam, nothing can be told: 0 for now where all of it is, None where its upper half
        is, below which something else may be a bar.
        """
        size = image.shape[:2]
        if size != self._size:
            self._size, self.rows, self.candidate, self._bar = size, None, 0, None
        if self.rows is not None:
            return self.rows
        if _is_even(image[: (len(image) + 1) // 2]):
            return 0 if _is_even(image) else None
        rows = find_databar(image)
        if rows == 0 or self._bar is None:
            self.candidate = rows
        if rows == 0:
            self.rows = 0
        elif self._bar is None:
            self._bar = _one_channel(image)[-rows:].copy()
            return None
        else:
            self.rows = self.candidate = self._common_rows(image, rows)
        self._bar = None
        return self.rows

    def _common_rows(self, image: NDArray[Any], rows: int) -> int:
        """The height that this image and the one before agree on, 0 where the text has not stayed."""
        before = self._bar
        if before is None or len(before) != rows:
            return 0
        grey = _one_channel(image)
        span = float(grey.max()) - float(grey.min())
        text = _is_text(before, span) | _is_text(grey[-rows:], span)
        stays = before == grey[-rows:]
        return rows if np.mean(stays[text]) > _STAYS else 0


class DatabarCutter:
    """Cuts the bar off the images of a stream: of the stated height, or the one that is found in its first images.

    Parameters
    ----------
    stated
        Rows of the bar; None to find it.

    Attributes
    ----------
    rows
        Rows that were cut off the last image.
    """

    def __init__(self, stated: int | None) -> None:
        self._finder = DatabarFinder() if stated is None else None
        self.rows = stated or 0

    @property
    def has_found(self) -> bool:
        """Whether there is a bar that nobody stated."""
        return self._finder is not None and self.rows > 0

    def cut(self, image: NDArray[Any]) -> NDArray[Any] | None:
        """Return an image without the bar, or None while it is not known whether there is one.

        Raises
        ------
        MessageError
            The image has no more rows than the bar was stated to have.
        """
        if self._finder is not None:
            rows = self._finder.find_rows(image)
            if rows is None:
                return None
            self.rows = rows
        return without_databar(image, self.rows)
