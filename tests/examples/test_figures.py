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

"""The layout of the figures that examples draw."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure

from examples.cantilever import figure_16a
from examples.demo.correction_page import DemoRow, write_correction_report
from examples.demo.overview import overview
from examples.nano_ball import __main__ as nano_ball
from examples.visual_servo.picture import picture
from tests.helpers.figure_layout import faults
from tests.helpers.node_scenes import make_calibration

pytestmark = pytest.mark.slow


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that are saved."""
    figures: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *given: Any, **options: Any) -> None:
        if figure not in figures:
            figures.append(figure)
        save(figure, *given, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def test_the_overview_of_the_demo(drawn: list[Figure], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    topics = ("image_raw", "image_stabilized", "image_rect")
    stamps = [1, 2]
    streams = {topic: {s: rng.random((512, 512)) for s in stamps} for topic in topics}
    rms = dict(zip(topics, ([5.1, 4.2, 6.0], [1.3, 0.9, 1.1], [0.05, 0.04, 0.05]), strict=True))
    cal = make_calibration()
    low, high = cal.magnification_range
    magnifications = [float(f"{g:.2g}") for g in np.geomspace(1.2 * low, 0.8 * high, 3)]
    overview(tmp_path / "o.png", streams, stamps, rms, magnifications, cal)
    assert [faults(figure) for figure in drawn] == [[]]


@pytest.mark.parametrize("paper", [None, 7.0])
def test_the_chart_of_the_correction(
    paper: float | None, drawn: list[Figure], tmp_path: Path
) -> None:
    rows = [DemoRow("raw", 6.8, paper), DemoRow("corrected", 0.05, paper and (0.9, 1.45))]
    write_correction_report(rows, [], tmp_path / "c.html")
    assert [faults(figure) for figure in drawn] == [[]]


def test_figure_16a(drawn: list[Figure]) -> None:
    rng = np.random.default_rng(0)
    truth = 1e-9 * np.tile(np.r_[np.linspace(0.0, 250.0, 7), np.linspace(200.0, 0.0, 5)], (3, 1))
    noisy = [truth + 1e-9 * rng.normal(size=truth.shape) for _ in range(2)]
    compared = figure_16a.Comparison("length", (6450.0, 7760.0, 8890.0), truth, *noisy)
    figure_16a.draw_comparison(compared)
    assert [faults(figure) for figure in drawn] == [[]]


def test_the_figure_of_servoing(drawn: list[Figure], tmp_path: Path) -> None:
    magnification = np.repeat([500.0, 1000.0, 2000.0, 5000.0], 15)
    since = np.tile(np.arange(15), 4)
    runs = [
        SimpleNamespace(
            name=name,
            images={500.0: np.zeros((64, 64), np.uint8), 5000.0: np.zeros((64, 64), np.uint8)},
            true_px=floor + 20.0 * 0.5**since,
            true_m=lambda floor=floor: 50e-9 * (floor + 20.0 * 0.5**since),
            magnification=magnification,
        )
        for name, floor in (("uncalibrated", 0.4), ("interpolated", 40.0), ("continuous", 0.1))
    ]
    shown: Any = runs
    picture(tmp_path / "s.png", shown)
    assert [faults(figure) for figure in drawn] == [[]]


def test_the_figure_of_a_balls_error(drawn: list[Figure], tmp_path: Path) -> None:
    ball: Any = trimesh.creation.icosphere(subdivisions=3, radius=449.0)
    ball.vertices *= 1.0 + 0.003 * np.random.default_rng(0).normal(size=(len(ball.vertices), 1))
    ball.export(tmp_path / "ball.ply")
    nano_ball.picture_of_error(tmp_path / "ball.ply", 900.0)
    assert [faults(figure) for figure in drawn] == [[]]
