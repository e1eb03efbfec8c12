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

"""What is wrong with the layout of a figure: texts over each other or cut off, and legends over lines."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

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
                if three or not axes.axison or not low - room <= tick.get_loc() <= high + room:
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
    for axes in figure.axes:
        legend = axes.get_legend()
        if legend is None or axes.name == "3d":
            continue
        frame = legend.get_window_extent(renderer)
        for line in axes.lines:
            at = line.get_transform().transform(line.get_xydata())
            at = at[np.isfinite(at).all(axis=1)]
            if line.get_linestyle() != "None" and len(at) > 1:
                # Also where a line runs between its points.
                steps = np.linspace(0.0, 1.0, 20)[:, None, None]
                at = (at[:-1] + steps * np.diff(at, axis=0)).reshape(-1, 2)
            if any(frame.contains(*point) for point in at):
                wrong.append(f"the legend over {line.get_label()!r}")
    for (one, first), (other, second) in combinations(boxes, 2):
        shared = Bbox.intersection(first, second)
        if shared is None:
            continue
        smaller = min(first.width * first.height, second.width * second.height)
        if shared.width * shared.height > SHARED * smaller:
            wrong.append(f"{one!r} over {other!r}")
    return wrong
