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

"""The numbers behind the report: predicted errors, findings, units."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import fit_poses, rms_by_magnification
from semcal_ros.core.calibration.judgement.findings import (
    compute_empty_share,
    compute_reached_shares,
    compute_tilts_deg,
    estimate_pattern_px,
    find_all,
)
from semcal_ros.core.calibration.method_fit import Finding, rank_findings
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.uncertainty import (
    make_field_lattice,
    predict_aligned_sigma_px,
    predict_shape_sigma_px,
)
from semcal_ros.report.calibration.error_figures import (
    plot_predicted_errors,
    plot_residual_field,
    plot_rms,
)
from semcal_ros.report.calibration.numbers import (
    collect_warnings,
    compute_displacements,
    compute_fitted_inner_px,
    compute_held_out_px,
    compute_median_px,
    compute_rms_without_distortion,
    remove_residual_field,
    tabulate_beside_paper,
    tabulate_cameras,
    tabulate_magnifications,
)
from semcal_ros.report.calibration.parameter_figures import compute_focal_length_px, plot_parameters
from semcal_ros.report.html.page import (
    format_length,
    format_magnification,
    format_px,
    remove_control_characters,
)
from tests.helpers.report_samples import SIZE, camera_at, unused


@pytest.mark.slow
def test_rows_have_one_sigma_digits_and_true_pixel_size(result: CalibrationResult) -> None:
    rows = tabulate_magnifications(result)
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


def test_infinite_held_out_error_is_named(result: CalibrationResult) -> None:
    broken = replace(result, held_out_rms_px={**result.held_out_rms_px, 400.0: float("inf")})
    assert [row.held_out for row in tabulate_magnifications(broken)][1] == "no answer"
    assert any("without the images at 400x" in f.lower() for f in collect_warnings(broken))
    assert plot_rms(broken, {}).src.startswith("data:image/png")


def test_badly_predicted_magnification_is_named(result: CalibrationResult) -> None:
    # 0.07 px is the noise of these views; the outermost magnifications are allowed to be worse.
    held_out = {**result.held_out_rms_px, 1500.0: 0.5, 5000.0: 0.5}
    found = collect_warnings(replace(result, held_out_rms_px=held_out))
    assert len(found) == 1 and found[0].startswith("The images at 1500x are predicted badly")


def test_findings_of_poor_views(result: CalibrationResult) -> None:
    assert collect_warnings(result) == []
    corner = tuple(
        replace(v, image_xy=0.4 * v.image_xy) for v in result.views
    )  # all corners in the upper left part: 1 - 0.4^2 = 84 % of the field is empty
    sparse = replace(result, views=corner)
    assert compute_empty_share(sparse) > 0.75
    assert any("has no corner in any view" in f for f in collect_warnings(sparse))
    flat = replace(result.fit, rotations=np.stack([np.eye(3)] * len(result.views)))
    assert any("tilted" in f for f in collect_warnings(replace(result, fit=flat)))


def test_tilts_are_those_of_the_views(result: CalibrationResult) -> None:
    tilt, _ = compute_tilts_deg(result)
    # 0.05 px of noise over 250 px and 25 to 32 degrees determine a tilt far better than 1 degree;
    # the flat one less so.
    steep = tilt.reshape(4, 4)[:, 1:]
    assert np.allclose(steep, [25.0, 32.0, 28.0], atol=1.0)


def test_displacement_field_is_the_distortion() -> None:
    camera = camera_at(100.0)
    xy, moved = compute_displacements(camera, across=5)
    assert xy.shape == (25, 2)
    assert np.array_equal(xy[0], [0.0, 0.0]) and np.array_equal(xy[-1], [SIZE - 1.0, SIZE - 1.0])
    assert np.allclose(camera.undistort(xy + moved), xy, atol=1e-9)


def test_shape_sigma_ignores_the_principal_point_but_not_the_scale() -> None:
    covariance = np.zeros((10, 10))
    covariance[3, 3] = covariance[4, 4] = 25.0
    camera = replace(camera_at(400.0), xi_r=0.0, xi_t=0.0, covariance=covariance)
    corner = np.array([[0.0, 0.0]])
    # Without distortion, a shift is the same everywhere.
    assert predict_shape_sigma_px(camera, corner)[0] == pytest.approx(0.0, abs=1e-9)
    # With it, the specimen is shifted back to where it is distorted as before.
    distorted = replace(camera_at(400.0), covariance=covariance)
    assert distorted.xi_r != 0.0
    assert predict_shape_sigma_px(distorted, corner)[0] == pytest.approx(0.0, abs=1e-9)
    covariance = np.zeros((10, 10))
    covariance[0, 0] = (1e-3 * camera.m) ** 2
    scaled = replace(camera, covariance=covariance)
    # 0.1 % of the distance from the centre.
    half = 0.5 * (SIZE - 1)
    assert predict_shape_sigma_px(scaled, corner)[0] == pytest.approx(
        1e-3 * half * np.sqrt(2.0), rel=1e-6
    )


def test_units_a_person_reads() -> None:
    assert format_length(2.3456e-6) == "2.346 µm"
    assert format_length(46.88e-9, 0.0234e-9) == "46.880 ± 0.023 nm"
    assert format_length(46.88e-9, 0.0) == "46.88 nm"
    assert format_length(2.3e-6) == "2.300 µm"
    assert format_length(1177e-6) == "1177 µm"
    assert format_px(None) == format_px(float("nan")) == "–"
    assert format_px(float("inf")) == "no answer"
    assert format_magnification(10000.0) == format_magnification(10000.0, 2) == "10000×"
    assert format_magnification(211.349) == "211.3×"
    assert remove_control_characters("a\x00b\ud800\n") == "a\ufffdb\ufffd\n"


def test_aligned_sigma_has_lost_shift_turn_and_scale_but_not_the_aspect() -> None:
    xy = make_field_lattice(SIZE, SIZE, 9)
    plainly = replace(camera_at(400.0), xi_r=0.0, xi_t=0.0, skew=0.0, aspect=1.0)
    for k, sigma in ((0, 1e-3 * plainly.m), (3, 5.0), (4, 5.0)):
        covariance = np.zeros((10, 10))
        covariance[k, k] = sigma**2
        camera = replace(plainly, covariance=covariance)
        assert predict_aligned_sigma_px(camera, xy) == pytest.approx(0.0, abs=1e-9)
    covariance = np.zeros((10, 10))
    covariance[1, 1] = 1e-6
    camera = replace(plainly, covariance=covariance)
    # At the middle of an edge, 0.1 % of the distance from the centre: nothing similar does that.
    edge = int(np.argmin(np.hypot(xy[:, 0], xy[:, 1] - 0.5 * (SIZE - 1))))
    expected = 1e-3 * 0.5 * (SIZE - 1)
    assert predict_aligned_sigma_px(camera, xy)[edge] == pytest.approx(expected, rel=1e-6)
    assert np.all(predict_aligned_sigma_px(replace(camera, covariance=None), xy) == 0.0)


def test_aligned_sigma_is_never_above_the_one_about_the_centroid(result: CalibrationResult) -> None:
    xy = make_field_lattice(SIZE, SIZE, 7)
    for g in (100.0, 900.0, 5000.0):
        camera = result.model.at(g)
        aligned, shape = predict_aligned_sigma_px(camera, xy), predict_shape_sigma_px(camera, xy)
        assert np.sum(aligned**2) <= 2.0 * np.sum(shape**2)


def test_error_without_distortion_is_that_of_poses_fitted_to_a_straight_camera(
    result: CalibrationResult,
) -> None:
    def straight(g: float) -> ScanCamera:
        return replace(result.model.at(g), xi_r=0.0, xi_t=0.0)

    # A height that is all but free, as it is in the linear answer.
    exact = rms_by_magnification(fit_poses(result.views, straight, height_sigma_m=1e-3))
    linear = compute_rms_without_distortion(result)
    assert list(linear) == list(exact)
    for g, value in exact.items():
        assert linear[g] == pytest.approx(value, rel=0.15)
    # Far above the noise of 0.07 px, which is what stays with the distortion corrected.
    assert linear[100.0] > 3.0 * rms_by_magnification(result.fit)[100.0]


def _with_spiral(model: CalibrationModel) -> CalibrationModel:
    """The calibration with a spiral and a settling that it did not find, each constant."""
    functions = dict(model.functions) | {
        name: ContinuousFunction("chebyshev_log", np.array([0.01]), model.magnification_range)
        for name in ("xi_s", "settling_3")
    }
    size = sum(function.size for function in functions.values())
    return replace(model, functions=functions, covariance=1e-12 * np.eye(size), residual=None)


def test_further_terms_are_no_part_of_the_error_without_distortion(
    result: CalibrationResult,
) -> None:
    other = replace(result, model=_with_spiral(result.model))
    assert compute_rms_without_distortion(other) == pytest.approx(
        compute_rms_without_distortion(result)
    )


def test_the_slider_tells_the_kinds_of_distortion_where_there_are_further_terms(
    result: CalibrationResult,
) -> None:
    name = "Largest of each kind"
    functions = {k: result.model.functions[k] for k in FUNCTION_NAMES}
    covariance = 1e-12 * np.eye(sum(function.size for function in functions.values()))
    plain = replace(result.model, functions=functions, residual=None, covariance=covariance)
    assert all(name not in dict(row["values"]) for row in tabulate_cameras(plain))
    for row in tabulate_cameras(_with_spiral(plain)):
        told = dict(row["values"])[name]
        assert re.fullmatch(
            r"radial \S+ px, decentring \S+ px, spiral \S+ px, settling \S+ px", told
        )


def test_rows_beside_the_paper(result: CalibrationResult) -> None:
    rms = rms_by_magnification(result.fit)
    rows = tabulate_beside_paper(result, rms, {100.0: 4.0, 400.0: 2.0, 1500.0: 3.0})
    assert [r.here for r in rows] == [
        "3.000 px",
        format_px(float(np.median(list(rms.values())))),
        format_px(result.fit.rms_px()),
        format_px(compute_held_out_px(result)),
    ]
    assert [r.paper.split()[0] for r in rows] == ["3", "1.45", "0.9", "not"]
    assert compute_median_px({}) is None


def test_fitted_error_beside_the_held_out_one_is_of_the_same_images(
    result: CalibrationResult,
) -> None:
    rms = rms_by_magnification(result.fit)
    assert compute_fitted_inner_px(result) == pytest.approx(
        np.hypot(rms[400.0], rms[1500.0]) / 2**0.5
    )


@pytest.mark.slow
def test_focal_length_and_its_interval() -> None:
    covariance = np.zeros((10, 10))
    covariance[0, 0], covariance[5, 5] = 9.0, 0.25
    camera = replace(camera_at(400.0), covariance=covariance)
    f, sigma = compute_focal_length_px(camera)
    assert f == pytest.approx(camera.m / 50.0)
    assert sigma == pytest.approx(np.hypot(3.0 / 50.0, f * 0.5 / 50.0))
    assert compute_focal_length_px(replace(camera, rho=0.0)) == (float("inf"), float("inf"))
    parallel: Any = SimpleNamespace(
        magnification_range=(400.0, 400.0),
        magnifications=(400.0,),
        ladder=None,
        nominal_px_per_m=lambda g: g * SIZE / 0.12,
        at=lambda _: replace(camera, rho=0.0),
    )
    groups = plot_parameters(parallel)
    assert [len(group.pictures) for group in groups] == [2, 2, 2, 4]
    assert "not shown" in groups[2].text


def test_what_costs_most_comes_first_and_says_how_many_nm(result: CalibrationResult) -> None:
    # Held-out error of 0.5 px at 1500x; 0.07 px is the noise. One view off by some px costs more.
    held_out = {**result.held_out_rms_px, 1500.0: 0.5}
    residuals = list(result.fit.residuals_px)
    residuals[6] = 60.0 * residuals[6]
    fit = replace(result.fit, residuals_px=tuple(residuals))
    bad = replace(result, held_out_rms_px=held_out, fit=fit)
    found = [own.sentence(result.model) for own in find_all(bad)]
    costs = [re.search(r"costs ([\d.e+]+) nm at (\d+)x", text) for text in found]
    assert costs[0] is not None and costs[1] is not None
    assert "corners of" in found[0] and "predicted badly" in found[1]
    pixel_m = np.mean(result.model.at(1500.0).pixel_size_m)
    assert float(costs[1][1]) == pytest.approx(0.5 * 1e9 * pixel_m, rel=0.1)


def test_a_pattern_in_the_residuals_is_found_and_noise_is_not(result: CalibrationResult) -> None:
    assert estimate_pattern_px(result)[1] < 2.0
    turned = []
    for view, own in zip(result.views, result.fit.residuals_px, strict=True):
        q = (view.image_xy - 0.5 * SIZE) / (0.5 * SIZE)
        turned.append(own + 0.1 * np.stack([-q[:, 1], q[:, 0]], axis=1))
    spiral = replace(result, fit=replace(result.fit, residuals_px=tuple(turned)))
    size, ratio = estimate_pattern_px(spiral)
    # |q|^2 has the mean 2/3 over a square.
    assert size == pytest.approx(0.1 * np.sqrt(2.0 / 3.0), rel=0.15) and ratio > 3.0
    assert any("pattern over the field" in f for f in collect_warnings(spiral))


def test_single_corners_that_are_far_off_are_no_pattern_and_no_bad_view(
    result: CalibrationResult,
) -> None:
    """One in a hundred, by 1.5 px: the adjustment bears them."""
    rng = np.random.default_rng(5)
    off = []
    for own in result.fit.residuals_px:
        wrong = rng.uniform(size=len(own)) < 0.01
        directions = rng.normal(size=own.shape)
        directions *= 1.5 / np.linalg.norm(directions, axis=1, keepdims=True)
        off.append(np.where(wrong[:, None], directions, own))
    spoiled = replace(result, fit=replace(result.fit, residuals_px=tuple(off)))
    assert sum(int(np.sum(a != b)) for a, b in zip(off, result.fit.residuals_px, strict=True)) > 20
    assert estimate_pattern_px(spoiled)[1] < 2.0
    said = set(collect_warnings(spoiled)) - set(collect_warnings(result))
    assert not any("pattern over the field" in text or "corners of" in text for text in said)


def test_many_rejected_views_are_a_finding_with_the_commonest_reason(
    result: CalibrationResult,
) -> None:
    rejected = [unused(f"{k}", 100.0, "blurred" if k else "blank") for k in range(12)]
    found = collect_warnings(result, rejected)
    assert found == ["12 of 28 views were rejected, 11 of them for this reason: blurred."]


def test_magnifications_that_fill_a_part_of_the_field_are_named(result: CalibrationResult) -> None:
    views = tuple(
        replace(v, image_xy=0.4 * v.image_xy) if v.magnification == 1500.0 else v
        for v in result.views
    )
    poor = replace(result, views=views)
    shares = compute_reached_shares(poor)
    assert shares[1500.0] < 0.3 and shares[100.0] > 0.9
    assert any("At 1500x the corners reach less than half" in f for f in collect_warnings(poor))


def test_uncertain_positions_are_a_finding(result: CalibrationResult) -> None:
    model = replace(result.model, covariance=1e6 * result.model.covariance)
    assert any("are uncertain by" in f for f in collect_warnings(replace(result, model=model)))


def test_residual_field_is_shown_where_there_is_one() -> None:
    base = camera_at(400.0)
    blank = zero_field((SIZE, SIZE), (100.0, 1000.0), 1)
    # A quarter of a px to the left of where the parametric distortion would have it, everywhere.
    shift = np.broadcast_to(np.array([-0.25, 0.0]) / base.norm_px, blank.coefficients.shape)
    field = replace(blank, coefficients=np.array(shift))
    camera = replace(base, residual=field.at(400.0))
    assert np.allclose(
        compute_displacements(camera)[1] - compute_displacements(base)[1], [0.25, 0.0]
    )
    assert remove_residual_field(camera).distort(np.zeros((1, 2))) == pytest.approx(
        base.distort(np.zeros((1, 2)))
    )
    model: Any = SimpleNamespace(residual=field)
    (picture,) = plot_residual_field(model, [camera])
    assert "at most 0.25 px" in picture.caption
    assert plot_residual_field(SimpleNamespace(residual=None), [camera]) == []  # type: ignore[arg-type]


@pytest.mark.slow
def test_predictions_need_a_covariance(result: CalibrationResult) -> None:
    pictures = plot_predicted_errors(result.model)
    lattice = make_field_lattice(SIZE, SIZE, 17)
    low, high = result.model.magnification_range
    for g in (low, high):
        camera = result.model.at(g)
        px = float(np.max(predict_shape_sigma_px(camera, lattice)))
        length = format_length(px * float(np.mean(camera.pixel_size_m)))
        assert f"{px:.2g} px ({length}) at {g:g}×" in pictures[1].caption
    bare: Any = SimpleNamespace(
        magnification_range=(low, low), image_size=(SIZE, SIZE), at=lambda _: camera_at(low)
    )
    assert plot_predicted_errors(bare) == []


def test_all_kinds_of_findings_are_ranked_together_by_nm(result: CalibrationResult) -> None:
    """A relative error of the scale costs what it moves the edge by; what costs nothing known comes last."""
    size = result.model.image_width
    at = {g: 1e9 * float(np.mean(result.model.at(g).pixel_size_m)) for g in (100.0, 1500.0)}
    unknown = Finding("unknown")
    # More px, but fewer nm than the other two.
    px = Finding("px", 2.0, magnification=1500.0)
    everywhere = Finding("scale: everywhere", cost_relative=-0.003)
    there = Finding("scale: there", cost_relative=0.03, magnification=1500.0)
    assert 2.0 * at[1500.0] < 0.015 * size * at[1500.0] < 0.0015 * size * at[100.0]
    ranked = rank_findings((unknown, px, there, everywhere, px), result.model)
    assert ranked == (everywhere, there, px, unknown)
    texts = replace(result, findings=(unknown, px, there, everywhere)).warnings
    assert [re.sub(r" \(.*", "", text) for text in texts] == [own.text for own in ranked]
    assert f"at {result.model.magnification_range[0]:.0f}x" in texts[0]
    assert Finding("nothing", 0.0).sentence(result.model) == "nothing"
    (cost,) = re.findall(r"costs ([\d.]+) nm", texts[1])
    assert float(cost) == pytest.approx(0.015 * size * at[1500.0], rel=0.05)
