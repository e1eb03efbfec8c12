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

"""The bars of the calibration panel."""

from __future__ import annotations

import pytest

from semcal_ros.viewer.state import describe_acquisition, describe_coverage, describe_run


def test_bars_fill_with_the_views() -> None:
    empty = describe_coverage({"views": "0"})
    assert [bar.fraction for bar in empty] == [0.0] * 4
    values = {
        "views": "7",
        "field_share": "0.75",
        "least_tilt_deg": "0.2",
        "largest_tilt_deg": "15.2",
        "views at 100x": "5",
        "views at 1000x": "2",
        "views at 2500x": "5",
    }
    field, tilts, magnifications, each = describe_coverage(values)
    assert (field.fraction, field.text) == (0.75, "75%")
    assert tilts.fraction == pytest.approx(0.5)
    assert tilts.text == "0° to 15°; spread over 30° is good"
    assert magnifications.fraction == pytest.approx(3 / 9)
    assert magnifications.text.startswith("3 from 100× to 2500×")
    # The magnification with the fewest views counts.
    assert each.fraction == pytest.approx(0.4)
    assert each.text == "2 to 5; 5 are good"
    plenty = {f"views at {g}x": "9" for g in range(100, 1100, 100)}
    plenty |= {"field_share": "1", "least_tilt_deg": "-40", "largest_tilt_deg": "40"}
    assert [bar.fraction for bar in describe_coverage(plenty)] == [1.0] * 4


def test_what_is_no_number_counts_as_nothing() -> None:
    odd = {"field_share": "most", "least_tilt_deg": "nan", "views at 5x": "-2", "fraction": "x"}
    assert [bar.fraction for bar in describe_coverage(odd)] == [0.0] * 4
    assert describe_run({**odd, "stage": "joint"}) is None


def test_a_running_calibration_has_a_bar() -> None:
    assert describe_run({"views": "5"}) is None
    assert describe_run({"stage": "done", "fraction": "1.000"}) is None
    bar = describe_run({"stage": "joint", "fraction": "0.400"})
    assert bar is not None
    assert (bar.fraction, bar.text) == (0.4, "joint")


def test_an_acquisition_is_described_before_and_while_it_runs() -> None:
    assert describe_acquisition({"views": "5"}) is None
    goal = {"lowest_magnification": "0", "highest_magnification": "0", "target": "0.001"}
    ready = describe_acquisition({**goal, "microscope": ""})
    assert ready is not None
    assert (ready.state, ready.magnifications, ready.target) == ("ready", None, 1e-3)
    assert ready.who.startswith("you set") and not ready.bars
    goal |= {"lowest_magnification": "500", "highest_magnification": "10000"}
    run = {"acquisition": "waiting", "request": "set 500x anew", "taken": "6", "planned": "24"}
    run |= {"left_out": "2", "largest_sigma": "nan", "microscope": "virtual_sem"}
    panel = describe_acquisition({**goal, **run})
    assert panel is not None
    assert (panel.state, panel.request) == ("waiting", "set 500x anew")
    assert panel.who == "virtual_sem moves by itself" and panel.magnifications == (500.0, 10000.0)
    views, certainty = panel.bars
    assert (views.fraction, views.text) == (0.25, "6 of 24 so far, 2 left out")
    assert (certainty.fraction, certainty.text) == (0.0, "not known yet; 0.1 % wanted")
    later = describe_acquisition({**goal, **run, "largest_sigma": "0.004"})
    assert later is not None
    assert later.bars[1].fraction == pytest.approx(0.25)
    assert later.bars[1].text == "0.4 %; 0.1 % wanted"
