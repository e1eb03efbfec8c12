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


"""A few particles tell a shift as well as their gradients allow, and its sigma says so."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.registration.register import prepare_reference, register


@pytest.mark.long
def test_few_particles_reach_the_bound_with_a_sigma_that_holds() -> None:
    scores, sigmas, bounds = [], [], []
    for seed in range(300, 308):
        frames, drift, bound_px = draw(KINDS["sparse"], seed)
        reference = prepare_reference(frames[0])
        for k in (9, 19, 29):
            found = register(
                reference, frames[k], guess_px=drift[k], guess_covariance=0.04 * np.eye(2)
            )
            assert found.accepted, found.reason
            sigma = np.sqrt(np.diag(found.covariance))
            scores.append((found.shift_px - drift[k]) / sigma)
            sigmas.append(float(np.hypot(*sigma)))
            bounds.append(np.sqrt(2.0) * bound_px)
    # 48 scores, in eights with the noise of one reference in common: as uncertain as 24 of their own, whose RMS is
    # within 0.55 to 1.45 but once in 1000 times.
    assert 0.55 < float(np.sqrt(np.mean(np.square(scores)))) < 1.45
    # From the scatter of eight scores alone, the sigma would be 2.5 times the bound.
    ratio = np.array(sigmas) / np.array(bounds)
    assert float(np.mean(ratio)) < 2.2
