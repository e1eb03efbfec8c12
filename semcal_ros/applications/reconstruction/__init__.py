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

"""Shape of a specimen from many calibrated views of it: tracks, factorization, adjustment, surface.

After section 4.4 of Malti et al. (2012), doi:10.1117/1.JEI.21.3.033020, with the calibrated
camera of every view at its own magnification. Only :mod:`.ball` assumes that the
specimen is a ball.
"""

from __future__ import annotations

from semcal_ros.applications.reconstruction.adjustment import (
    AdjustedStructure,
    Observations,
    adjust,
)
from semcal_ros.applications.reconstruction.ball import (
    Ball,
    Roundness,
    SphereFit,
    fit_sphere,
    measure_ball,
)
from semcal_ros.applications.reconstruction.factorization import (
    AffineStructure,
    MetricUpgrade,
    Tracks,
    factorize,
    mirror_structure,
    upgrade_to_metric,
)
from semcal_ros.applications.reconstruction.feature_tracks import (
    SequenceTracker,
    TrackerSettings,
    TrackKeyframe,
)
from semcal_ros.applications.reconstruction.reconstruct import (
    Structure,
    StructureSettings,
    reconstruct,
)
from semcal_ros.applications.reconstruction.surface import SurfaceMesh, triangulate_cloud

__all__ = [
    "AdjustedStructure",
    "AffineStructure",
    "Ball",
    "MetricUpgrade",
    "Observations",
    "Roundness",
    "SequenceTracker",
    "SphereFit",
    "Structure",
    "StructureSettings",
    "SurfaceMesh",
    "TrackKeyframe",
    "TrackerSettings",
    "Tracks",
    "adjust",
    "factorize",
    "fit_sphere",
    "measure_ball",
    "mirror_structure",
    "reconstruct",
    "triangulate_cloud",
    "upgrade_to_metric",
]
