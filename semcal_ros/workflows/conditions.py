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

"""Whether a recording was taken under the conditions of a calibration."""

from __future__ import annotations

from dataclasses import asdict, replace

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.conditions import compare_conditions
from semcal_ros.core.wording import printable
from semcal_ros.files.tiff.sem_image import Conditions

# Differences that a note names: those of a recording whose conditions change from frame to frame are no list to read.
_MOST_NAMED = 4


class ConditionsComparison:
    """Compares the conditions of frames with those of a calibration; what one of them does not tell is not compared.

    Parameters
    ----------
    calibration
        None: nothing is compared.
    scans_may_turn
        Whether a rotation of the scan is no other condition.
    """

    def __init__(self, calibration: Calibration | None, *, scans_may_turn: bool = False) -> None:
        self._calibration = calibration
        self._scans_may_turn = scans_may_turn
        self._last: Conditions | None = None
        self._found: dict[str, bool] = {}

    def add(self, conditions: Conditions | None) -> None:
        """Take the conditions of a frame."""
        if conditions is not None and self._scans_may_turn:
            conditions = replace(conditions, scan_rotation_rad=None)
        if self._calibration is None or conditions is None or conditions == self._last:
            return
        self._last = conditions
        found = compare_conditions(
            self._calibration.provenance.conditions,
            {name: value for name, value in asdict(conditions).items() if value not in (None, "")},
            height_sigma_m=self._calibration.scale_sigma.height_m,
        )
        self._found |= {difference.text: difference.decisive for difference in found}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user: one of what may change the scale, one of what does not."""
        decisive = self._name(True)
        others = self._name(False)
        out = []
        if decisive:
            out.append(
                f"other conditions than those of the calibration: {decisive}; check it (semcal check), or use one that "
                "was made under these conditions"
            )
        if others:
            out.append(f"different from the calibration: {others}")
        return tuple(printable(note) for note in out)

    def _name(self, decisive: bool) -> str:
        texts = [text for text, is_decisive in self._found.items() if is_decisive is decisive]
        more = len(texts) - _MOST_NAMED
        return ", ".join(texts[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
