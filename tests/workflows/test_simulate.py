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

"""Recordings of the virtual SEM."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from semcal_ros import calibrate
from semcal_ros.config.config import load_config
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.bags.reader import open_bag
from semcal_ros.files.recordings import open_recording
from semcal_ros.synthetic import STAGES, make_stage, preset
from semcal_ros.workflows.describe_recording import describe_recording
from semcal_ros.workflows.simulate import SimulationOptions, plan_recording, simulate

SCOPE = preset("ideal").with_image_size(64, 64)


def test_a_simulated_recording_contains_what_was_asked_for(tmp_path):
    seen = []
    count = simulate(
        tmp_path / "zoom",
        "zoom",
        microscope="ideal",
        magnifications=(500.0, 2000.0),
        frames=3,
        size=64,
        bits=16,
        on_progress=lambda *a: seen.append(a),
    )
    assert count == 3
    assert seen[0] == ("simulating", 0, 3) and seen[-1] == ("simulating", 3, 3)
    found = describe_recording(tmp_path / "zoom")
    assert found.frame_count == 3
    assert found.kinds == {"64 x 64 mono16": 3}
    assert found.magnifications == pytest.approx((500.0, 1000.0, 2000.0))
    # The stage stands still: it speaks once.
    assert {topic.name: topic.count for topic in found.topics} == {
        "/sem/image_raw": 3,
        "/sem/magnification": 3,
        "/sem/stage": 1,
        "/sem/conditions": 1,
    }
    with pytest.raises(BagError, match="exists"):
        simulate(tmp_path / "zoom", "zoom", frames=2, size=64)


@pytest.mark.parametrize(
    ("kind", "frames"), [("grid", 2 * 21), ("drift", 48), ("steps", 3 * 12), ("zoom", 36)]
)
def test_every_plan_has_its_defaults(kind, frames):
    assert len(plan_recording(SCOPE, SimulationOptions(kind, views=2))) == frames


@pytest.mark.parametrize(
    ("kind", "arguments", "reason"),
    [
        ("film", {}, "one of grid, drift"),
        ("drift", {"magnifications": (1.0, 2.0)}, "plan drift with magnifications 1, 2"),
        ("zoom", {"magnifications": (1.0,)}, "expected 2 of them, or none"),
        ("steps", {"magnifications": (-1.0,)}, "magnifications: -1"),
        ("steps", {"specimen": "cat"}, "specimen 'cat'"),
        ("zoom", {"drift": "no"}, "drift preset 'no'"),
    ],
)
def test_plans_that_cannot_be_made_are_refused(kind, arguments, reason):
    with pytest.raises(InvalidValueError, match=reason):
        plan_recording(SCOPE, SimulationOptions(kind, **arguments))


def test_the_stage_is_recorded_as_the_configuration_reads_it(tmp_path: Path) -> None:
    bag = tmp_path / "grid"
    simulate(bag, "grid", magnifications=(500.0, 4000.0), views=4, size=64)
    truth = json.loads((bag / "truth.json").read_text())
    with open_recording(bag, load_config("virtual_sem")) as recording:
        frames, notes = list(recording.frames()), recording.notes
    assert not notes
    assert [frame.magnification for frame in frames] == [500.0] * 2 + [4000.0] * 4 + [500.0] * 2
    for frame, row in zip(frames, truth["frames"], strict=True):
        assert frame.stage is not None
        assert frame.stage.tilt_rad == row["stage_read"]["tilt"]
        assert frame.stage.rotation_rad == row["stage_read"]["rotation"]
        assert frame.stage.scan_rotation_rad == 0.0
        # What is left beside the constant error is within what the configuration states.
        error = frame.stage.tilt_rad - row["stage"]["tilt"] - truth["stage"]["tilt_error_rad"]
        assert abs(error) < 3.0 * 0.0035
    with open_bag(bag) as reader:
        said = [m for m in reader.messages() if m.topic == "/sem/stage"]
        shown = [m for m in reader.messages() if m.topic == "/sem/image_raw"]
    # One message before each change: every view has a position of its own.
    assert len(said) == len(shown) == 8
    for stage, image in zip(said, shown, strict=True):
        assert stage.log_time_ns < image.log_time_ns
        assert list(stage.message.name) == ["tilt", "rotation", "x", "y", "z", "scan_rotation"]
        assert np.all(np.isfinite(stage.message.position))


def test_the_conditions_are_recorded_as_a_calibration_reads_them(tmp_path: Path) -> None:
    simulate(tmp_path / "zoom", "zoom", microscope="ideal", frames=2, size=64)
    timing = preset("ideal").timing
    with open_recording(tmp_path / "zoom", load_config("virtual_sem")) as recording:
        found = [frame.conditions for frame in recording.frames()]
    assert len(found) == 2 and found[0] == found[1]
    told = found[0]
    assert told is not None
    assert (told.maker, told.model, told.detector) == ("semcal_ros", "ideal", "simulated")
    assert told.acceleration_voltage_v == 10e3 and told.working_distance_m == 0.01
    assert told.frame_time_s == timing.frame_time_s and told.scan_rotation_rad == 0.0
    # The beam is on a pixel for its share of the part of the line that is recorded.
    pixels_s = 64 * 64 * timing.line_averages * told.dwell_s
    assert pixels_s == pytest.approx(timing.frame_time_s * (1.0 - timing.flyback_fraction))


def test_a_stage_like_no_other_and_a_perfect_one_say_nothing(tmp_path: Path) -> None:
    for name, stage in (("two-axis", STAGES["two-axis"]), ("perfect", None)):
        simulate(tmp_path / name, magnifications=(500.0,), views=2, size=64, stage=stage, grid=None)
        topics = {topic.name for topic in describe_recording(tmp_path / name).topics}
        assert topics == {"/sem/image_raw", "/sem/magnification", "/sem/conditions"}


@pytest.mark.slow
@pytest.mark.long
def test_a_calibration_on_the_stage_is_right_within_what_it_states(tmp_path: Path) -> None:
    """An axis that misses by 0.2 mm, a magnification that comes back to 0.3 %, and a grid as it is made."""
    scope = preset("jsm820")
    g = (150.0, 300.0, 600.0, 1200.0, 2500.0, 4500.0, 7000.0, 10000.0)
    stage = make_stage(eucentric_error_m=2e-4, repeatability=3e-3)
    simulate(tmp_path / "grid", magnifications=g, views=4, seed=1, stage=stage)
    result = calibrate(tmp_path / "grid", config="virtual_sem")
    # Seven magnifications were visited twice, and the stage said its tilts: nothing is left to presume.
    assert not [w for w in result.statistics["warnings"] if w.startswith("scale:")]
    for at in (*g, 220.0, 3400.0):
        camera, true = result.at(at), scope.camera_at(at)
        off = np.array(camera.pixel_size_m) / np.array(true.pixel_size_m) - 1.0
        sigma = np.array(camera.pixel_size_sigma_m) / np.array(camera.pixel_size_m)
        assert np.all(np.abs(off) < 3.0 * sigma)
        # The next visit is off by the repeatability itself; the rest is no more than that.
        assert np.all(sigma < 2.0 * stage.scale_sigma)
    # What the grid and the stage were given comes out.
    found = result.statistics["fit"]["grid_and_stage"]
    for name, true_value in (("grid_stretch", 2e-4), ("grid_shear", 1e-4)):
        assert abs(found[name] - true_value) < 4.0 * found[f"{name}_sigma"] + 1e-5
    assert abs(found["axis_y_m"] - 2e-4) < 3.0 * found["axis_y_m_sigma"]
    assert abs(found["stage_tilt"] + stage.tilt_error_rad) < 3.0 * found["stage_tilt_sigma"]
