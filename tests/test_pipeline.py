"""From images to views: order, reasons, and the same result however the work is shared."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros import Calibration, calibrate
from semcal_ros.core.errors import CalibrationError
from semcal_ros.pipeline import find_views
from semcal_ros.synthetic import Detector, calibration_plan, preset

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


def test_colour_images_are_read_by_their_luma(frames):
    grey = [(image, g) for name, image, g in frames if name != "blank"]
    colour = [(np.dstack([image] * 3), g) for image, g in grey]
    assert calibrate(colour).dumps() == calibrate(grey).dumps()


def test_no_grid_at_all_is_refused_with_the_commonest_reason():
    blank = np.full((128, 128), 9, dtype=np.uint8)
    with pytest.raises(
        CalibrationError, match="no usable view among 3 images .mostly: the image is blank"
    ):
        calibrate([(blank, 1000.0)] * 3)
