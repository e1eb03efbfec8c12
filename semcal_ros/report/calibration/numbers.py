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

"""Tables of a calibration report, in readable units, and errors that are computed for them.

They are: the calibrated magnifications; the figures of the paper, Malti et al. (2012),
doi:10.1117/1.JEI.21.3.033020, next to those of the calibration; and the camera with its scale, distortion and
uncertainty at each step of a slider over the magnification.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.judgement.findings import find_all
from semcal_ros.core.calibration.views import RejectedView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.conditions import describe_condition
from semcal_ros.core.camera.projection import PARAMETER_NAMES, project_points_with_jacobians
from semcal_ros.core.camera.records import NOT_RECORDED, Provenance
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.term_sizes import describe_term_sizes, has_terms, measure_terms
from semcal_ros.core.camera.uncertainty import make_field_lattice, predict_shape_sigma_px
from semcal_ros.report.html.page import (
    format_length,
    format_magnification,
    format_px,
    remove_control_characters,
)

# Prior on the change of a pose without distortion, rad: directions that a view does not constrain
# must not diverge.
_TURN_RAD = 0.1
# The same for the height, m.
_HEIGHT_M = 1e-4

# Malti et al. (2012), doi:10.1117/1.JEI.21.3.033020: 0.9 in the abstract, 1.45 in section 4.1.3.
PAPER_RMS_PX = (0.9, 1.45)

_METHODS = {
    "joint": "joint: one adjustment of all images at all magnifications",
    "discrete": "discrete: each magnification on its own, linear in between",
    "pda": "pda: the paper's differential equations through the separate results",
}
# Section 4.1.3, medians: after the correction of drift but not of distortion.
_PAPER_STRAIGHT_PX = 3.0
# Steps of the slider: a step is less than a tenth of a factor of two over a range of 100.
_STEPS = 81
_ACROSS = 9


def compute_displacements(camera: ScanCamera, across: int = 13) -> tuple[Array, Array]:
    """Compute ideal pixels on a lattice and their displacements; NaN where undefined."""
    xy = make_field_lattice(camera.width, camera.height, across)
    return xy, camera.distort(xy) - xy


def remove_residual_field(camera: ScanCamera) -> ScanCamera:
    """Return the camera with only its parametric distortion."""
    return replace(camera, residual=None)


def compute_rms_without_distortion(result: CalibrationResult) -> dict[float, float]:
    """Compute the RMS error in px at each magnification without distortion correction.

    The poses are fitted again, linearly about those of the result.
    """
    squares: dict[float, list[Array]] = {}
    pull = np.diag([1.0 / _TURN_RAD] * 3 + [0.0, 0.0, 1.0 / _HEIGHT_M])
    poses = zip(result.fit.rotations, result.fit.translations_m, strict=True)
    for view, (rotation, translation) in zip(result.views, poses, strict=True):
        camera = remove_residual_field(result.model.at(view.magnification))
        straight = camera.parameters[: len(PARAMETER_NAMES)].copy()
        straight[[PARAMETER_NAMES.index("xi_r"), PARAMETER_NAMES.index("xi_t")]] = 0.0
        turned = view.board_xy_m @ rotation[:, :2].T
        points = turned + translation
        jacobian = project_points_with_jacobians(
            straight, points, camera.raster, points_only=True
        ).d_xyz
        x, y, z = turned.T
        o = np.zeros_like(x)
        turns = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)
        columns = np.concatenate([jacobian @ turns, jacobian], axis=2)
        error = view.known_residuals(view.image_xy - camera.project_ideal(points))
        columns = np.stack([view.known_residuals(columns[..., k]) for k in range(6)], axis=2)
        columns, error = columns.reshape(-1, 6), error.ravel()
        known = np.isfinite(error) & np.all(np.isfinite(columns), axis=1)
        normal = columns[known].T @ columns[known] + pull.T @ pull
        scaled, scale = equilibrate(normal)
        right = scale * (columns[known].T @ error[known])
        step = scale * np.linalg.lstsq(scaled, right, rcond=None)[0]
        squares.setdefault(float(view.magnification), []).append(
            view.dimensions * (error[known] - columns[known] @ step) ** 2
        )
    return {g: float(np.sqrt(np.mean(np.concatenate(s)))) for g, s in sorted(squares.items())}


@dataclass(frozen=True)
class MagnificationRow:
    """One line of the table of magnifications, ready to read."""

    magnification: str
    views: int
    corners: int
    rms: str
    held_out: str
    extrapolated: bool
    pixel_x: str
    pixel_y: str
    field: str


def tabulate_magnifications(result: CalibrationResult) -> list[MagnificationRow]:
    """Tabulate views, errors and pixel size at each calibrated magnification."""
    model = result.model
    rms = rms_by_magnification(result.fit)
    rows = []
    for g, value in rms.items():
        views = [v for v in result.views if v.magnification == g]
        camera = model.at(g)
        x, y = camera.pixel_size_m
        sigma = (None, None) if camera.covariance is None else camera.pixel_size_sigma_m
        rows.append(
            MagnificationRow(
                magnification=f"{g:g}×",
                views=len(views),
                corners=sum(len(v.image_xy) for v in views),
                rms=_format_error(value, x, y),
                held_out=_format_error(result.held_out_rms_px.get(g), x, y),
                extrapolated=g in result.held_out_rms_px and g in model.magnification_range,
                pixel_x=format_length(x, sigma[0]),
                pixel_y=format_length(y, sigma[1]),
                field=" × ".join(
                    format_length(size * count)
                    for size, count in zip((x, y), model.image_size, strict=True)
                ),
            )
        )
    return rows


def _format_error(px: float | None, *pixel_m: float) -> str:
    """An error in px and as a length."""
    text = format_px(px)
    if px is None or not np.isfinite(px):
        return text
    return f"{text}, {format_length(px * float(np.mean(pixel_m)))}"


def compute_held_out_px(result: CalibrationResult) -> float | None:
    """Compute the held-out RMS, px, of all but the two outermost magnifications, or None."""
    inner = [
        result.held_out_rms_px[g]
        for g in result.model.magnifications[1:-1]
        if g in result.held_out_rms_px
    ]
    return float(np.sqrt(np.mean(np.square(inner)))) if inner else None


def compute_fitted_inner_px(result: CalibrationResult) -> float | None:
    """As :func:`compute_held_out_px` for the fitted errors of the same magnifications."""
    rms = rms_by_magnification(result.fit)
    inner = [rms[g] for g in result.model.magnifications[1:-1] if g in result.held_out_rms_px]
    return float(np.sqrt(np.mean(np.square(inner)))) if inner else None


def collect_warnings(result: CalibrationResult, rejected: Sequence[RejectedView] = ()) -> list[str]:
    """Collect what was found about the calibration as sentences, the most costly first."""
    return [
        _format_sentence(finding.sentence(result.model)) for finding in find_all(result, rejected)
    ]


def _format_sentence(text: str) -> str:
    clean = remove_control_characters(text).strip()
    return clean[:1].upper() + clean[1:].rstrip(".") + "."


def collect_facts(result: CalibrationResult) -> list[tuple[str, str]]:
    """Collect how the calibration was computed, as (name, value) pairs."""
    model = result.model
    statistics = model.statistics
    width, height = model.image_size
    pairs = [
        ("Method", _METHODS.get(model.method, model.method)),
        ("Image size", f"{width} × {height} px"),
        ("Display width of the magnification", f"{1e3 * model.display_width_m:g} mm"),
        (
            "Poses of the report's residuals",
            "converged" if result.fit.converged else "not converged",
        ),
    ]
    pairs += _collect_origin(model.provenance)
    squares = statistics.get("squares_m")
    if squares:
        pairs.append(("Squares of the grid", ", ".join(f"{1e6 * s:g} µm" for s in squares)))
    if statistics.get("scale_over_nominal"):
        pairs.append(("Observed scale over nominal", f"{statistics['scale_over_nominal']:.4f}"))
    fit = statistics.get("fit", {})
    if isinstance(fit, Mapping):
        pairs += _collect_fit_facts(fit)
    if statistics.get("gauge"):
        pairs.append(("Convention", remove_control_characters(statistics["gauge"])))
    priors = statistics.get("priors", {})
    if isinstance(priors, Mapping) and priors:
        pairs.append(
            (
                "Priors (1/m, m and plain numbers)",
                ", ".join(f"{k} = {_format_value(v)}" for k, v in priors.items()),
            )
        )
    return [(name, remove_control_characters(value)) for name, value in pairs]


def _collect_origin(origin: Provenance) -> list[tuple[str, str]]:
    """Where the calibration comes from; what is not known is said to be not recorded."""
    recorded = " to ".join(dict.fromkeys(origin.recorded))
    pairs = [
        ("Calibrated", origin.describe_origin()),
        ("Views recorded", f"{recorded} UTC" if recorded else NOT_RECORDED),
        ("SHA-256 of the recording", origin.recording_sha256 or NOT_RECORDED),
    ]
    conditions = [describe_condition(name, values) for name, values in origin.conditions.items()]
    if not conditions:
        return [*pairs, ("Conditions", NOT_RECORDED)]
    return pairs + [(label[:1].upper() + label[1:], text) for label, text in conditions]


def _collect_fit_facts(fit: Mapping[str, Any]) -> list[tuple[str, str]]:
    pairs = []
    if "reason" in fit:
        pairs.append(("Adjustment", f"{fit['reason']} ({fit.get('iterations', '?')} iterations)"))
    elif "converged" in fit:
        pairs.append(("Adjustment", "converged" if fit["converged"] else "not converged"))
    if "variance_factor" in fit:
        root = float(np.sqrt(max(float(fit["variance_factor"]), 0.0)))
        pairs.append(("Residuals over the predicted noise of the corners", f"{root:.3f}"))
    coefficients = fit.get("coefficients", {})
    if isinstance(coefficients, Mapping) and coefficients:
        sizes = ", ".join(f"{name} {kind_size[-1]}" for name, kind_size in coefficients.items())
        pairs.append(("Coefficients of each continuous function", sizes))
    return pairs


def _format_value(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class PaperRow:
    """One kind of error, here and in the paper."""

    label: str
    here: str
    paper: str


def compute_median_px(errors: Mapping[float, float]) -> float | None:
    """Compute the median over the magnifications, px, or None."""
    values = [v for v in errors.values() if not np.isnan(v)]
    return float(np.median(values)) if values else None


def tabulate_beside_paper(
    result: CalibrationResult, rms: Mapping[float, float], straight: Mapping[float, float]
) -> list[PaperRow]:
    """Tabulate the errors of a calibration beside those of the paper.

    Parameters
    ----------
    rms, straight
        Error in px at each magnification, with and without correction of the distortion.
    """
    abstract, section = PAPER_RMS_PX
    return [
        PaperRow(
            "Distortion left in, median over the magnifications",
            format_px(compute_median_px(straight)),
            f"{_PAPER_STRAIGHT_PX:g} px (median, section 4.1.3)",
        ),
        PaperRow(
            "Distortion corrected, median over the magnifications",
            format_px(compute_median_px(rms)),
            f"{section:g} px (median, section 4.1.3)",
        ),
        PaperRow(
            "Distortion corrected, all corners",
            format_px(result.fit.rms_px()),
            f"{abstract:g} px (abstract and figure 13)",
        ),
        PaperRow(
            "Magnifications left out of the calibration, RMS without the outermost two",
            format_px(compute_held_out_px(result)),
            "not reported",
        ),
    ]


def tabulate_cameras(model: CalibrationModel) -> list[dict[str, Any]]:
    """Tabulate what the calibration says at magnifications over its range, ready to be shown.

    Each row has the magnification as ``g`` and in ``title``, the matrix ``K`` row by row as texts, and ``values``,
    pairs of a name and a text. The calibrated magnifications are among the rows, and marked ``calibrated``. A
    calibration of one magnification has one row.
    """
    low, high = model.magnification_range
    if low == high:
        return [_row(model.at(low), calibrated=True)]
    known = {float(g) for g in model.magnifications}
    steps = sorted({*map(float, np.clip(np.geomspace(low, high, _STEPS), low, high)), *known})
    return [_row(model.at(g), calibrated=g in known) for g in steps]


def _row(camera: ScanCamera, *, calibrated: bool) -> dict[str, Any]:
    sizes = camera.pixel_size_m
    sigmas = (None, None) if camera.covariance is None else camera.pixel_size_sigma_m
    mean_m = float(np.mean(sizes))
    moved = np.linalg.norm(compute_displacements(camera)[1], axis=1)
    field = (sizes[0] * camera.width, sizes[1] * camera.height)
    values = [
        ("Pixel, x", format_length(sizes[0], sigmas[0])),
        ("Pixel, y", format_length(sizes[1], sigmas[1])),
        ("Field", " × ".join(format_length(side) for side in field)),
        ("Largest distortion", _format_both(float(np.nanmax(moved)), mean_m)),
    ]
    if has_terms(camera):
        values.append(("Largest of each kind", describe_term_sizes(measure_terms(camera))))
    if camera.covariance is not None:
        lattice = make_field_lattice(camera.width, camera.height, _ACROSS)
        predicted = predict_shape_sigma_px(camera, lattice)
        if np.any(np.isfinite(predicted)):
            worst = _format_both(float(np.nanmax(predicted)), mean_m)
            values.append(("Predicted error at the edge, 1-sigma", worst))
    return {
        "g": camera.magnification,
        "title": format_magnification(camera.magnification),
        "calibrated": calibrated,
        "K": [[f"{value:.6g}" for value in line] for line in camera.K],
        "values": values,
    }


def _format_both(px: float, pixel_m: float) -> str:
    """A displacement in px and as a length."""
    return f"{px:.2g} px, {format_length(px * pixel_m)}"
