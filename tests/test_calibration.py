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

"""The calibration as programs hold it: comparison, text, figure, cameras, images."""

from __future__ import annotations

from dataclasses import replace
from html import escape

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from semcal_ros import Calibration, SemcalError
from semcal_ros.core.camera.records import LadderRecord
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.report.calibration.curves import parts_by_specimen
from semcal_ros.synthetic import preset
from tests.helpers.calibrations import calibrated
from tests.helpers.node_scenes import make_calibration, texture

MICROSCOPE = preset("jsm820")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    seen = (500.0, 1000.0, 2000.0, 4000.0)
    return Calibration.from_model(calibrated("jsm820", magnifications=seen, views=3).model)


def test_loads_of_one_file_are_equal(calibration, tmp_path):
    calibration.save(tmp_path / "cal.yaml")
    one, other = (Calibration.load(tmp_path / "cal.yaml") for _ in range(2))
    assert one == other and one is not other
    assert hash(one) == hash(other)
    assert one == calibration
    assert len({one, other, calibration}) == 1


def test_a_calibration_with_another_number_is_another_one(calibration):
    changed = Calibration.from_model(replace(calibration, display_width_m=0.13))
    assert changed != calibration
    covariance = calibration.covariance.copy()
    covariance[0, 0] *= 1.0 + 1e-12
    assert Calibration.from_model(replace(calibration, covariance=covariance)) != calibration
    assert calibration != calibration.dumps()
    assert calibration != 3


def test_its_text_is_one_line_of_what_matters(calibration):
    text = repr(calibration)
    assert text.startswith("Calibration(joint, 500x to 4000x, 512 x 512 px, 12 views, RMS 0.0")
    assert "held-out RMS 0." in text
    count = len(calibration.warnings)
    assert count > 0 and text.endswith(f" px, {count} warning{'s' if count > 1 else ''})")
    assert "\n" not in text and len(text) < 130


def test_its_table_holds_the_same(calibration):
    table = calibration._repr_html_()
    assert table.count("<tr>") == 6 + len(calibration.warnings)
    for text in calibration.warnings:
        assert f"<td>{escape(text)}</td>" in table
    for cell in ("500x to 4000x", "512 x 512 px", "<td>12</td>", "held-out RMS"):
        assert cell in table
    edited = Calibration.from_model(replace(calibration, method="<b>", statistics={"views": "no"}))
    assert "<b>" not in edited._repr_html_()
    assert repr(edited) == "Calibration(<b>, 500x to 4000x, 512 x 512 px)"


@pytest.mark.parametrize("noted", ["text", 3, None, {"a": "b"}, [], [1, None, ["nested"]]])
def test_notes_that_are_no_list_of_texts_are_no_warnings(calibration, noted):
    edited = Calibration.from_model(replace(calibration, statistics={"warnings": noted}))
    assert edited.warnings == ()
    assert "warning" not in repr(edited) + edited._repr_html_()


@pytest.mark.parametrize("statistics", [{}, None, ["warnings"]])
def test_a_file_without_notes_has_no_warnings(calibration, statistics):
    assert Calibration.from_model(replace(calibration, statistics=statistics)).warnings == ()


@pytest.mark.parametrize("kind", [list, tuple, np.array, iter])
def test_several_magnifications_give_a_camera_each(calibration, kind):
    wanted = [4000.0, 500.0, 777.0]
    cameras = calibration.at(kind(wanted))
    assert isinstance(cameras, tuple)
    assert [c.magnification for c in cameras] == wanted
    for camera, g in zip(cameras, wanted, strict=True):
        np.testing.assert_array_equal(camera.parameters, calibration.at(g).parameters)
        np.testing.assert_array_equal(camera.covariance, calibration.at(g).covariance)


def test_numbers_of_numpy_are_numbers(calibration):
    for g in (np.float32(500.0), np.array(500.0), 500):
        assert calibration.at(g).magnification == 500.0
    assert calibration.at([]) == ()
    with pytest.raises(InvalidValueError, match="finite"):
        calibration.at([500.0, float("nan")])


def test_a_rectified_image_is_without_distortion(calibration):
    camera = calibration.at(1000.0)
    # A point of light where the raw image shows what belongs at (400, 90).
    point = camera.rectified.sem_from_ideal([[400.0, 90.0]])
    x, y = camera.project(point)[0]
    assert np.hypot(x - 400.0, y - 90.0) > 0.3
    rows, columns = np.mgrid[:512, :512]
    spot = 200.0 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 3.0**2))
    flat = calibration.rectify(spot.astype(np.float32), 1000.0)
    assert flat.shape == (512, 512) and flat.dtype == np.float32
    moments = cv2.moments(flat)
    found = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    # Linear interpolation of a spot of sigma 3 px moves its centroid by less than 0.01 px.
    assert found == pytest.approx((400.0, 90.0), abs=0.01)


def test_images_of_another_size_show_the_same_field(calibration):
    half = calibration.rectify(texture(size=256), 1000.0)
    assert half.shape == (256, 256) and half.dtype == np.uint8
    colour = calibration.rectify(np.dstack([texture(size=256)] * 3), 1000.0)
    np.testing.assert_array_equal(colour[..., 1], half)
    for image, g in ((np.zeros((4, 4), bool), 1000.0), (texture(), -1.0)):
        with pytest.raises(SemcalError):
            calibration.rectify(image, g)
    with pytest.raises(InvalidValueError, match="interpolation"):
        calibration.rectify(texture(), 1000.0, interpolation="sinc")


def _lines(figure: Figure, title: str) -> np.ndarray:
    (axes,) = (axes for axes in figure.axes if axes.get_title() == title)
    return np.asarray(axes.lines[0].get_xydata())


def test_the_figure_shows_scale_and_parameters(calibration):
    figure = calibration.plot()
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 11
    size = _lines(figure, "Size of a pixel")
    assert size[[0, -1], 0] == pytest.approx([500.0, 4000.0])
    expected = 1e9 * np.mean(calibration.at(500.0).pixel_size_m)
    assert size[0, 1] == pytest.approx(expected)
    radial = _lines(figure, "Radial distortion")
    assert radial[-1, 1] == pytest.approx(1e3 * calibration.at(4000.0).xi_r)
    # Each parameter has a band of its 1-sigma; only the size of a pixel, on a log axis, has none.
    bands = [axes.collections[0] for axes in figure.axes if axes.get_title() != "Size of a pixel"]
    assert len(bands) == 10
    low = bands[0].get_paths()[0].vertices[:, 1].min()
    line = figure.axes[1].lines[0].get_ydata()
    sigma = np.sqrt(calibration.at(500.0).covariance[0, 0])
    nominal = calibration.nominal_px_per_m(500.0)
    assert low <= line[0] - 100.0 * sigma / nominal + 1e-9


def test_the_figure_shades_what_a_specimen_tells(calibration):
    ladder = LadderRecord((500.0, 2000.0), 1e-4)
    figure = Calibration.from_model(replace(calibration, ladder=ladder)).plot()
    for axes in figure.axes:
        (text,) = [text for text in axes.texts if text.get_text() == "specimen"]
        assert 2000.0 < text.get_position()[0] < 4000.0
    alone = replace(calibration, ladder=LadderRecord((2000.0, 2000.0), 1e-4), method="specimen")
    assert parts_by_specimen(alone) == [(500.0, 4000.0)]
    assert parts_by_specimen(calibration) == []
    assert not any(axes.texts for axes in calibration.plot().axes)


def test_a_single_magnification_can_be_drawn(tmp_path):
    model = make_calibration()
    single = Calibration.from_model(replace(model, magnifications=model.magnifications[:1]))
    single.plot().savefig(tmp_path / "one.png")
    image = cv2.imread(str(tmp_path / "one.png"))
    assert image is not None and image.std() > 5
    assert repr(single) == "Calibration(joint, 500x, 96 x 96 px)"
