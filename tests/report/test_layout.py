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

"""The layout of figures: no text over another one or cut off at the edge, and names on all axes."""

from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from scipy.spatial import ConvexHull

from semcal_ros.core.calibration.calibrate import CalibrationResult
from semcal_ros.report import write_calibration_report
from semcal_ros.report.ball_figures import plot_ball
from semcal_ros.report.html import encode
from semcal_ros.report.html.style import create_figure, style_axes

pytestmark = pytest.mark.slow

# Boxes have some air around the letters: this much of the smaller one may lie in the other.
SHARED = 0.15
EDGE_PX = 1.0


def hidden_ticks(figure: Figure) -> set[int]:
    """Identities of the tick labels that are not drawn; of a 3D box all, since it places them while it draws."""
    hidden: set[int] = set()
    for axes in figure.axes:
        three = axes.name == "3d"
        axis_of: Any = axes
        for axis in (axes.xaxis, axes.yaxis, *([axis_of.zaxis] if three else [])):
            low, high = sorted(axis.get_view_interval())
            room = 1e-6 * (high - low)
            for tick in axis.get_major_ticks() + axis.get_minor_ticks():
                if three or not low - room <= tick.get_loc() <= high + room:
                    hidden |= {id(tick.label1), id(tick.label2)}
    return hidden


def faults(figure: Figure) -> list[str]:
    """What is wrong with the layout."""
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]  # of Agg
    hidden = hidden_ticks(figure)
    boxes = []
    for artist in figure.findobj(Text):
        assert isinstance(artist, Text)
        if not (artist.get_visible() and artist.get_text().strip()):
            continue
        if id(artist) in hidden:
            continue
        boxes.append((artist.get_text(), artist.get_window_extent(renderer)))
    wrong = [
        f"{text!r} is cut off"
        for text, box in boxes
        if box.x0 < -EDGE_PX
        or box.y0 < -EDGE_PX
        or box.x1 > figure.bbox.x1 + EDGE_PX
        or box.y1 > figure.bbox.y1 + EDGE_PX
    ]
    for (one, first), (other, second) in combinations(boxes, 2):
        shared = Bbox.intersection(first, second)
        if shared is None:
            continue
        smaller = min(first.width * first.height, second.width * second.height)
        if shared.width * shared.height > SHARED * smaller:
            wrong.append(f"{one!r} over {other!r}")
    return wrong


def test_a_broken_layout_is_seen() -> None:
    figure = create_figure()
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.2, 0.2, 0.7, 0.7))
    style_axes(axes, xlabel="magnification", ylabel="px")
    assert faults(figure) == []
    axes.set_title("a title that is far too long for a figure of four inches, and is cut off")
    assert any("is cut off" in fault for fault in faults(figure))
    axes.set_title("")
    axes.text(0.5, -0.13, "over the label of the axis", transform=axes.transAxes, ha="center")
    assert any("over 'magnification'" in f or "'magnification' over" in f for f in faults(figure))


def test_figures_of_the_calibration_report(
    result: CalibrationResult, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    figures: list[Figure] = []
    whole = encode.encode_png

    def keep(figure: Figure, dpi: float, **options: Any) -> bytes:
        figures.append(figure)
        return whole(figure, dpi, **options)

    monkeypatch.setattr(encode, "encode_png", keep)
    write_calibration_report(result, tmp_path / "r.html", paper=True)
    assert len(figures) > 20
    for figure in figures:
        # Maps over the field have numbers on their lines, which may come near each other.
        assert [f for f in faults(figure) if not _between_numbers(f)] == []
        for axes in figure.axes:
            named = axes.get_xlabel() or axes.get_ylabel() or axes.get_title() or not axes.axison
            assert named, "axes without a name"


def _between_numbers(fault: str) -> bool:
    """Whether a fault is between two numbers on the lines of a map."""
    one, over, other = fault.partition(" over ")
    return bool(over) and all(part.strip("'").replace(".", "").isdigit() for part in (one, other))


def test_the_figure_of_a_ball() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = 450e-9 * directions
    inliers = np.arange(300) < 280
    # What the figure looks at.
    sphere = SimpleNamespace(
        inliers=inliers, centre_m=np.zeros(3), radius_m=450e-9, residuals_m=rng.normal(0, 1e-9, 300)
    )
    mesh = SimpleNamespace(vertices_m=points, faces=ConvexHull(directions).simplices)
    ball: Any = SimpleNamespace(
        sphere=sphere, mesh=mesh, diameter_m=899.84e-9, interval_m=(892.48e-9, 907.2e-9)
    )
    structure: Any = SimpleNamespace(points_m=points)
    assert faults(plot_ball(structure, ball)) == []
