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

"""The commands for what a verdict says to do next."""

from __future__ import annotations

import math
import shlex
from pathlib import PurePath

from semcal_ros.core.calibration.judgement.plan import Verdict
from semcal_ros.core.wording import rounded_magnification

__all__ = ["suggest_commands"]

# The verdict's figure is without ageing; a little leaves room for what an hour changes.
_SAME_SESSION = ("--ageing", "0.01%")


def suggest_commands(verdict: Verdict, calibration: str) -> list[tuple[str, str]]:
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
