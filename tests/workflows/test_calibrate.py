"""From images to views: order, reasons, and the same result however the work is shared."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros import Calibration, calibrate
from semcal_ros.core.errors import CalibrationError
from semcal_ros.synthetic import Detector, calibration_plan, preset
from semcal_ros.workflows.calibrate import calibrate_found
from semcal_ros.workflows.find_grid import find_views

SQUARES = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
PLAN = calibration_plan(
    preset("jsm820").with_image_size(256, 256),
    magnifications=(400.0, 1000.0, 2500.0),
    views=4,
    detector=Detector(),
    seed=3,
)


@pytest.fixture(scope="module")
def frames():
    made = [(f"{i}", PLAN.render(i), f.magnification) for i, f in enumerate(PLAN.frames)]
    blank = np.full((256, 256), 120, dtype=np.uint8)
    return [*made[:5], ("blank", blank, 1000.0), *made[5:]]


@pytest.mark.slow
def test_sharing_the_work_changes_nothing(frames):
    counted = []
    alone, refused_alone = find_views(frames, processes=1)
    shared, refused_shared = find_views(iter(frames), processes=2, on_progress=counted.append)
    assert len(counted) == len(frames)
    assert (
        [v.name for v in shared]
        == [v.name for v in alone]
        == [f[0] for f in frames if f[0] != "blank"]
    )
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one.detection.xy, other.detection.xy)
        np.testing.assert_array_equal(one.detection.ij, other.detection.ij)
    assert [(r.name, r.reason) for r in refused_shared] == [
        (r.name, r.reason) for r in refused_alone
    ]
    assert "blank" in refused_alone[0].reason


def test_calibrate_takes_images_in_memory(frames):
    calibration = calibrate([(image, g) for name, image, g in frames if name != "blank"])
    assert isinstance(calibration, Calibration)
    assert calibration.magnification_range == (400.0, 2500.0)
    truth = PLAN.microscope.camera_at(1600.0)
    # 12 views of 256 px: the scale is known to 0.3 % or so, since heights and scale trade off.
    assert calibration.at(1600.0).pixel_size_m == pytest.approx(truth.pixel_size_m, rel=0.01)


@pytest.mark.slow
def test_colour_images_are_read_by_their_luma(frames):
    grey = [(image, g) for name, image, g in frames if name != "blank"]
    colour = [(np.dstack([image] * 3), g) for image, g in grey]
    assert calibrate(colour).dumps() == calibrate(grey).dumps()


def test_no_grid_at_all_is_refused_with_the_commonest_reason():
    blank = np.full((128, 128), 9, dtype=np.uint8)
    with pytest.raises(
        CalibrationError, match=r"no usable view among 3 images .mostly: the image is blank"
    ):
        calibrate([(blank, 1000.0)] * 3)


@pytest.fixture(scope="module")
def found(frames):
    return find_views(frames, processes=1)


def _collected(found, magnification_of=lambda v: v.magnification, squares_m=SQUARES):
    views = [replace(v, magnification=magnification_of(v)) for v in found[0]]
    return calibrate_found(views, found[1], display_width_m=0.12, squares_m=squares_m)


@pytest.mark.slow
def test_a_view_at_a_wrong_magnification_is_named(found):
    wrong = found[0][6]
    done = _collected(found, lambda v: 1.3 * v.magnification if v is wrong else v.magnification)
    (reason,) = [r.reason for r in done.collected.rejected if r.name == wrong.name]
    assert "wrong magnification" in reason
    assert wrong.name not in [v.name for v in done.result.views]
    assert len(done.collected.views) == len(done.collected.found) == len(found[0]) - 1


@pytest.mark.slow
def test_a_slightly_wrong_magnification_is_named_after_the_adjustment(found):
    wrong = found[0][6]
    # One view among four of the same magnification whose scale is 5 % off: 1 mm of height.
    scaled = replace(
        wrong,
        detection=replace(wrong.detection, ij=wrong.detection.ij, xy=1.05 * wrong.detection.xy),
    )
    views = [scaled if v is wrong else v for v in found[0]]
    done = calibrate_found(views, found[1], display_width_m=0.12, squares_m=SQUARES)
    (reason,) = [r.reason for r in done.collected.rejected if r.name == wrong.name]
    assert "um of height" in reason
    assert len(done.result.views) == len(done.collected.found) == len(found[0]) - 1


def test_a_size_that_is_named_wrongly_is_recognised(found):
    """The views of a size that squares_m has not are left out, and told what they show."""
    shown = sorted({f.square_m for f in PLAN.frames})
    assert len(shown) > 1
    # The rarest size is called half of what it is, as when side and period are confused.
    counts = {s: sum(f.square_m == s for f in PLAN.frames) for s in shown}
    rarest = min(shown, key=lambda s: (counts[s], s))
    named = [0.6 * s if s == rarest else s for s in shown]
    done = _collected(found, squares_m=named)
    reasons = [
        r.reason for r in done.collected.rejected if r.reason != "" and "squares" in r.reason
    ]
    assert len(reasons) == counts[rarest]
    told_um = [float(re.search(r"squares are ([\d.]+) um", r).group(1)) for r in reasons]
    # Spacings of single views scatter by some percent.
    assert told_um == pytest.approx([1e6 * rarest] * len(reasons), rel=0.06)


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_periods_in_place_of_sides_are_refused(found, factor):
    with pytest.raises(CalibrationError, match="not the period") as error:
        _collected(found, squares_m=[factor * s for s in SQUARES])
    # The other explanation is named too: then the display would be so wide.
    (width,) = re.findall(r"display_width_m to ([\d.]+) m", str(error.value))
    assert float(width) == pytest.approx(0.12 * factor, rel=0.06)


def test_squares_of_no_known_size_are_refused(found):
    with pytest.raises(CalibrationError, match="none of the known sizes"):
        _collected(found, squares_m=[5e-6])
