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

"""The report of a calibration, with the commands for what its verdict says to do next."""

from __future__ import annotations

import math
import os
import re
import shlex
from base64 import b64encode
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.judgement.plan import Judgement, judge_calibration
from semcal_ros.core.calibration.views import FoundView, RejectedView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.wording import in_nm, rounded_magnification
from semcal_ros.report.calibration.coverage_figures import (
    plot_coverage,
    plot_reached_shares,
    plot_tilt_directions,
    plot_tilts,
)
from semcal_ros.report.calibration.curves import parts_by_specimen
from semcal_ros.report.calibration.error_figures import (
    plot_distortion,
    plot_mean_residuals,
    plot_predicted_errors,
    plot_residual_field,
    plot_residual_histogram,
    plot_residuals,
    plot_rms,
)
from semcal_ros.report.calibration.numbers import (
    collect_facts,
    collect_warnings,
    compute_fitted_inner_px,
    compute_held_out_px,
    compute_rms_without_distortion,
    tabulate_beside_paper,
    tabulate_cameras,
    tabulate_magnifications,
)
from semcal_ros.report.calibration.parameter_figures import plot_parameters, plot_pixel_sizes
from semcal_ros.report.calibration.view_pictures import (
    choose_blink,
    choose_examples,
    choose_worst_views,
    overlay_corners,
    show_rejected,
)
from semcal_ros.report.html.encode import encode_pictures
from semcal_ros.report.html.page import (
    format_length,
    format_px,
    remove_control_characters,
    render,
    write_page,
)

# Example images on a page, at most: they make most of its size.
_MAX_OVERLAYS = 24
# Examples that are visible at once; the others unfold.
_FIRST_OVERLAYS = 8
# Thumbnails of rejected images, at most.
_MAX_THUMBNAILS = 12
# Rows in the list of rejected images, at most.
_MAX_REJECTED = 200
# Views that fit worst and can be opened.
_WORST_VIEWS = 5
# The verdict's figure is without ageing; a little leaves room for what an hour changes.
_SAME_SESSION = ("--ageing", "0.01%")


def write_calibration_report(
    result: CalibrationResult,
    path: str | os.PathLike[str],
    *,
    detections: Sequence[FoundView] = (),
    rejected: Sequence[RejectedView] = (),
    images: Sequence[tuple[str, NDArray[Any]]] = (),
    title: str = "SEM calibration",
    paper: bool = False,
    calibration: str = "",
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
        Images that were not used, with the reason; shown if their attribute ``image`` is set.
    images
        More images as (caption, image), shown at the end.
    title
        Heading of the page.
    paper
        Whether an appendix compares the errors with those that the paper prints.
    calibration
        File of the calibration, for the commands of what to do next; without it they are left out.

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
    extra = encode_pictures(images)
    shown = _choose_evenly(choose_examples(detections), _MAX_OVERLAYS)
    first = _choose_evenly(shown, _FIRST_OVERLAYS)
    examples = _choose_example_cameras(model)
    verdict = judge_calibration(model)
    rms, straight = rms_by_magnification(result.fit), compute_rms_without_distortion(result)
    # A single magnification has no curves.
    curves = len(rms) > 1
    script = _slider_script() if curves else ""
    values = {
        "title": remove_control_characters(title),
        "verdict": [_sentence(text) for text in (verdict.describe(), verdict.advise()) if text],
        "commands": [
            (what, remove_control_characters(command))
            for what, command in suggest_commands(verdict, calibration)
        ],
        "summary": _summarise(result, len(rejected)),
        "warnings": collect_warnings(result, rejected),
        "cameras": tabulate_cameras(model),
        "slider": script,
        "slider_hash": f"sha256-{b64encode(sha256(script.encode()).digest()).decode()}",
        "errors": [plot_rms(result, straight, paper=paper)] if curves else [],
        "paper": tabulate_beside_paper(result, rms, straight) if paper else [],
        "predicted": plot_predicted_errors(model),
        "residuals": [
            plot_mean_residuals(result),
            plot_residuals(result),
            plot_residual_histogram(result),
        ],
        "distortion": [plot_distortion(camera) for camera in examples],
        "residual_field": plot_residual_field(model, examples),
        "pixel_size": plot_pixel_sizes(model) if curves else [],
        "parameters": plot_parameters(model) if curves else [],
        "coverage": [
            plot_coverage(result),
            *([plot_reached_shares(result)] if curves else []),
            plot_tilt_directions(result),
            *([plot_tilts(result)] if curves else []),
        ],
        "overlays": [overlay_corners(view, model) for view in first],
        "more_overlays": [
            overlay_corners(v, model) for v in shown if all(v is not f for f in first)
        ],
        "blink": choose_blink(result, detections),
        "refused_corners": sum(d.detection.rejected for d in detections),
        "rejected_images": show_rejected(rejected, _MAX_THUMBNAILS, model),
        "rejected": [
            (
                remove_control_characters(r.name),
                f"{r.magnification:g}×",
                remove_control_characters(r.reason),
            )
            for r in rejected[:_MAX_REJECTED]
        ],
        "rejected_count": len(rejected),
        "worst_views": choose_worst_views(result, detections, _WORST_VIEWS),
        "rows": tabulate_magnifications(result),
        "facts": collect_facts(result),
        "images": extra,
    }
    return write_page(path, render("calibration.html.j2", values))


def _sentence(text: str) -> str:
    """What the terminal says, as a page says it; Nm would be newton metres."""
    text = text.replace("nm per px is known", "The scale (nm per px) is known", 1)
    text = re.sub(r"(\d)x\b", r"\1×", re.sub(r" um\b", " µm", text.replace("+-", "±")))
    return text[:1].upper() + text[1:] + "."


def _slider_script() -> str:
    """The script of the slider: it has no network, and the page allows no other script."""
    file = files("semcal_ros.report.html") / "templates" / "magnification_slider.js"
    return file.read_text(encoding="utf-8")


def _choose_evenly(views: list[FoundView], count: int) -> list[FoundView]:
    """Choose at most ``count`` views evenly, including the first and the last."""
    if len(views) <= count:
        return views
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, count).round().astype(int))]


def _choose_example_cameras(model: CalibrationModel) -> list[ScanCamera]:
    low, high = model.magnification_range
    if low == high:
        return [model.at(low)]
    return [model.at(g) for g in (low, float(np.sqrt(low * high)), high)]


def _summarise(result: CalibrationResult, rejected: int) -> list[tuple[str, str, str]]:
    """Summarise the key figures as (name, value, remark)."""
    model = result.model
    low, high = model.magnification_range
    held_out = compute_held_out_px(result)
    size = [model.at(g).pixel_size_m[0] for g in (low, high)]
    corners = sum(len(v.image_xy) for v in result.views)
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
            f"{_span_nm(result, {g: px for g, px in result.held_out_rms_px.items() if low < g < high})}; RMS of "
            "images left out, without the outermost magnifications; "
            f"fitted: {format_px(compute_fitted_inner_px(result))}"
            if held_out is not None
            else "needs 3 magnifications",
        ),
        (
            "Error of all views",
            format_px(result.fit.rms_px()),
            f"{_span_nm(result, rms_by_magnification(result.fit))}; RMS of all corners",
        ),
        (
            "Magnification",
            span,
            f"{len(model.magnifications)} calibrated, continuous in between{_describe_origin(model)}"
            if high > low
            else "the only one calibrated",
        ),
        ("Pixel size", pixel, "along x"),
        ("Views", f"{len(result.views)} used", f"{rejected} rejected"),
        ("Corners", f"{corners}", f"{corners / len(result.views):.0f} per view"),
    ]


def _describe_origin(model: CalibrationModel) -> str:
    """Which part of the range a specimen tells, not a grid; empty where there is none."""
    parts = [f"{low:g}× to {high:g}×" for low, high in parts_by_specimen(model)]
    return f"; {' and '.join(parts)} by a specimen, the rest by a grid" if parts else ""


def _span_nm(result: CalibrationResult, rms_px: Mapping[float, float]) -> str:
    """Errors at some magnifications as lengths, from the least to the largest."""
    lengths = [
        px * float(np.mean(result.model.at(g).pixel_size_m))
        for g, px in rms_px.items()
        if np.isfinite(px)
    ]
    if not lengths:
        return "no length known"
    least, largest = (in_nm(x).replace(" um", " µm") for x in (min(lengths), max(lengths)))
    # The unit once, if it is that of both.
    if least.partition(" ")[2] == largest.partition(" ")[2]:
        least = least.partition(" ")[0]
    return largest if largest.startswith(f"{least} ") else f"{least} to {largest}"


def suggest_commands(verdict: Judgement, calibration: str) -> list[tuple[str, str]]:
    """Suggest what to run next.

    Parameters
    ----------
    verdict
        What the calibration is good for.
    calibration
        Its file; if it is empty, nothing is suggested.

    Returns
    -------
    list
        (what it does, command) pairs, to be run in this order.
    """
    if not calibration:
        return []
    path = PurePath(calibration)
    visit = verdict.next_visit
    if visit is None:
        if not math.isfinite(verdict.floor):
            return []
        budget = ["semcal", "at", calibration, f"{float(f'{verdict.at:.4g}'):g}", "--budget"]
        return [("What the uncertainty consists of:", shlex.join(budget))]
    # No lower than what the visit reaches, so that the plan ends with it.
    percent = 100.0 * visit.largest
    step = 10.0 ** (math.floor(math.log10(percent)) - 1)
    target = f"{math.ceil(percent / step) * step:.2g}%"
    views = f"views_{rounded_magnification(visit.magnification)}"
    renewed = str(path.with_name(f"{path.stem}_improved{path.suffix}"))
    return [
        (
            "What to set and how to tilt or turn:",
            shlex.join(["semcal", "plan", calibration, "--target", target, *_SAME_SESSION]),
        ),
        (
            f"With these views, of the same session, in the folder or bag {views}:",
            shlex.join(["semcal", "update", calibration, views, "-o", renewed, *_SAME_SESSION]),
        ),
    ]
