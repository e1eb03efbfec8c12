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

"""The calibration report: complete, self-contained, safe against hostile names."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.method_fit import Finding
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import FoundView, GridView
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.images.metadata import quantity
from semcal_ros.report import write_calibration_report
from semcal_ros.report.calibration.numbers import (
    compute_fitted_inner_px,
    compute_held_out_px,
    compute_rms_without_distortion,
    tabulate_beside_paper,
    tabulate_magnifications,
)
from semcal_ros.report.calibration.view_pictures import (
    choose_examples,
    choose_worst_views,
    overlay_corners,
    show_rejected,
)
from semcal_ros.report.html import encode
from semcal_ros.report.html.page import format_px, write_page
from tests.helpers.report_samples import DISPLAY_M, HOSTILE, SIZE, Page, found_of, grid_view, unused

pytestmark = pytest.mark.slow

SECTIONS = [
    "verdict",
    "warnings",
    "camera",
    "errors",
    "predicted",
    "residuals",
    "distortion",
    "pixel-size",
    "parameters",
    "blink",
    "coverage",
    "corners",
    "rejected",
    "numbers",
    "method",
    "paper",
]


@pytest.fixture(scope="module")
def page(page_path: Path) -> str:
    return page_path.read_text(encoding="utf-8")


def test_html_nests_and_has_every_section_with_a_heading(page: str) -> None:
    parsed = Page(page)
    assert [s["id"] for s in parsed.named("section")] == [*SECTIONS, "images"]
    assert len(parsed.named("h1")) == 1
    # Verdict and warnings have no heading of their own, but a label; the extra images have one.
    assert len(parsed.named("h2")) == len(SECTIONS) - 1
    assert parsed.named("html") == [{"lang": "en"}]
    assert any(m.get("name") == "viewport" for m in parsed.named("meta"))


def test_pictures_are_all_there_with_alt_texts_and_valid_data(page: str) -> None:
    parsed = Page(page)
    pictures = parsed.named("img")
    # 1 errors, 3 predicted, 3 residuals, 3 distortion, 2 pixel size, 11 parameters, 4 coverage,
    # 1 of the caller.
    assert len(pictures) == 28
    assert all(len(p["alt"] or "") > 5 for p in pictures)
    drawings = [d for d in parsed.named("svg") if "role" in d]
    # 4 examples, 5 views that fit worst, one rejected, and one view raw and corrected.
    assert len(drawings) == 11 and len(parsed.named("image")) == 12
    assert all(re.search("corners|raw|Rejected", o["aria-label"] or "") for o in drawings)
    # Each has a scale bar with the length and its 1-sigma.
    assert sum(p.get("class") == "bar" for p in parsed.named("path")) == len(drawings)
    assert len(re.findall(r">[\d.]+ [µnm]m ± [\d.]+ [µnp]m</text>", page)) == len(drawings)
    for source in [p["src"] for p in pictures] + [i["href"] for i in parsed.named("image")]:
        match = re.fullmatch(r"data:image/(png|jpeg);base64,(.*)", source or "")
        assert match is not None
        kind, data = match.groups()
        raw = base64.b64decode(data, validate=True)
        assert raw.startswith(b"\x89PNG" if kind == "png" else b"\xff\xd8")
        assert cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR) is not None


def test_nothing_outside_of_the_file_is_referred_to(page: str) -> None:
    # Without what a reader sees as text: the hostile name is shown there, escaped.
    for tag, attributes in Page(page).tags:
        assert tag not in ("link", "iframe", "object", "base")
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("src", "href", "srcset", "action", "data"):
                inside = tag == "a" and (value or "").removeprefix("#") in SECTIONS
                assert inside or (value or "").startswith("data:")
    assert "http:" not in page and "https:" not in page
    # One script, which the page allows by its digest, and its data.
    assert Page(page).named("script") == [{"type": "application/json", "id": "cameras"}, {}]
    script = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page.replace("&#39;", "'")
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
    assert style is not None and "url(" not in style[1] and "@import" not in style[1]


def test_hostile_names_are_shown_as_text(page: str) -> None:
    parsed = Page(page)
    assert page.count("<script") == 2
    shown = " ".join(HOSTILE.split())
    assert parsed.text.count(shown) == 4  # title, heading, name and reason of the rejected view
    assert "\x00" not in page


def test_numbers_in_the_page_are_those_of_the_result(page: str, result: CalibrationResult) -> None:
    text = Page(page).text
    assert f"{len(result.views)} used" in text and "3 rejected" in text
    held_out = compute_held_out_px(result)
    assert held_out is not None
    assert f"Held-out error{held_out:.3f} px" in text.replace("Held-out error ", "Held-out error")
    assert f"fitted: {format_px(compute_fitted_inner_px(result))}" in text
    assert f"{result.fit.rms_px():.3f} px" in text
    for row in tabulate_magnifications(result):
        cells = [row.magnification, f"{row.views}", f"{row.corners}", row.rms]
        cells += [row.held_out + (" *" if row.extrapolated else "")]
        cells += [row.pixel_x, row.pixel_y, row.field]
        assert " ".join(cells) in text
    rms, straight = rms_by_magnification(result.fit), compute_rms_without_distortion(result)
    for beside in tabulate_beside_paper(result, rms, straight):
        assert f"{beside.label} {beside.here} {beside.paper}" in text
    for view in choose_worst_views(result, (), 5):
        assert f"{view.name}, {view.magnification}: {view.rms}" in text
    for g in result.model.magnification_range:
        camera = result.model.at(g)
        assert camera.covariance is not None
        for value, k in ((camera.ex, 8), (camera.ey, 9), (camera.px, 3), (camera.py, 4)):
            sigma = float(np.sqrt(camera.covariance[k, k]))
            digits = max(0, 1 - int(np.floor(np.log10(sigma))))
            assert f"{value:.{digits}f} ± {sigma:.{digits}f} at" in text


def test_a_file_is_replaced_as_a_whole(page_path: Path) -> None:
    text = page_path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>") and text.endswith("</html>\n")
    assert [p.name for p in page_path.parent.iterdir()] == ["report.html"]


def test_bad_image_leaves_the_old_file(result: CalibrationResult, tmp_path: Path) -> None:
    path = tmp_path / "r.html"
    path.write_text("old")
    with pytest.raises(InvalidValueError, match=r"shape \(3,\)"):
        write_calibration_report(result, path, images=[("bad", np.zeros(3))])
    assert path.read_text() == "old"


def test_missing_folder_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="choose another output") as caught:
        write_page(tmp_path / "none" / "r.html", "text")
    assert "\n" not in str(caught.value)


def test_single_magnification_without_the_optional_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Coarse figures: what counts here is which there are.
    monkeypatch.setattr(encode, "_FIGURE_DPI", 48.0)
    rng = np.random.default_rng(3)
    views = [grid_view(800.0, t, a, rng) for t, a in ((3.0, 0.0), (25.0, 70.0), (30.0, 190.0))]
    one = calibrate_views(
        views,
        image_size=(SIZE, SIZE),
        display_width_m=DISPLAY_M,
        options=CalibrationOptions("discrete"),
    )
    one = replace(one, findings=(Finding("fewer than 3 views at magnification 800"),))
    parsed = Page(write_calibration_report(one, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "needs 3 magnifications" in parsed.text
    assert "– *" not in parsed.text and "A star" not in parsed.text
    assert "No images were kept" in parsed.text and "No view was rejected" in parsed.text
    assert "What to watch" in parsed.text
    assert "Fewer than 3 views at magnification 800." in parsed.text
    # One distortion picture instead of three, two predictions, no curves, none of a rejected view or the caller.
    assert len(parsed.named("img")) == 7
    assert not {"pixel-size", "parameters", "paper"} & {s["id"] for s in parsed.named("section")}
    assert parsed.named("script") == [] and parsed.named("input") == []
    assert "The camera at 800×" in parsed.text


def test_overlay_marks_lie_on_the_corners_of_a_shrunk_image(result: CalibrationResult) -> None:
    image = np.zeros((1280, 1280), dtype=np.uint16)
    xy = np.array([[0.0, 0.0], [639.5, 639.5], [1279.0, 1279.0]])
    detection = LatticeDetection(
        np.zeros((3, 2), dtype=np.int64),
        xy,
        np.full(3, 0.1),
        40.0,
        (1280, 1280),
        rejected_xy=np.array([[99.5, 199.5]]),
    )
    overlay = overlay_corners(FoundView("a", 100.0, image, detection), result.model)
    assert (overlay.width, overlay.height) == (320, 320)
    starts = re.findall(r"M([-\d.]+) ([\d.]+)h([\d.]+)", overlay.marks)
    centres = np.array([[float(x) + 0.5 * float(h), float(y)] for x, y, h in starts])
    # A pixel centre is half a pixel from the edge; the path has one decimal.
    assert np.allclose(centres, (xy + 0.5) / 4.0, atol=0.11)
    ((x, y, side),) = re.findall(r"M([-\d.]+) ([\d.]+)h([\d.]+)v", overlay.refused)
    middle = np.array([float(x), float(y)]) + 0.5 * float(side)
    assert np.allclose(middle, [25.0, 50.0], atol=0.11)
    # The image has five times the pixels of the calibration's, over the same field, and is shown at a quarter.
    camera = result.model.at(100.0)
    left, _, right = (float(x) for x in re.findall(r"[\d.]+", overlay.bar.path))
    shown_m = camera.pixel_size_m[0] * SIZE / 320.0
    length_m, sigma_m = (quantity(part, "m") for part in overlay.bar.label.split(" ± "))
    assert length_m is not None and sigma_m is not None
    assert (right - left) * shown_m == pytest.approx(length_m, abs=0.11 * shown_m)
    # Two digits are printed.
    relative = camera.pixel_size_sigma_m[0] / camera.pixel_size_m[0]
    assert sigma_m / length_m == pytest.approx(relative, rel=0.05)


def test_examples_are_the_richest_views(result: CalibrationResult) -> None:
    best = choose_examples([found_of(v) for v in result.views])
    assert [b.magnification for b in best] == [100.0, 400.0, 1500.0, 5000.0]
    for view in best:
        own = [v for v in result.views if v.magnification == view.magnification]
        assert len(view.detection.xy) == max(len(v.image_xy) for v in own)


@pytest.mark.long
def test_fast_and_small_enough_with_many_views(result: CalibrationResult, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    many = tuple(
        GridView(
            v.magnification, rng.normal(size=(250, 2)), rng.uniform(0, 255, (250, 2)), np.ones(250)
        )
        for v in result.views * 7
    )
    fit = replace(
        result.fit,
        residuals_px=tuple(0.1 * rng.normal(size=(250, 2)) for _ in many),
        rotations=np.concatenate([result.fit.rotations] * 7),
        translations_m=np.concatenate([result.fit.translations_m] * 7),
        magnifications=np.array([v.magnification for v in many]),
    )
    noise = rng.integers(0, 256, (SIZE, SIZE)).astype(np.uint8)
    start = time.process_time()
    path = write_calibration_report(
        replace(result, views=many, fit=fit),
        tmp_path / "r.html",
        detections=[found_of(v, noise) for v in many],
        rejected=[unused(f"lost {k}.", 100.0, f"blurred {k}", noise) for k in range(1000)],
    )
    # Measured: 7 to 9 s of one core for 105 views of 250 corners.
    assert time.process_time() - start < 40.0
    assert path.stat().st_size < 3_000_000
    # A long list of rejected views is cut.
    text = Page(path.read_text(encoding="utf-8")).text
    assert "1000 rejected" in text and "800 more are not listed" in text
    assert "lost 199." in text and "lost 200." not in text


def test_rejected_images_are_shown_different_reasons_first(result: CalibrationResult) -> None:
    image = np.zeros((600, 600), dtype=np.uint8)
    views = [unused(f"f{k}", 100.0, "blurred" if k < 3 else "blank", image) for k in range(4)]
    shown = show_rejected([unused("none", 100.0, "blank"), *views], 2, result.model)
    assert [p.caption for p in shown] == ["100×: blurred (f0)", "100×: blank (f3)"]
    assert shown[0].width == shown[0].height == 200
