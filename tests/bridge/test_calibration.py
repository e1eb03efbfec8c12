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

"""Warnings about nm per pixel in a calibration's statistics, which may be anything."""

from __future__ import annotations

from semcal_ros.bridge.calibration import ScaleWarnings, pick_scale_warnings


def test_only_the_warnings_about_the_scale_count() -> None:
    found = pick_scale_warnings(["scale: the grid is worn", "few views", "scale: the tilt is off"])
    assert found == ScaleWarnings(2, ("the grid is worn", "the tilt is off"))
    assert found.summary == "scale of the calibration: 2 warnings, the first: the grid is worn"
    assert found.details == "the grid is worn | the tilt is off"
    one = pick_scale_warnings(["scale: the grid is worn"])
    assert one.summary == "scale of the calibration: a warning: the grid is worn"


def test_others_do_not_count() -> None:
    found = pick_scale_warnings(["Scale: another word", " scale: later", "few views"])
    assert (found.count, found.summary, found.details) == (0, "", "")


def test_what_a_terminal_or_a_message_could_stumble_over_is_taken_out() -> None:
    text = "scale: one\x1b[31m\r\ntwo\x00 three\ud800\u202efour\t five"
    found = pick_scale_warnings([text, "scale:", "scale:\n\x07"])
    assert found.texts == ("one [31m two three four five", "without a text", "without a text")
    found.details.encode()


def test_the_length_is_limited() -> None:
    found = pick_scale_warnings(3000 * ["scale: " + 10_000 * "ä"])
    assert found.count == 3000
    assert found.summary.startswith("scale of the calibration: 3000 warnings, the first: ää")
    assert found.summary.endswith("ä...")
    assert len(found.summary) < 250
    assert found.details.endswith("... | and 2990 more")
    assert len(found.details) < 5000
