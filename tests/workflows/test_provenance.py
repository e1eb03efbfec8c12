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

"""Origin of a calibration: digests that sha256sum confirms, ranges over the views, nothing made up."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros import Calibration
from semcal_ros.bridge.conditions import Conditions
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.records import Provenance
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame
from semcal_ros.workflows.inputs import resolve_config
from semcal_ros.workflows.provenance import ConditionsComparison, describe_provenance
from tests.helpers.calibrations import DEFAULT, calibrated

CONFIG: MicroscopeConfig = resolve_config("generic")

MADE = {
    "acceleration_voltage_v": (5e3, 5e3),
    "working_distance_m": (0.01, 0.0101),
    "detector": ("SE",),
}


def _frame(stamp_ns: int, conditions: Conditions | None = None) -> RecordedFrame:
    return RecordedFrame(
        np.zeros((0, 4), np.uint8), stamp_ns, stamp_ns, 100.0, "", "mono8", conditions=conditions
    )


def test_digest_is_that_of_the_data_of_a_bag(tmp_path):
    bag = tmp_path / "grid"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("one")
    (bag / "notes.json").write_text("{}")
    (bag / "grid_0.mcap").write_bytes(b"data")
    first = describe_provenance(RecordedFiles(bag), CONFIG, {})
    assert first.recording == "grid"
    assert first.recording_sha256 == hashlib.sha256(b"data").hexdigest()
    (bag / "grid_1.mcap").write_bytes(b"more")
    names = ("grid_0.mcap", b"data"), ("grid_1.mcap", b"more")
    lines = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in names)
    both = describe_provenance(str(bag), CONFIG, {})
    assert both.recording_sha256 == hashlib.sha256(lines.encode()).hexdigest()


def test_conditions_are_ranges_over_the_views():
    views = {
        "frame 0": _frame(
            1_700_000_000 * 10**9, Conditions(maker="zeiss", working_distance_m=0.01)
        ),
        "frame 2": _frame(
            1_700_000_060 * 10**9, Conditions(maker="zeiss", working_distance_m=0.012)
        ),
    }
    origin = describe_provenance([], CONFIG, views)
    assert origin.conditions == {"maker": ("zeiss",), "working_distance_m": (0.01, 0.012)}
    assert origin.recorded == ("2023-11-14 22:13:20", "2023-11-14 22:14:20")
    assert origin.views == ("frame 0", "frame 2")


def test_what_is_not_known_is_left_empty():
    origin = describe_provenance([], CONFIG, {"frame 0": _frame(5)})
    assert (origin.recording, origin.recording_sha256, origin.recorded) == ("", "", ())
    assert origin.conditions == {}


def notes(calibration: Calibration | None, *seen: Conditions | None) -> tuple[str, ...]:
    comparison = ConditionsComparison(calibration)
    for own in seen:
        comparison.add(own)
    return comparison.notes


def test_a_scan_that_turns_on_purpose_is_no_other_condition(calibration: Calibration) -> None:
    made = replace(calibration.provenance, conditions={**MADE, "scan_rotation_rad": (0.0, 0.0)})
    unturned = Calibration.from_model(replace(calibration, provenance=made))
    for may_turn, count in ((False, 1), (True, 0)):
        comparison = ConditionsComparison(unturned, scans_may_turn=may_turn)
        comparison.add(Conditions(scan_rotation_rad=1.57))
        assert len(comparison.notes) == count


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    model = calibrated("jsm820", DEFAULT).model
    return Calibration.from_model(replace(model, provenance=Provenance(conditions=MADE)))


def test_what_changes_the_scale_and_what_does_not_are_told_once_each(
    calibration: Calibration,
) -> None:
    other = Conditions(acceleration_voltage_v=1e4, detector="BSE")
    decisive, harmless = notes(calibration, other, other, replace(other, working_distance_m=0.0115))
    assert (
        "voltage 10 kV, calibrated at 5 kV, working distance 11.5 mm, calibrated at 10 mm to 10.1 mm"
        in decisive
    )
    assert decisive.count("voltage 10 kV") == 1 and "semcal check" in decisive
    assert harmless == "different from the calibration: detector BSE, calibrated at SE"
    # A list that nobody reads is cut.
    (many,) = notes(
        calibration, *(Conditions(working_distance_m=0.02 + 1e-3 * k) for k in range(9))
    )
    assert many.count("calibrated at") == 4 and "and 5 more" in many


def test_what_one_of_them_does_not_tell_is_not_compared(calibration: Calibration) -> None:
    same = Conditions(acceleration_voltage_v=5e3, working_distance_m=0.01005, detector="se")
    assert notes(calibration, same, None, Conditions()) == ()
    unknown = Calibration.from_model(replace(calibration, provenance=Provenance()))
    other = Conditions(acceleration_voltage_v=1e4)
    assert notes(unknown, other) == notes(None, other) == ()
