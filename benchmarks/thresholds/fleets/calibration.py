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

"""Random microscopes of ``benchmarks.calibration.fleet`` with few corners. Errors are in px, after a pose fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.calibration.fleet.score import judge
from benchmarks.thresholds.answers import Answer, digest_of

# Of seed 0: one axis and no residual distortion; a spiral, two visits and outliers.
MICROSCOPES = (180, 466)


def draw() -> dict[str, Any]:
    """Name the microscopes: their corners are drawn in no time."""
    return {f"microscope {index}": index for index in MICROSCOPES}


def run(index: int) -> Answer:
    """Calibrate a microscope, and judge it between the magnifications."""
    found, _ = judge(0, index)
    if found.raised:
        return Answer("refused", digest=digest_of(found.raised), seconds=found.seconds)
    error, score = np.array(found.error_px), found.px_over_sigma
    lengths = found.nm_over_sigma.ravel()
    bits = digest_of(error, found.sigma_px, found.nm_error, found.nm_sigma, *found.messages)
    return Answer(
        f"{found.verdict}, field {found.has_field}, {len(found.messages)} warnings, "
        f"{found.views_left_out} left out",
        found.corners,
        float(np.sqrt(np.mean(error**2))),
        float(error.max()),
        float(np.sqrt(np.mean(np.concatenate([score, lengths]) ** 2))),
        int(found.verdict == "wrong"),
        bits,
        found.seconds,
    )
