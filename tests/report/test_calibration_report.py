"""The calibration report: complete, self-contained, safe against hostile names."""

from __future__ import annotations

import base64
import re
import time
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.core.calibrate import CalibrationResult, calibrate_views
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.views import GridView
from semcal_ros.report import calibration_report
from semcal_ros.report.curve_figures import rms_picture, shape_sigma_px
from semcal_ros.report.examples import best_per_magnification, overlay_of
from semcal_ros.report.field_figures import displacement_field, empty_share, tilts_deg
from semcal_ros.report.findings import findings
from semcal_ros.report.numbers import (
    format_length,
    format_px,
    held_out_px,
    magnification_rows,
    plain,
)
from semcal_ros.report.page import write_page

SIZE = 256
DISPLAY_M = 0.12
HOSTILE = "<script>alert('x')</script>\"><img src=//evil.example/a>"
VOID = {"meta", "img", "image", "path", "br", "link"}
SECTIONS = [
    "warnings",
    "corners",
    "coverage",
    "errors",
    "residuals",
    "pixel-size",
    "distortion",
    "parameters",
    "rejected",
    "numbers",
    "method",
]


@dataclass(frozen=True)
class Found:
    name: str
    magnification: float
    image: NDArray[Any]
    detection: LatticeDetection


@dataclass(frozen=True)
class Unused:
    name: str
    magnification: float
    reason: str


class Page(HTMLParser):
    """Tags of a page, with a check that they nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open and self.open.pop() == tag, f"</{tag}> does not match"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


def camera_at(g: float) -> ScanCamera:
    u = np.log10(g / 100.0)
    return ScanCamera(
        g, 1.02 * g * SIZE / DISPLAY_M, 1.003, 0.001, 122.0, 131.0, 50.0,
        0.008 - 0.003 * u, 0.0005, 118.0, 133.0, SIZE / 2, SIZE, SIZE,
    )  # fmt: skip


def grid_view(g: float, tilt_deg: float, azimuth_deg: float, rng: np.random.Generator) -> GridView:
    camera = camera_at(g)
    square = 22.0 / camera.m
    ij = np.stack(np.meshgrid(np.arange(-9, 10), np.arange(-9, 10)), axis=-1).reshape(-1, 2)
    board = ij * square
    azimuth = np.radians(azimuth_deg)
    axis = np.radians(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    rotation = cv2.Rodrigues(axis)[0]
    points = np.column_stack([board, np.zeros(len(board))]) @ rotation.T
    xy = camera.project(points) + 0.05 * rng.normal(size=(len(board), 2))
    inside = np.all((xy > 3.0) & (xy < SIZE - 4.0), axis=1)
    sigma = np.full(int(inside.sum()), 0.05)
    return GridView(g, board[inside], xy[inside], sigma, f"frame {g:g} {azimuth_deg:g}")


@pytest.fixture(scope="module")
def result() -> CalibrationResult:
    rng = np.random.default_rng(7)
    views = [
        grid_view(g, tilt, 90.0 * k + 20.0, rng)
        for g in (100.0, 400.0, 1500.0, 5000.0)
        for k, tilt in enumerate((2.0, 25.0, 32.0, 28.0))
    ]
    return calibrate_views(views, image_size=(SIZE, SIZE), display_width_m=DISPLAY_M)


def found_of(view: GridView, image: NDArray[Any] | None = None) -> Found:
    pixels = np.full((SIZE, SIZE), 90, dtype=np.uint8) if image is None else image
    n = len(view.image_xy)
    detection = LatticeDetection(
        True, "", np.zeros((n, 2), dtype=np.int64), view.image_xy, view.sigma_px, 22.0, (SIZE, SIZE)
    )
    return Found(view.name, view.magnification, pixels, detection)


@pytest.fixture(scope="module")
def page_path(result: CalibrationResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text("an older report")
    written = calibration_report(
        result,
        path,
        detections=[found_of(v) for v in result.views],
        rejected=[
            Unused(HOSTILE, 300.0, f"no grid {HOSTILE}"),
            Unused("b\x00\ud800", 400.0, "blurred"),
        ],
        images=[("Setup", np.zeros((40, 60, 3), dtype=np.uint8))],
        title=f"Microscope {HOSTILE}",
    )
    assert written == path
    return path


@pytest.fixture(scope="module")
def page(page_path: Path) -> str:
    return page_path.read_text(encoding="utf-8")


def test_html_nests_and_has_every_section_with_a_heading(page: str) -> None:
    parsed = Page(page)
    assert [s["id"] for s in parsed.named("section")] == [*SECTIONS, "images"]
    assert len(parsed.named("h1")) == 1
    # The warnings box is the only section without a heading of its own: it bears a label instead.
    assert len(parsed.named("h2")) == len(SECTIONS)
    assert parsed.named("html") == [{"lang": "en"}]
    assert any(m.get("name") == "viewport" for m in parsed.named("meta"))


def test_pictures_are_all_there_with_alt_texts_and_valid_data(page: str) -> None:
    parsed = Page(page)
    pictures = parsed.named("img")
    # 2 coverage, 2 errors, 2 residuals, 2 pixel size, 3 distortion, 10 parameters, 1 of the caller.
    assert len(pictures) == 22
    assert all(len(p["alt"] or "") > 5 for p in pictures)
    overlays = parsed.named("svg")
    assert len(overlays) == len(parsed.named("image")) == 4
    assert all("corners" in (o["aria-label"] or "") for o in overlays)
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
        assert tag not in ("script", "link", "iframe", "object", "base")
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("src", "href", "srcset", "action", "data"):
                assert (value or "").startswith("data:")
    assert "http:" not in page and "https:" not in page
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
    assert style is not None and "url(" not in style[1] and "@import" not in style[1]


def test_hostile_names_are_shown_as_text(page: str) -> None:
    parsed = Page(page)
    assert "<script" not in page
    shown = " ".join(HOSTILE.split())
    assert parsed.text.count(shown) == 4  # title, heading, name and reason of the rejected view
    assert "\x00" not in page


def test_numbers_in_the_page_are_those_of_the_result(page: str, result: CalibrationResult) -> None:
    text = Page(page).text
    assert f"{len(result.views)} used" in text and "2 rejected" in text
    held_out = held_out_px(result)
    assert held_out is not None
    assert f"Held-out error{held_out:.3f} px" in text.replace("Held-out error ", "Held-out error")
    assert "0.9 to 1.45 px" in text
    for row in magnification_rows(result):
        assert row.pixel_x in text


def test_rows_have_one_sigma_digits_and_true_pixel_size(result: CalibrationResult) -> None:
    rows = magnification_rows(result)
    assert [r.magnification for r in rows] == ["100×", "400×", "1500×", "5000×"]
    assert [r.extrapolated for r in rows] == [True, False, False, True]
    for row, g in zip(rows, (100.0, 400.0, 1500.0, 5000.0), strict=True):
        match = re.fullmatch(r"([\d.]+) ± ([\d.]+) (nm|µm)", row.pixel_x)
        assert match is not None
        value, sigma, unit = match.groups()
        scale = {"nm": 1e-9, "µm": 1e-6}[unit]
        truth = camera_at(g).pixel_size_m[0]
        # Four standard deviations, or half the last digit that is printed.
        assert abs(float(value) * scale - truth) < 4.0 * float(sigma) * scale
    assert rows[0].views == 4


def test_a_file_is_replaced_as_a_whole(page_path: Path) -> None:
    text = page_path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>") and text.endswith("</html>\n")
    assert [p.name for p in page_path.parent.iterdir()] == ["report.html"]


def test_bad_image_leaves_the_old_file(result: CalibrationResult, tmp_path: Path) -> None:
    path = tmp_path / "r.html"
    path.write_text("old")
    with pytest.raises(InvalidValueError, match=r"shape \(3,\)"):
        calibration_report(result, path, images=[("bad", np.zeros(3))])
    assert path.read_text() == "old"


def test_missing_folder_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="choose another output") as caught:
        write_page(tmp_path / "none" / "r.html", "text")
    assert "\n" not in str(caught.value)


def test_single_magnification_without_the_optional_parts(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    views = [grid_view(800.0, t, a, rng) for t, a in ((3.0, 0.0), (25.0, 70.0), (30.0, 190.0))]
    one = calibrate_views(
        views, image_size=(SIZE, SIZE), display_width_m=DISPLAY_M, method="discrete"
    )
    one = replace(one, warnings=("fewer than 3 views at magnification 800",))
    parsed = Page(calibration_report(one, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "needs 3 magnifications" in parsed.text
    assert "No images were kept" in parsed.text and "No view was rejected" in parsed.text
    assert "What to watch" in parsed.text
    assert "Fewer than 3 views at magnification 800." in parsed.text
    # One distortion picture instead of three, and no picture of the caller.
    assert len(parsed.named("img")) == 19


def test_infinite_held_out_error_is_named(result: CalibrationResult) -> None:
    broken = replace(result, held_out_rms_px={**result.held_out_rms_px, 400.0: float("inf")})
    assert [row.held_out for row in magnification_rows(broken)][1] == "no answer"
    assert any("without the images at 400×" in f.lower() for f in findings(broken))
    assert rms_picture(broken).src.startswith("data:image/png")


def test_badly_predicted_magnification_is_named(result: CalibrationResult) -> None:
    # 0.07 px is the noise of these views; the outermost magnifications are allowed to be worse.
    held_out = {**result.held_out_rms_px, 1500.0: 0.5, 5000.0: 0.5}
    found = findings(replace(result, held_out_rms_px=held_out))
    assert len(found) == 1 and found[0].startswith("The images at 1500× are predicted badly")


def test_findings_of_poor_views(result: CalibrationResult) -> None:
    assert findings(result) == []
    corner = tuple(
        replace(v, image_xy=0.4 * v.image_xy) for v in result.views
    )  # all corners in the upper left part: 1 - 0.4^2 = 84 % of the field is empty
    sparse = replace(result, views=corner)
    assert empty_share(sparse) > 0.75
    assert any("has no corner in any view" in f for f in findings(sparse))
    flat = replace(result.fit, rotations=np.stack([np.eye(3)] * len(result.views)))
    assert any("tilted" in f for f in findings(replace(result, fit=flat)))


def test_tilts_are_those_of_the_views(result: CalibrationResult) -> None:
    tilt, _ = tilts_deg(result)
    # 0.05 px of noise over 250 px and 25 to 32 degrees determine a tilt far better than 1 degree;
    # the flat one less so.
    steep = tilt.reshape(4, 4)[:, 1:]
    assert np.allclose(steep, [25.0, 32.0, 28.0], atol=1.0)


def test_displacement_field_is_the_distortion() -> None:
    camera = camera_at(100.0)
    xy, moved = displacement_field(camera, across=5)
    assert xy.shape == (25, 2)
    assert np.array_equal(xy[0], [0.0, 0.0]) and np.array_equal(xy[-1], [SIZE - 1.0, SIZE - 1.0])
    assert np.allclose(camera.undistort(xy + moved), xy, atol=1e-9)


def test_shape_sigma_ignores_the_principal_point_but_not_the_scale() -> None:
    covariance = np.zeros((10, 10))
    covariance[3, 3] = covariance[4, 4] = 25.0
    camera = replace(camera_at(400.0), xi_r=0.0, xi_t=0.0, covariance=covariance)
    corner = np.array([[0.0, 0.0]])
    # Without distortion, a shift is the same everywhere.
    assert shape_sigma_px(camera, corner)[0] == pytest.approx(0.0, abs=1e-9)
    covariance = np.zeros((10, 10))
    covariance[0, 0] = (1e-3 * camera.m) ** 2
    scaled = replace(camera, covariance=covariance)
    # 0.1 % of the distance from the centre.
    half = 0.5 * (SIZE - 1)
    assert shape_sigma_px(scaled, corner)[0] == pytest.approx(1e-3 * half * np.sqrt(2.0), rel=1e-6)


def test_overlay_marks_lie_on_the_corners_of_a_shrunk_image() -> None:
    image = np.zeros((1280, 1280), dtype=np.uint16)
    xy = np.array([[0.0, 0.0], [639.5, 639.5], [1279.0, 1279.0]])
    detection = LatticeDetection(
        True, "", np.zeros((3, 2), dtype=np.int64), xy, np.full(3, 0.1), 40.0, (1280, 1280)
    )
    overlay = overlay_of(Found("a", 100.0, image, detection))
    assert (overlay.width, overlay.height) == (320, 320)
    starts = re.findall(r"M([-\d.]+) ([\d.]+)h([\d.]+)", overlay.marks)
    centres = np.array([[float(x) + 0.5 * float(h), float(y)] for x, y, h in starts])
    # A pixel centre is half a pixel from the edge; the path has one decimal.
    assert np.allclose(centres, (xy + 0.5) / 4.0, atol=0.11)


def test_examples_are_the_richest_accepted_views(result: CalibrationResult) -> None:
    found = [found_of(v) for v in result.views]
    lost = replace(found[0], detection=replace(found[0].detection, accepted=False, reason="x"))
    best = best_per_magnification([lost, *found[1:]])
    assert [b.magnification for b in best] == [100.0, 400.0, 1500.0, 5000.0]
    for view in best:
        own = [v for v in result.views if v.magnification == view.magnification]
        if view.magnification == 100.0:
            own = own[1:]
        assert len(view.detection.xy) == max(len(v.image_xy) for v in own)


def test_units_a_person_reads() -> None:
    assert format_length(2.3456e-6) == "2.346 µm"
    assert format_length(46.88e-9, 0.0234e-9) == "46.880 ± 0.023 nm"
    assert format_length(46.88e-9, 0.0) == "46.88 nm"
    assert format_length(2.3e-6) == "2.300 µm"
    assert format_length(1177e-6) == "1177 µm"
    assert format_px(None) == format_px(float("nan")) == "–"
    assert format_px(float("inf")) == "no answer"
    assert plain("a\x00b\ud800\n") == "a\ufffdb\ufffd\n"


def test_fast_and_small_enough(result: CalibrationResult, tmp_path: Path) -> None:
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
        magnifications=np.array([v.magnification for v in many]),
    )
    noise = rng.integers(0, 256, (SIZE, SIZE)).astype(np.uint8)
    start = time.process_time()
    path = calibration_report(
        replace(result, views=many, fit=fit),
        tmp_path / "r.html",
        detections=[found_of(v, noise) for v in many],
    )
    # Measured: 3 s of one core for 105 views of 250 corners.
    assert time.process_time() - start < 20.0
    assert path.stat().st_size < 3_000_000
