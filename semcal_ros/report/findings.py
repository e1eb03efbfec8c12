"""What a reader should know before trusting a calibration, in plain sentences."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.calibrate import CalibrationResult
from semcal_ros.core.evaluate import rms_by_magnification
from semcal_ros.report.field_figures import empty_share, tilts_deg
from semcal_ros.report.numbers import plain

__all__ = ["findings"]

_EMPTY_SHARE = 0.05
_SMALL_TILT_DEG = 5.0
# Predicting a magnification from the others is a little worse than fitting it; this much worse
# means that the functions between the magnifications miss something.
_HELD_OUT_RATIO = 1.5


def _sentence(text: str) -> str:
    clean = plain(text).strip()
    return clean[:1].upper() + clean[1:].rstrip(".") + "."


def findings(result: CalibrationResult) -> list[str]:
    """The warnings of the calibration, then what an expert would see in the report's pictures."""
    found = [*result.warnings, *_field(result), *_held_out(result)]
    if not result.fit.converged:
        found.append("the poses of some views did not settle; their residuals may be too large")
    return [_sentence(text) for text in dict.fromkeys(found)]


def _field(result: CalibrationResult) -> list[str]:
    found = []
    empty = empty_share(result)
    if empty > _EMPTY_SHARE:
        found.append(
            f"{100.0 * empty:.0f} % of the image field has no corner in any view: "
            "the distortion there is extrapolated; let the grid fill the image"
        )
    largest = float(np.max(tilts_deg(result)[0]))
    if largest < _SMALL_TILT_DEG:
        found.append(
            f"no view is tilted by more than {largest:.1f} degrees: scale and height are hardly "
            "separated; tilt the grid by 20 to 40 degrees in different directions"
        )
    return found


def _held_out(result: CalibrationResult) -> list[str]:
    values = result.held_out_rms_px
    without = [f"{g:g}×" for g, value in values.items() if np.isinf(value)]
    if without:
        return [f"without the images at {', '.join(without)} the method has no answer there"]
    fitted = rms_by_magnification(result.fit)
    # The two outermost magnifications are extrapolated in this test, unlike in any proper use.
    inner = [g for g in result.model.magnifications[1:-1] if g in values]
    worse = [f"{g:g}×" for g in inner if values[g] > _HELD_OUT_RATIO * fitted[g]]
    if worse:
        return [
            f"the images at {', '.join(worse)} are predicted badly from the other magnifications: "
            "take images at more magnifications around there"
        ]
    return []
