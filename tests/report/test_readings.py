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

"""Values that a figure tells when one points at it: at their place, in px and as lengths."""

from __future__ import annotations

import base64
import io
import itertools
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.report.calibration.error_figures import plot_distortion, plot_rms
from semcal_ros.report.calibration.numbers import compute_rms_without_distortion
from semcal_ros.report.calibration.parameter_figures import plot_pixel_sizes
from semcal_ros.report.html.encode import Readings, encode_figure
from semcal_ros.report.html.page import format_length
from semcal_ros.report.html.style import create_figure, style_axes


def test_strips_lie_around_the_points_in_the_file() -> None:
    figure = create_figure(4.0, 2.4)
    axes = figure.add_subplot()
    style_axes(axes, xlabel="x", ylabel="y")
    x = np.array([1.0, 10.0, 100.0])
    axes.set_xscale("log")
    axes.set_xlim(0.5, 200.0)
    axes.plot(x, [1.0, 2.0, 3.0], "s", color="#ff0000", markersize=3)
    picture = encode_figure(figure, "points", "", Readings([axes], x, ["a", "b", "c"]))
    assert [s.text for s in picture.strips] == ["a", "b", "c"]
    with Image.open(io.BytesIO(base64.b64decode(picture.src.partition(",")[2]))) as image:
        rgb = np.asarray(image.convert("RGB")).astype(int)
    # Two dots of the file per CSS pixel.
    assert rgb.shape[1] == 2 * picture.width
    rows, columns = np.nonzero((rgb[:, :, 0] > 200) & (rgb[:, :, 1] < 80))
    for strip in picture.strips:
        middle = 2.0 * (strip.x + 0.5 * strip.width)
        own = np.abs(columns - middle) < 16
        # The marker is drawn at whole dots, and the strip has one decimal.
        assert own.any() and abs(columns[own].mean() - middle) < 2.0
        assert (rows[own] > 2.0 * strip.y).all()
        assert (rows[own] < 2.0 * (strip.y + strip.height)).all()


def test_errors_and_sizes_are_told_in_px_and_as_lengths(result: CalibrationResult) -> None:
    picture = plot_rms(result, compute_rms_without_distortion(result))
    rms = rms_by_magnification(result.fit)
    assert len(picture.strips) == len(rms)
    for strip, (g, px) in zip(picture.strips, rms.items(), strict=True):
        nm = format_length(px * float(np.mean(result.model.at(g).pixel_size_m)))
        assert strip.text.startswith(f"{g:g}×: fitted {px:.3f} px, {nm}; held out ")
    size, deviation = plot_pixel_sizes(result.model)
    camera = result.model.at(result.model.magnification_range[0])
    first = format_length(camera.pixel_size_m[0], camera.pixel_size_sigma_m[0])
    assert size.strips[0].text.startswith(f"{camera.magnification:g}×: x {first}, y ")
    assert " %, y " in deviation.strips[0].text
    # Strips do not overlap, and are inside of the picture.
    for one in (picture, size, deviation):
        ends = [(s.x, s.x + s.width) for s in one.strips]
        assert all(a[1] <= b[0] + 0.11 for a, b in itertools.pairwise(ends))
        assert 0.0 < ends[0][0] < ends[-1][1] <= one.width


def test_an_error_that_is_not_known_is_a_dash(result: CalibrationResult) -> None:
    without = replace(result, held_out_rms_px={})
    picture = plot_rms(without, compute_rms_without_distortion(without))
    assert all("held out –" in strip.text for strip in picture.strips)


@pytest.mark.parametrize("g", [100.0, 5000.0])
def test_the_picture_of_a_distortion_says_how_long_it_is(
    result: CalibrationResult, g: float
) -> None:
    caption = plot_distortion(result.model.at(g)).caption
    assert " px, " in caption and "m (numbers" in caption
