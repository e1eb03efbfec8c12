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

"""What the page says: diagnostics, magnification, drift and lengths in words."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.viewer.lengths import format_with_sigma
from semcal_ros.viewer.plain_words import NodeReport, describe_rates, explain
from semcal_ros.viewer.state import DriftTrace, describe_magnification, drift_in_pixels


def test_nodes_without_trouble_are_one_line() -> None:
    notes = explain([NodeReport("virtual_sem", 0, "9.8 Hz"), NodeReport("rectifier", 0, "ready")])
    assert [(n.level, n.who) for n in notes] == [("ok", "virtual_sem, rectifier")]
    assert notes[0].text == "2 nodes without trouble"


@pytest.mark.parametrize(
    ("message", "level", "words", "do"),
    [
        ("9.8 Hz; uncalibrated", "warn", "nominal", "calibrat"),
        ("9.8 Hz; magnification outside the calibrated range", "warn", "magnification", "range"),
        ("no frame for 7.5 s", "error", "7.5 s", "Start"),
        ("9.8 Hz; drift coasting: the overlap is too small", "warn", "overlap", "Reset drift"),
        (
            "3 frames dropped or rejected; last rejection: encoding bgra8; expected mono8",
            "warn",
            "3 of the last frames",
            "slow",
        ),
        ("1 Hz; 2 publishers on /sem/image_raw: /sem/a, /sem/b", "error", "2 sources", "end"),
        ("1 Hz; other conditions: voltage 10 kV, calibrated at 5 kV", "warn", "5 kV", "check"),
        ("1 Hz; source lost, trying again: no route", "error", "lost the microscope", "computer"),
        ("1 Hz; the image is dark: no grey level above 1", "warn", "sees nothing", "beam blank"),
        ("1 Hz; stopped", "warn", "stopped", "Start"),
        ("1 Hz; std_msgs/msg/Int32 on /sem/magnification", "error", "wrong kind", "configuration"),
        ("1 Hz; something new that nobody knows", "warn", "something new", ""),
    ],
)
def test_troubles_are_told_in_words_with_what_to_do(
    message: str, level: str, words: str, do: str
) -> None:
    note = explain([NodeReport("corrector", 1, message)])[0]
    assert (note.level, note.who) == (level, "corrector")
    assert words in note.text
    assert do in note.do


def test_the_worst_comes_first_and_silence_is_bad() -> None:
    notes = explain(
        [
            NodeReport("fine", 0, "10.0 Hz"),
            NodeReport("a", 1, "10.0 Hz; uncalibrated"),
            NodeReport("gone", 0, "10.0 Hz", age_s=9.0),
        ]
    )
    assert [n.level for n in notes] == ["error", "warn", "ok"]
    assert "9 s" in notes[0].text
    assert notes[2].who == "fine"
    assert explain([])[0].level == "warn"


def test_rates_are_of_nodes_that_publish() -> None:
    values = {"rate_hz": "9.8", "published": "12", "latency_mean_ms": "31", "latency_max_ms": "44"}
    reports = [
        NodeReport("corrector", 0, "", values),
        NodeReport("idle", 0, "", {"rate_hz": "0.0", "published": "0"}),
        NodeReport("odd", 0, "", {"rate_hz": "many", "published": "3"}),
        NodeReport("old", 0, "", {"rate_hz": "3", "published": "3"}),
        NodeReport("gone", 0, "", values, age_s=60.0),
        NodeReport("parameter_server", 0, "", {"rate_hz": "0.0", "published": "3"}),
    ]
    corrector, old = describe_rates(reports)
    assert (corrector.rate_hz, corrector.latency_ms, corrector.longest_ms) == (9.8, 31.0, 44.0)
    assert (old.name, old.latency_ms, old.longest_ms) == ("old", None, None)


def test_the_magnification_says_whether_it_is_covered() -> None:
    assert describe_magnification(None, (100.0, 1e4)).state == "unknown"
    assert describe_magnification(5250.0, None).explanation == "not calibrated"
    inside = describe_magnification(5250.0, (100.0, 1e4))
    assert (inside.text, inside.state) == ("5250×", "ok")
    assert inside.explanation == "calibrated, 100× to 10000×"
    assert describe_magnification(10_000.0, (100.0, 1e4)).state == "ok"
    outside = describe_magnification(20_000.0, (100.0, 1e4))
    assert (outside.text, outside.state) == ("20000×", "outside")


def test_the_drift_is_told_with_its_sigma_and_drawn_with_few_points() -> None:
    trace = DriftTrace()
    assert trace.panel("none").text == "none"
    for k in range(5000):
        trace.add(1000 * k, 1e-12 * k, -2e-12 * k, 0.4e-9, (2e-9, 0.1e-9))
    panel = trace.panel()
    assert panel.text == "11.18 ± 0.40 nm since the start, 120.0 ± 6.0 nm per minute"
    assert panel.sigma_nm == pytest.approx(0.4)
    assert len(panel.trace_nm) <= 302
    assert panel.trace_nm[-1] == panel.at_nm == pytest.approx((4.999, -9.998))
    # A reset sets the drift to zero, a replay that begins again goes back in time.
    trace.add(5_000_001, 0.0, 0.0, 1e-9)
    assert trace.panel().trace_nm == ((0.0, 0.0),)
    trace.add(10, 1e-9, 0.0, 1e-9)
    assert len(trace.panel().trace_nm) == 1


def test_the_arrow_is_the_drift_on_the_scale_of_the_picture() -> None:
    camera = ScanCamera.nominal(1000.0, 200, 100, 0.1)  # 500 nm per px
    assert drift_in_pixels(camera, (1e-6, -5e-7)) == pytest.approx((2.0, -1.0))
    moved = camera.project_ideal([[0, 0, 0], [1e-6, -5e-7, 0]])
    np.testing.assert_allclose(drift_in_pixels(camera, (1e-6, -5e-7)), moved[1] - moved[0])


@pytest.mark.parametrize(
    ("length_m", "sigma_m", "text"),
    [
        (10.538e-6, 26e-9, "10.538 ± 0.026 µm"),
        (14.7e-9, 0.69e-9, "14.70 ± 0.69 nm"),
        (310e-6, 4e-6, "310.0 ± 4.0 µm"),
        (5e-6, 30e-6, "5 ± 30 µm"),
        (5e-6, None, "5 µm (nominal)"),
        (5e-6, 0.0, "5.000 ± 0.000 µm"),
    ],
)
def test_lengths_have_two_digits_of_their_sigma(
    length_m: float, sigma_m: float | None, text: str
) -> None:
    assert format_with_sigma(length_m, sigma_m) == text
