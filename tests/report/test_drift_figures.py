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

"""The figure of a drift path: what it shows, in which units, and that its texts stay apart."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.text import Text

from semcal_ros.core.drift.estimates import DriftPath, DriftStatus
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.report.drift_figures import plot_drift, write_drift_figure
from tests.helpers.drift_scenes import make_drift_update

REASONS = (
    "image: blank (all pixels at 20)",
    "image: blank (all pixels at 255)",
    "no shift stands out: featureless, or another place",
    "ambiguous: shifts (1.0, -2.0) and (-30.0, 4.0) px explain the image equally well",
    "shift is 529 deviations from the prediction",
    "images differ (noise-corrected correlation 0.31)",
    "jump of (200, 3) px: a move of the stage with $\\frac{ in its text",
)


def sample(
    frames: int = 40, size_m: float = 200e-9, interval_s: float = 1.0, reasons: Sequence[str] = ()
) -> DriftPath:
    t = np.linspace(0.0, 1.0, frames)
    drift = size_m * np.stack([t, 0.3 * np.sin(5.0 * t) - t], axis=1)
    sigma = np.linspace(0.0, 0.02 * size_m, frames)
    velocity = np.gradient(drift, interval_s, axis=0) if frames > 1 else np.zeros((1, 2))
    updates = [
        make_drift_update(
            time_s=50.0 + interval_s * k,
            drift_m=drift[k],
            velocity_m_s=velocity[k],
            covariance=sigma[k] ** 2 * np.diag([1.0, 4.0, 0.01, 0.01]),
            status=DriftStatus.TRACKED if k else DriftStatus.KEYFRAME,
            px_from_unit=np.eye(2) / 40e-9,
        )
        for k in range(frames)
    ]
    for k, reason in enumerate(reasons):
        updates[4 + 3 * k] = replace(
            updates[4 + 3 * k],
            status=DriftStatus.COASTING,
            rejection=Rejection(MatchFailure.AMBIGUOUS, reason),
            residual=float("nan"),
        )
    return DriftPath(updates)


def axes_of(figure: Figure, label: str) -> Axes:
    (found,) = (a for a in figure.axes if a.get_ylabel().startswith(label))
    return found


def key_of(figure: Figure) -> list[str]:
    legends = [a.get_legend() for a in figure.axes if not a.axison]
    return [text.get_text().replace("\n", " ") for text in legends[0].get_texts()]


def line_of(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    (line,) = (x for x in axes.lines if x.get_label() == label)
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def test_curves_are_the_path_in_readable_units():
    path = sample()
    figure = plot_drift(path)
    for label, values in (("drift (nm)", path.drift_m), ("drift rate (nm/s)", path.velocity_m_s)):
        axes = axes_of(figure, label)
        for k, name in enumerate("xy"):
            time, shown = line_of(axes, name)
            np.testing.assert_allclose(time, np.arange(40.0))
            known = np.isfinite(shown)
            np.testing.assert_allclose(shown[known], 1e9 * values[known, k])
            # Of the first frame the rate is not known; the drift is zero by definition.
            assert known.sum() == (39 if "rate" in label else 40)


def test_bands_hold_95_percent():
    path = sample()
    axes = axes_of(plot_drift(path), "drift (nm)")
    x_band = next(c for c in axes.collections if isinstance(c, PolyCollection))
    corners = x_band.get_paths()[0].vertices
    at_end = corners[np.isclose(corners[:, 0], 39.0), 1]
    half = 1.96e9 * path.sigma_m[-1, 0]
    end = 1e9 * path.drift_m[-1, 0]
    assert at_end.min() == pytest.approx(end - half)
    assert at_end.max() == pytest.approx(end + half)


def test_a_band_that_explodes_does_not_flatten_the_curve():
    path = sample(reasons=REASONS[:2])
    updates = list(path.updates)
    updates[4] = replace(updates[4], covariance=np.eye(4))  # a metre: nothing is known
    axes = axes_of(plot_drift(DriftPath(updates)), "drift (nm)")
    assert np.ptp(axes.get_ylim()) < 3 * 1e9 * np.ptp(path.drift_m)


@pytest.mark.parametrize(
    ("size_m", "unit"), [(3e-10, "nm"), (5e-8, "nm"), (4e-6, "µm"), (2e-3, "mm")]
)
def test_prefix_follows_the_size(size_m, unit):
    figure = plot_drift(sample(size_m=size_m, interval_s=0.1))
    assert axes_of(figure, f"drift ({unit})")
    assert any(a.get_xlabel() == f"drift along x ({unit})" for a in figure.axes)


@pytest.mark.parametrize(("interval_s", "unit"), [(1.0, "(s)"), (60.0, "(min)"), (900.0, "(h)")])
def test_long_recordings_are_told_in_minutes_or_hours(interval_s, unit):
    figure = plot_drift(sample(interval_s=interval_s))
    assert axes_of(figure, "residual").get_xlabel().endswith(unit)


def test_pixels_where_there_is_no_camera():
    path = sample(size_m=3.0)
    figure = plot_drift(DriftPath([replace(u, calibrated=False) for u in path.updates]))
    assert axes_of(figure, "drift (px)")
    assert axes_of(figure, "drift rate (px/s)")


def test_frames_that_were_not_used_are_counted_by_reason_and_marked_in_each_plot():
    path = sample(reasons=REASONS)
    figure = plot_drift(path)
    key = key_of(figure)
    assert key[0] == "33 of 40 frames tracked, 1 of them as key frame"
    assert key[1] == "2 not used: image: blank (all pixels at …)"
    assert key[-1] == "3 not used: other reasons"
    assert sum(int(text.split()[0]) for text in key[1:]) == len(REASONS)
    coasting = np.flatnonzero(~path.accepted)
    for label in ("drift (", "drift rate", "residual"):
        axes = axes_of(figure, label)
        low = [x for x in axes.lines if np.all(np.asarray(x.get_ydata()) == 0.04)]
        marked = np.concatenate([np.asarray(x.get_xdata()) for x in low])
        np.testing.assert_allclose(np.sort(marked), coasting)
    plane = axes_of(figure, "drift along y")
    outlined = [c for c in plane.collections if not len(c.get_facecolors())]
    assert sum(len(c.get_offsets()) for c in outlined) == len(coasting)


def test_nothing_is_marked_where_all_were_used():
    assert key_of(plot_drift(sample())) == ["40 of 40 frames tracked, 1 of them as key frame"]


@pytest.mark.parametrize(
    "path",
    [
        sample(),
        sample(reasons=REASONS),
        sample(frames=2),
        sample(frames=1),
        sample(frames=500, size_m=40e-6, interval_s=100.0, reasons=REASONS * 10),
    ],
    ids=["plain", "refusals", "two", "one", "long"],
)
def test_texts_do_not_overlap_and_stay_on_the_page(path, monkeypatch):
    figure = plot_drift(path)
    drawn: dict[Text, None] = {}
    draw = Text.draw

    def noted(text: Text, renderer: object) -> None:
        if text.get_visible() and text.get_text().strip():
            drawn[text] = None
        draw(text, renderer)

    figure.canvas.draw()  # settles the layout
    monkeypatch.setattr(Text, "draw", noted)
    figure.canvas.draw()
    assert len(drawn) > 20
    page = figure.bbox
    boxes = []
    for text in drawn:
        box = text.get_window_extent()
        assert box.x0 >= page.x0 - 1 and box.x1 <= page.x1 + 1, text.get_text()
        assert box.y0 >= page.y0 - 1 and box.y1 <= page.y1 + 1, text.get_text()
        boxes.append((text.get_text(), box.padded(-1.0)))
    overlapping = [
        (a, b) for (a, one), (b, two) in itertools.combinations(boxes, 2) if one.overlaps(two)
    ]
    assert overlapping == []


@pytest.mark.parametrize(
    ("suffix", "start"), [(".png", b"\x89PNG"), (".SVG", b"<?xml"), (".pdf", b"%PDF")]
)
def test_files_of_each_kind(tmp_path: Path, suffix, start):
    file = tmp_path / f"drift{suffix}"
    write_drift_figure(sample(12), file)
    assert file.read_bytes().startswith(start)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


def test_the_figure_names_the_recording_and_the_size_of_a_pixel(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(Figure, "suptitle", lambda _figure, text, **_options: seen.append(text))
    write_drift_figure(sample(4), tmp_path / "drift.svg", "gold")
    assert seen == ["gold, 40 nm per px"]


def test_an_empty_path_is_refused():
    with pytest.raises(InvalidValueError, match="without frames"):
        plot_drift(DriftPath([]))
