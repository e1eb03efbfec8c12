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

"""What the figures in the findings mean."""

from __future__ import annotations

from collections.abc import Iterable

from semcal_ros.doctor.findings import Finding

__all__ = ["explain_figures"]

# Words in a finding, and what the figure beside them is.
_FIGURES = (
    (" Hz", "Hz: messages per second while this command listened, or in the recording"),
    (
        "old when they arrive",
        "age of frames: from the stamp, the start of the scan, to the arrival; it includes the scan itself",
    ),
    (
        "from publisher to here",
        "from publisher to here: the transport alone, by the clocks of both",
    ),
    (
        "predicted 1-sigma error",
        "1-sigma error: standard deviation, by the calibration's covariance, of the pixel to which a point of known"
        " position is projected; most of it is common to all points of an image and drops out of distances in it",
    ),
    (
        "MiB of shared memory",
        "shared memory: the segment of each process; larger messages wait for room",
    ),
)


def explain_figures(findings: Iterable[Finding]) -> list[str]:
    """Return one sentence for each kind of figure that the findings show."""
    shown = [str(finding) for finding in findings]
    return [text for words, text in _FIGURES if any(words in line for line in shown)]
