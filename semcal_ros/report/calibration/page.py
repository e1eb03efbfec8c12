"""The report of a calibration."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.calibration.calibrate import CalibrationResult
from semcal_ros.core.calibration.evaluate import rms_by_magnification
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.report.calibration.coverage_figures import (
    coverage_picture,
    filled_picture,
    pose_picture,
    tilt_picture,
)
from semcal_ros.report.calibration.error_figures import residual_histogram, rms_picture
from semcal_ros.report.calibration.examples import (
    ExampleView,
    UnusedView,
    best_per_magnification,
    overlay_of,
    rejected_pictures,
)
from semcal_ros.report.calibration.field_figures import (
    distortion_picture,
    mean_residual_picture,
    residual_field_pictures,
    residual_picture,
)
from semcal_ros.report.calibration.findings import findings
from semcal_ros.report.calibration.geometry import rms_without_distortion
from semcal_ros.report.calibration.numbers import (
    PAPER_RMS_PX,
    facts,
    fitted_inner_px,
    format_length,
    format_px,
    held_out_px,
    magnification_rows,
    plain,
    view_rows,
)
from semcal_ros.report.calibration.paper import paper_rows
from semcal_ros.report.calibration.parameter_figures import parameter_groups
from semcal_ros.report.calibration.pixel_size_figures import pixel_size_pictures
from semcal_ros.report.calibration.prediction_figures import prediction_pictures
from semcal_ros.report.html.encode import captioned_pictures
from semcal_ros.report.html.page import render, write_page

__all__ = ["calibration_report"]

_MAX_OVERLAYS = 24
# Seen at once; the others unfold.
_FIRST_OVERLAYS = 8
_MAX_THUMBNAILS = 12
_MAX_REJECTED = 200
_WORST_VIEWS = 5


def calibration_report(
    result: CalibrationResult,
    path: str | os.PathLike[str],
    *,
    detections: Sequence[ExampleView] = (),
    rejected: Sequence[UnusedView] = (),
    images: Sequence[tuple[str, NDArray[Any]]] = (),
    title: str = "SEM calibration",
) -> Path:
    """Write one self-contained HTML file about a calibration.

    Parameters
    ----------
    result
        The calibration with its views and residuals.
    path
        The file to write.
    detections
        Images with their corners; the one with most corners is shown for each magnification.
    rejected
        Images that were not used, with the reason; with their picture where they have an
        attribute ``image``.
    images
        More pictures as (caption, image), shown at the end.
    title
        Heading of the page.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    InvalidValueError
        If an image has an unsupported shape, or the file cannot be written.
    """
    model = result.model
    extra = captioned_pictures(images)
    shown = _spread(best_per_magnification(detections), _MAX_OVERLAYS)
    first = _spread(shown, _FIRST_OVERLAYS)
    examples = _low_middle_high(model)
    rms, straight = rms_by_magnification(result.fit), rms_without_distortion(result)
    values = {
        "title": plain(title),
        "summary": _summary(result, len(rejected)),
        "warnings": findings(result, rejected),
        "errors": [rms_picture(result, straight)],
        "paper": paper_rows(result, rms, straight),
        "predicted": prediction_pictures(model),
        "residuals": [
            mean_residual_picture(result),
            residual_picture(result),
            residual_histogram(result),
        ],
        "distortion": [distortion_picture(camera) for camera in examples],
        "residual_field": residual_field_pictures(model, examples),
        "pixel_size": pixel_size_pictures(model),
        "parameters": parameter_groups(model),
        "coverage": [
            coverage_picture(result),
            filled_picture(result),
            pose_picture(result),
            tilt_picture(result),
        ],
        "overlays": [overlay_of(view) for view in first],
        "more_overlays": [overlay_of(v) for v in shown if all(v is not f for f in first)],
        "refused_corners": sum(d.detection.rejected for d in detections),
        "rejected_images": rejected_pictures(rejected, _MAX_THUMBNAILS),
        "rejected": [
            (plain(r.name), f"{r.magnification:g}×", plain(r.reason))
            for r in rejected[:_MAX_REJECTED]
        ],
        "rejected_count": len(rejected),
        "worst_views": view_rows(result)[:_WORST_VIEWS],
        "rows": magnification_rows(result),
        "facts": facts(result),
        "images": extra,
    }
    return write_page(path, render("calibration.html.j2", values))


def _spread(views: list[ExampleView], count: int) -> list[ExampleView]:
    """At most ``count`` of the views, evenly chosen, with the first and the last."""
    if len(views) <= count:
        return views
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, count).round().astype(int))]


def _low_middle_high(model: CalibrationModel) -> list[ScanCamera]:
    low, high = model.magnification_range
    if low == high:
        return [model.at(low)]
    return [model.at(g) for g in (low, float(np.sqrt(low * high)), high)]


def _summary(result: CalibrationResult, rejected: int) -> list[tuple[str, str, str]]:
    """The key figures as (name, value, remark)."""
    model = result.model
    low, high = model.magnification_range
    held_out = held_out_px(result)
    size = [model.at(g).pixel_size_m[0] for g in (low, high)]
    corners = sum(len(v.image_xy) for v in result.views)
    paper = f"paper: {PAPER_RMS_PX[0]:g} to {PAPER_RMS_PX[1]:g} px"
    span = f"{low:g}× to {high:g}×" if high > low else f"{low:g}×"
    pixel = (
        f"{format_length(size[0])} to {format_length(size[1])}"
        if high > low
        else format_length(size[0])
    )
    return [
        (
            "Held-out error",
            format_px(held_out),
            "RMS of images left out, without the outermost magnifications; "
            f"fitted: {format_px(fitted_inner_px(result))}"
            if held_out is not None
            else "needs 3 magnifications",
        ),
        ("Error of all views", format_px(result.fit.rms_px()), f"RMS of all corners; {paper}"),
        ("Magnification", span, f"{len(model.magnifications)} calibrated, continuous in between"),
        ("Pixel size", pixel, "along x"),
        ("Views", f"{len(result.views)} used", f"{rejected} rejected"),
        ("Corners", f"{corners}", f"{corners / len(result.views):.0f} per view"),
    ]
