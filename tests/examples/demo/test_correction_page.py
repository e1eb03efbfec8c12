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

"""The report of a correction: its table, its images and its refusals."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from examples.demo.correction_page import DemoRow, overlay_change, write_correction_report
from semcal_ros.core.errors import InvalidValueError

ROWS = (
    DemoRow("without correction", 6.81, 7.0),
    DemoRow("with drift correction", 2.94, 3.0),
    DemoRow("with distortion correction too", 0.112, (0.9, 1.45)),
)


def page_of(tmp_path: Path, *args: object, **options: object) -> str:
    path = write_correction_report(*args, tmp_path / "demo.html", **options)  # type: ignore[arg-type]
    return path.read_text(encoding="utf-8")


def test_table_has_ours_beside_the_papers(tmp_path: Path) -> None:
    text = page_of(tmp_path, ROWS, [])
    cells = re.findall(r"<td>(.*?)</td>", text)
    assert cells == ["6.810 px", "7 px", "2.940 px", "3 px", "0.112 px", "0.9 to 1.45 px"]
    assert [p.name for p in tmp_path.iterdir()] == ["demo.html"]
    alone = page_of(tmp_path, [DemoRow("raw", 6.81)], [])
    assert re.findall(r"<td>(.*?)</td>", alone) == ["6.810 px"]
    assert "aper" not in alone


@pytest.mark.parametrize(
    "image",
    [
        np.full((30, 40), 7, dtype=np.uint8),
        np.linspace(0, 6e4, 1200).reshape(30, 40).astype(np.uint16),
        np.where(np.eye(30, 40) > 0, np.nan, 1.5)[:, :, None] * np.ones(3, dtype=np.float32),
    ],
    ids=["mono8", "mono16", "float RGB with holes"],
)
def test_pictures_of_any_depth(tmp_path: Path, image: np.ndarray) -> None:
    text = page_of(tmp_path, ROWS, [("before", image), ("after", image)])
    assert text.count("<img ") == 3  # the chart and two images
    assert text.index("Image: before") < text.index("Image: after")


@pytest.mark.parametrize("image", [np.full((4, 4), np.nan), np.zeros((0, 4)), np.zeros((4, 4, 2))])
def test_what_is_no_image_is_refused(tmp_path: Path, image: np.ndarray) -> None:
    with pytest.raises(InvalidValueError, match="image"):
        page_of(tmp_path, ROWS, [("x", image)])
    assert not list(tmp_path.iterdir())


def test_hostile_texts_are_escaped(tmp_path: Path) -> None:
    bad = "<script>1</script>$\\frac{"
    text = page_of(
        tmp_path, [DemoRow(bad, 1.0)], [(bad, np.zeros((4, 4), np.uint8))], title=bad, notes=[bad]
    )
    assert "<script" not in text
    assert text.count("&lt;script&gt;") >= 5


def test_strange_errors_still_give_a_page(tmp_path: Path) -> None:
    text = page_of(
        tmp_path, [DemoRow("a", float("inf")), DemoRow("b", float("nan")), DemoRow("c", 0.0)], []
    )
    assert "no answer" in text and "0.000 px" in text


def test_no_rows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="at least one"):
        write_correction_report([], [], tmp_path / "demo.html")
    assert not list(tmp_path.iterdir())


def test_wide_images_are_shrunk(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (2048, 2048)).astype(np.uint8)
    text = page_of(tmp_path, ROWS, [("large", noise)])
    assert 'width="640" height="640"' in text
    assert len(text) < 1_500_000


def test_errors_are_lengths_at_each_magnification(tmp_path: Path) -> None:
    rows = [DemoRow("raw", 2.0, 7.0, ((400.0, 1.5, 450e-9), (7000.0, 2.1, 33e-9)))]
    text = page_of(tmp_path, rows, [])
    assert re.findall(r"<td>(.*?)</td>", text) == [
        "2.000 px",
        "1.500 px, 675 nm",
        "2.100 px, 69.3 nm",
        "7 px",
    ]
    assert "at 400×" in text and "at 7000×" in text


def test_what_moved_between_two_frames_is_coloured() -> None:
    rng = np.random.default_rng(0)
    first = np.kron(rng.integers(0, 2, (32, 32)), np.full((16, 16), 150)).astype(np.uint8) + 40
    same, moved = (overlay_change(first, np.roll(first, k, axis=1), 33e-9) for k in (0, 3))
    assert same.shape == moved.shape == (640, 640, 3)
    assert np.array_equal(same[:, :, 0], same[:, :, 1])
    colour = np.abs(moved[:, :, 0].astype(int) - moved[:, :, 1])
    # Half of the edges of squares of 16 px are crossed; each gives 3 px of colour.
    assert 0.04 < np.mean(colour > 100) < 0.16
    # Above the scale bar; it is the same in all channels, so it has no colour.
    assert np.ptp(same[600:, 400:, 0]) == 255
