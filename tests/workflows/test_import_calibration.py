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

"""A nominal calibration from a table of pixel sizes: its numbers, their sigma, and tables as people write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semcal_ros import Calibration
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tables import write_table
from semcal_ros.workflows.import_calibration import import_calibration

SIZE = (1024, 768)


def table(tmp_path: Path, text: str, name: str = "sizes.csv") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_pixel_sizes_come_back_with_their_sigma(tmp_path: Path) -> None:
    path = table(tmp_path, "magnification,nm per px\n500,470\n5000,46.8\n")
    made = import_calibration(path, image_size=SIZE, sigma=0.01)
    for g, nm in ((500.0, 470.0), (5000.0, 46.8)):
        camera = made.at(g)
        assert camera.pixel_size_m == pytest.approx((1e-9 * nm, 1e-9 * nm), rel=1e-12)
        assert camera.pixel_size_sigma_m == pytest.approx((1e-11 * nm, 1e-11 * nm), rel=1e-6)
    # In between, g times the size goes from 235 to 234 mm: linear in log g to second order.
    middle = made.at(np.sqrt(500.0 * 5000.0))
    assert middle.pixel_size_m[0] * middle.magnification == pytest.approx(234.5e-6, rel=1e-5)
    # Common errors do not average out between two magnifications.
    assert middle.pixel_size_sigma_m[0] / middle.pixel_size_m[0] == pytest.approx(0.01, rel=1e-3)
    assert not made.at(6000.0).in_range and middle.in_range
    # The file holds all of it.
    made.save(tmp_path / "cal.yaml")
    assert Calibration.load(tmp_path / "cal.yaml") == made
    assert "table of pixel sizes" in made.provenance.recording


def test_one_row_is_enough(tmp_path: Path) -> None:
    made = import_calibration(
        table(tmp_path, "Mag,Pixel size (um)\n1000x,0.12\n"), image_size=SIZE, sigma=0.02
    )
    assert made.at(1000.0).pixel_size_m[0] == pytest.approx(120e-9)
    # The width of the field times the magnification, 0.12288 m, is the display.
    assert made.display_width_m == pytest.approx(1024 * 120e-9 * 1000.0)


@pytest.mark.parametrize(
    "text",
    [
        "magnification;nm/px\n500;470,0\n5000;46,8\n",
        "# from the maker\nMagnification\tpixel_size_nm\n\n500\t470\n5000\t46.8\n",
        "mag,um per pixel,comment\n5000,0.0468,\n500,0.47,checked\n",
    ],
)
def test_tables_as_people_write_them(tmp_path: Path, text: str) -> None:
    made = import_calibration(table(tmp_path, text), image_size=SIZE, sigma=0.01)
    assert made.at(500.0).pixel_size_m[0] == pytest.approx(470e-9)
    assert made.at(5000.0).pixel_size_m[0] == pytest.approx(46.8e-9)


def test_a_sigma_has_the_unit_of_its_header(tmp_path: Path) -> None:
    for text in ("mag,nm/px,sigma (um)\n1000,120,0.0012\n", "mag,nm/px,sigma\n1000,120,1.2\n"):
        camera = import_calibration(table(tmp_path, text), image_size=SIZE, sigma=0.5).at(1000.0)
        assert camera.pixel_size_sigma_m[0] == pytest.approx(1.2e-9, rel=1e-6)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".xlsx"])
def test_every_kind_of_table(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"sizes{suffix}"
    columns = ("magnification", "nm per px", "sigma (%)")
    write_table(path, columns, [(500.0, 470.0, 2.0), (5000.0, 46.8, 0.5)])
    made = import_calibration(path, image_size=SIZE, sigma=0.1)
    assert made.at(500.0).pixel_size_m[0] == pytest.approx(470e-9)
    # The scale has its own part at each magnification, the aspect ratio that of the worst.
    low, high = (made.at(g) for g in (500.0, 5000.0))
    assert low.pixel_size_sigma_m[0] / low.pixel_size_m[0] == pytest.approx(0.02, rel=1e-6)
    part = np.sqrt((0.005**2 + 0.02**2) / 2.0)
    assert high.pixel_size_sigma_m[0] / high.pixel_size_m[0] == pytest.approx(part, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("mag,nm/px\n500,47\n1000,235\n", "row 3: 235 nm per px at 1000x and 47 at 500x"),
        ("mag,nm/px\n500,470\n500,430\n", "row 3: 430 and 470 nm per px at 500x"),
        ("mag,nm/px\n500,-470\n", "row 2: pixel size -4.7e-07; expected a number above 0"),
        ("mag,nm/px\n500,abc\n", "row 2: 'abc'; expected a number"),
        ('mag;nm/px\n"10,000";12\n', "row 2: '10,000', a thousand or a decimal number"),
        ("mag,size\n500,470\n", "one column with a header such as nm per px"),
        ("mag,nm/px,um/px\n500,470,0.47\n", "one column with a header such as nm per px"),
        ("nm/px\n470\n", "one column with a header such as magnification"),
        ("mag,nm/px\n", "without rows"),
        ("", "without rows"),
    ],
)
def test_nonsense_is_refused_with_its_row(tmp_path: Path, text: str, what: str) -> None:
    with pytest.raises(InvalidValueError) as refused:
        import_calibration(table(tmp_path, text), image_size=SIZE, sigma=0.01)
    assert what in str(refused.value)


@pytest.mark.parametrize("name", ["sizes.txt", "sizes.parquet", "sizes.xlsx"])
def test_what_is_no_table_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidValueError, match=r"not a table|name that ends in"):
        import_calibration(table(tmp_path, "mag,nm/px\n", name), image_size=SIZE, sigma=0.01)
