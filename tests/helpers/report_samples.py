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

"""A small microscope, its views, and a reader of pages, for the tests of the report."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.calibration.views import FoundView, GridView, RejectedView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.corners import LatticeDetection, LatticeStatus
from semcal_ros.core.errors import Rejection

SIZE = 256
DISPLAY_M = 0.12
HOSTILE = "<script>alert('x')</script>\"><img src=//evil.example/a>"
VOID = {"meta", "img", "image", "path", "rect", "circle", "line", "br", "link", "input"}


def unused(name: str, magnification: float, reason: str, image: Any = None) -> RejectedView:
    """A view without a grid."""
    return RejectedView(name, magnification, Rejection(LatticeStatus.NO_LATTICE, reason), image)


class Page(HTMLParser):
    """Tags of a page, with a check that they nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open and self.open.pop() == tag, f"</{tag}> does not match"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def camera_at(g: float) -> ScanCamera:
    u = np.log10(g / 100.0)
    return ScanCamera(
        g, 1.02 * g * SIZE / DISPLAY_M, 1.003, 0.001, 122.0, 131.0, 50.0,
        0.008 - 0.003 * u, 0.0005, 118.0, 133.0, SIZE / 2, SIZE, SIZE,
    )  # fmt: skip


def grid_view(g: float, tilt_deg: float, azimuth_deg: float, rng: np.random.Generator) -> GridView:
    camera = camera_at(g)
    square = 22.0 / camera.m
    ij = np.stack(np.meshgrid(np.arange(-9, 10), np.arange(-9, 10)), axis=-1).reshape(-1, 2)
    board = ij * square
    azimuth = np.radians(azimuth_deg)
    axis = np.radians(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    rotation = cv2.Rodrigues(axis)[0]
    points = np.column_stack([board, np.zeros(len(board))]) @ rotation.T
    xy = camera.project(points) + 0.05 * rng.normal(size=(len(board), 2))
    inside = np.all((xy > 3.0) & (xy < SIZE - 4.0), axis=1)
    sigma = np.full(int(inside.sum()), 0.05)
    return GridView(g, board[inside], xy[inside], sigma, f"frame {g:g} {azimuth_deg:g}")


def found_of(view: GridView, image: NDArray[Any] | None = None) -> FoundView:
    pixels = np.full((SIZE, SIZE), 90, dtype=np.uint8) if image is None else image
    n = len(view.image_xy)
    detection = LatticeDetection(
        np.zeros((n, 2), dtype=np.int64), view.image_xy, view.sigma_px, 22.0, (SIZE, SIZE)
    )
    return FoundView(view.name, view.magnification, pixels, detection)
