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

"""A short recording of a ball that turns, with the calibration of its microscope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import AnyImage
from semcal_ros.synthetic import Detector
from semcal_ros.synthetic.specimens.ball import Turning, ball_microscope, ball_plan
from tests.helpers.node_scenes import make_calibration


def turning_ball() -> tuple[list[tuple[AnyImage, float, float]], Calibration]:
    """16 images of 512 x 192 px with magnification and time, s."""
    microscope = ball_microscope("ideal", width=512, height=192)
    plan = ball_plan(
        microscope,
        frames=16,
        interval_s=5.0,
        magnifications=(36000.0,),
        motion=Turning(
            80.0,
            rolls=1.0,
            yaws=1.0,
            roll_rad=0.3,
            travel_m=(1e-7, 5e-8, 0.0),
            centre_m=(-2e-7, 0.0, 0.0),
        ),
        detector=Detector(electrons=400.0),
    )
    images = [(plan.render(k), f.magnification, f.start_time_s) for k, f in enumerate(plan.frames)]
    true = {"scale": 1.0, "aspect": 1.0, "px": 255.5, "py": 95.5, "ex": 255.5, "ey": 95.5}
    functions = {
        name: replace(function, coefficients=np.array([true.get(name, 0.0)]))
        for name, function in make_calibration().functions.items()
    }
    calibration = replace(
        make_calibration(),
        functions=functions,
        covariance=1e-8 * np.eye(len(functions)),
        image_width=512,
        image_height=192,
    )
    return images, calibration
