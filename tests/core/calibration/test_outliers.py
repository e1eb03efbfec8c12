"""A view whose magnification is wrong is left out and named; a microscope that jumps is not taken for that."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from semcal_ros.core.calibration.calibrate import CalibrationOptions, calibrate_views
from semcal_ros.core.calibration.views import ViewStatus
from tests.helpers.calibrations import calibrated, seen_views

OFF = CalibrationOptions(residual="off")
OPTIONS = {"image_size": (512, 512), "display_width_m": 0.12, "options": OFF}


@cache
def _calibrate_others(name):
    """Calibration from all views but the one that is misnamed."""
    return calibrate_views([v for i, v in enumerate(seen_views(name)) if i != 14], **OPTIONS)


def _misnamed(views, index, factor):
    """The view as it would be if its magnification had been recorded wrongly: the board's size follows from it."""
    out = list(views)
    # What is seen stays; the assignment of squares keeps their sides.
    out[index] = replace(views[index], board_xy_m=views[index].board_xy_m / factor)
    return out


@pytest.mark.parametrize("name", ["jsm820", "parallel", "strong_perspective"])
@pytest.mark.parametrize("factor", [1.06, 0.94])
def test_a_view_at_the_wrong_magnification_is_left_out(name, factor):
    views = seen_views(name)
    result = calibrate_views(_misnamed(views, 14, factor), **OPTIONS)
    assert [o.name for o in result.outliers] == [views[14].name]
    assert result.outliers[0].rejection.status is ViewStatus.OUTLIER
    assert "wrong magnification" in result.outliers[0].reason
    assert len(result.views) == len(views) - 1
    # As good as if that view had never been recorded.
    clean = _calibrate_others(name)
    for g in (500.0, 2600.0, 8000.0):
        np.testing.assert_allclose(result.model.at(g).m, clean.model.at(g).m, rtol=1e-6)


@pytest.mark.parametrize("name", ["jsm820", "pincushion", "spiral", "parallel"])
def test_ordinary_views_stay(name):
    for seed in range(2):
        result = calibrated(name, OFF, seed=seed)
        assert result.outliers == () and len(result.views) == 28


def test_a_jump_of_the_scale_is_not_a_matter_of_single_views():
    views = [
        replace(v, board_xy_m=v.board_xy_m / 1.03) if v.magnification > 3000.0 else v
        for v in seen_views("jsm820")
    ]
    result = calibrate_views(views, **OPTIONS)
    assert result.outliers == ()
    assert any("jump" in w for w in result.warnings)
