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

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.compare import CalibrationDifference, DifferenceAt
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.files.images.write import PixelScale
from semcal_ros.report import write_calibration_report
from semcal_ros.report.cantilever_figures import plot_poses, plot_strip
from semcal_ros.report.comparison_figure import plot_difference
from semcal_ros.report.html import encode
from semcal_ros.report.html.style import create_figure, set_magnification_axis, style_axes
from semcal_ros.report.reconstruction_figures import plot_ball, plot_relief
from tests.helpers.figure_layout import faults
from tests.helpers.report_samples import DISPLAY_M, SIZE, grid_view

pytestmark = pytest.mark.slow


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
    axes.plot([0.0, 1.0], [0.0, 1.0], label="a line")
    axes.legend(loc="upper right")
    # Neither end of the line lies below the legend.
    axes.set(xlim=(0.0, 0.9), ylim=(0.0, 0.9))
    assert "the legend over 'a line'" in faults(figure)


@pytest.fixture(scope="module")
def narrow() -> CalibrationResult:
    """A calibration over less than a factor of two."""
    rng = np.random.default_rng(8)
    views = [
        grid_view(g, tilt, 90.0 * k + 20.0, rng)
        for g in (5000.0, 6500.0, 9000.0)
        for k, tilt in enumerate((2.0, 25.0, 32.0))
    ]
    return calibrate_views(
        views,
        image_size=(SIZE, SIZE),
        display_width_m=DISPLAY_M,
        options=CalibrationOptions("discrete"),
    )


@pytest.mark.parametrize("which", ["result", pytest.param("narrow", marks=pytest.mark.long)])
def test_figures_of_the_calibration_report(
    which: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    figures: list[Figure] = []
    whole = encode.encode_png

    def keep(figure: Figure, dpi: float, **options: Any) -> bytes:
        figures.append(figure)
        return whole(figure, dpi, **options)

    monkeypatch.setattr(encode, "encode_png", keep)
    # Coarse files: the layout is that of the figures.
    monkeypatch.setattr(encode, "_FIGURE_DPI", 48.0)
    write_calibration_report(request.getfixturevalue(which), tmp_path / "r.html", paper=True)
    assert len(figures) > 20
    for figure in figures:
        # Maps over the field have numbers on their lines, which may come near each other.
        assert [f for f in faults(figure) if not _between_numbers(f)] == []
        for axes in figure.axes:
            named = axes.get_xlabel() or axes.get_ylabel() or axes.get_title() or not axes.axison
            assert named, "axes without a name"


@pytest.mark.parametrize(
    ("low", "high"),
    [(1000.0, 1001.0), (1000.0, 1200.0), (5000.0, 9000.0), (9000.0, 20000.0), (10.0, 1e6)],
)
def test_numbers_of_the_magnification_stay_apart(low: float, high: float) -> None:
    figure = create_figure(4.0, 2.4)
    axes = figure.add_subplot()
    set_magnification_axis(axes, low, high)
    style_axes(axes, xlabel="magnification", ylabel="px")
    assert faults(figure) == []
    shown = [float(g) for g in axes.get_xticks() if low / 1.12 <= g <= high * 1.12]
    assert len(shown) >= 3
    # Round: each has at most two digits more than the range needs.
    assert all(float(f"{g:.5g}") == pytest.approx(g) for g in shown)


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
    # Specks beside the ball: a 3D axes would draw them over its numbers.
    points[285:] *= 2.0
    # What the figure looks at.
    sphere = SimpleNamespace(
        inliers=inliers, centre_m=np.zeros(3), radius_m=450e-9, residuals_m=rng.normal(0, 1e-9, 300)
    )
    mesh = SimpleNamespace(vertices_m=450e-9 * directions, faces=ConvexHull(directions).simplices)
    ball: Any = SimpleNamespace(
        sphere=sphere, mesh=mesh, diameter_m=899.84e-9, interval_m=(892.48e-9, 907.2e-9)
    )
    structure: Any = SimpleNamespace(points_m=points)
    figure = plot_ball(structure, ball)
    assert faults(figure) == []
    cloud = figure.axes[0]
    assert cloud.get_title() == "280 points, 15 outside of the box"
    assert sum(len(drawn.get_offsets()) for drawn in cloud.collections) == 285


@pytest.mark.parametrize("high", [1100.0, 20000.0])
def test_the_figure_of_a_difference(high: float) -> None:
    y, x = np.mgrid[0:480:7j, 0:640:9j]
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    at = tuple(
        DifferenceAt(
            magnification=float(g),
            scale=1e-4 * k,
            scale_sigma=1e-4,
            pixel_size_m=1e-4 / g,
            xy=xy,
            difference_px=1e-3 * xy * k,
            sigma_px=np.full(len(xy), 0.02),
            shape_px=np.zeros_like(xy),
            shape_sigma_px=np.full(len(xy), 0.01),
        )
        for k, g in enumerate(np.geomspace(1000.0, high, 5))
    )
    names = ("calibration_of_the_22nd_of_november_before_service.yaml", "after_service" * 5)
    difference = CalibrationDifference(at, 1000.0, high, None)
    assert faults(plot_difference(difference, names, (640, 480))) == []


@pytest.mark.parametrize("shape", [(480, 640), (640, 480)])
def test_the_figure_of_heights(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    heights: Any = SimpleNamespace(
        height_m=1e-6 * rng.normal(size=shape),
        sigma_m=1e-9 * rng.uniform(1.0, 30.0, size=shape),
        pixel_size_m=4e-9,
    )
    assert faults(plot_relief(heights)) == []


@pytest.mark.parametrize("count", [1, 4])
def test_the_figures_of_a_cantilever(count: int) -> None:
    rng = np.random.default_rng(0)
    poses = 12
    nm = np.linspace(0.0, -1800.0, poses) + rng.normal(size=(count, poses))
    magnifications = tuple(np.geomspace(1000.0, 20000.0, count))
    agreed: Any = SimpleNamespace(
        magnifications=magnifications,
        deflection_m=1e-9 * nm,
        sigma_m=np.full((count, poses), 1e-9),
        rms_spread_m=1.2e-9,
    )
    assert faults(plot_poses(agreed)) == []
    line = np.array([[20.0, 60.0], [90.0, 66.0]])
    series: list[Any] = [
        SimpleNamespace(
            magnification=round(g),
            frames=[
                SimpleNamespace(
                    line_px=line, tip_px=line[-1], deflection_m=1e-9 * d, sigma_m=1.3e-9
                )
                for d in row
            ],
        )
        for g, row in zip(magnifications, nm, strict=True)
    ]
    images = [[rng.normal(size=(128, 128)) for _ in range(poses)] for _ in series]
    scales = [PixelScale(9.3e-9) for _ in series]
    assert faults(plot_strip(images, series, scales, list(range(poses)))) == []
