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

import ast
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

import semcal_ros
from semcal_ros.bridge.diagnostics import join_states
from semcal_ros.core.camera.records import LadderRecord
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.viewer.measure import format_with_sigma
from semcal_ros.viewer.plain_words import NodeReport, describe_rates, explain
from semcal_ros.viewer.state import DriftTrace, describe_magnification, drift_in_pixels
from tests.helpers.node_scenes import make_calibration


def test_nodes_without_trouble_are_one_line() -> None:
    notes = explain([NodeReport("virtual_sem", 0, "9.8 Hz"), NodeReport("rectifier", 0, "ready")])
    assert [(n.level, n.who) for n in notes] == [("ok", "virtual_sem, rectifier")]
    assert notes[0].text == "2 nodes without trouble"


# What nodes can say of themselves: level, what is understood of it, and the beginning of what to do.
STATES = {
    "9.8 Hz": ("ok", "", ""),
    "ready": ("ok", "", ""),
    "no frame received yet": ("warn", "not seen a frame", "start the microscope"),
    "no frame for 7.5 s": ("error", "7.5 s", "press Start"),
    "3 frames dropped or rejected": ("warn", "3 of the last frames", "if it goes on"),
    "last rejection: encoding bgra8, expected mono8": ("warn", "bgra8, expected mono8", "correct"),
    "uncalibrated": ("warn", "nominal", "calibrate"),
    "odd lines are shifted against even ones by 2.00 +- 0.01 px, as in a bidirectional scan or an interlaced video: "
    "declare bidirectional: true under scan in the configuration": (
        "warn",
        "by 2.00 +- 0.01 px",
        "if the scan is",
    ),
    "scale of the calibration: a warning: few tilts": ("warn", "few tilts", "see the report"),
    "magnification outside the calibrated range": ("warn", "magnification", "go back"),
    "other conditions: voltage 10 kV, calibrated at 5 kV": ("warn", "5 kV", "check"),
    "calibration invalid (scale): nm per px off by +0.400 +- 0.050 %, by 1 view": (
        "warn",
        "does not hold any more (scale): nm per px off by +0.400",
        "add views and press Check",
    ),
    "calibration 0123456789ab not used while /sem/bag_player plays": (
        "warn",
        "0123456789ab",
        "to use it, set replayed_calibration",
    ),
    "waiting for magnification": ("warn", "magnification", "look whether"),
    "drift coasting: the overlap is too small": ("warn", "overlap", "focus"),
    "2 publishers on /sem/image_raw: /sem/a, /sem/b": ("error", "2 sources", "end all but one"),
    "the image is dark: no grey level above 1": ("warn", "sees nothing", "check beam blank"),
    "the image is even: all grey levels are 128": ("warn", "sees nothing", "check beam blank"),
    "blank frames": ("warn", "without anything", "check beam blank"),
    "magnification turned at the microscope: field width 2.4e-05 m, 3e-05 m asked for": (
        "warn",
        "another magnification than was set from here: a field of 2.4e-05 m",
        "if that was wanted, press Start",
    ),
    "accelerating voltage 10000 V, 5000 V at the start": ("warn", "5000 V at the", "set it back"),
    "not moving any more: the stage has not arrived, expected tilt 0.1": (
        "error",
        "the stage has not arrived",
        "look at the stage",
    ),
    "standing still: no frames": ("warn", "no frames", "it goes on by itself"),
    "paused": ("warn", "paused", "press Start"),
    "consumer bead raised OSError: no stage": ("warn", "bead, which raised OSError", "correct it"),
    "stopped": ("warn", "stopped", "press Start"),
    "source lost, trying again: no route": ("error", "lost the microscope", "look whether"),
    "connecting for 7 s": ("warn", "7 s", "if it goes on"),
    "source does not answer for 12 s": ("error", "12 s", "look whether"),
    "files wait for subscribers of image_raw": ("warn", "image_raw", "start the corrector"),
    "no joint tilt on stage": ("warn", "joint tilt", "correct its name"),
    "tilt 30 rad on stage: degrees?": ("warn", "a tilt of 30 on stage", "let the stage publish"),
    "images of 4.0 MiB do not fit into the shared memory of Fast DDS, 0.5 MiB (default), set the "
    "environment of `Large images` (doc/nodes.md) for every process with images": (
        "warn",
        "4.0 MiB",
        "set the environment",
    ),
    "/sem/image_raw without reliability": ("warn", "repeat lost messages", "set the source"),
    "std_msgs/msg/Int32 on /sem/magnification": ("error", "wrong kind", "correct the config"),
}


@pytest.mark.parametrize("state", STATES)
def test_every_state_is_told_in_words_with_what_to_do(state: str) -> None:
    level, words, do = STATES[state]
    notes = explain([NodeReport("corrector", 1, f"1.0 Hz; {state}")])
    if level == "ok":
        assert [(n.level, n.who) for n in notes] == [("ok", "corrector")]
        return
    assert [(n.level, n.who) for n in notes] == [(level, "corrector")]
    assert words in notes[0].text and not notes[0].text.startswith("says:")
    assert do and notes[0].do.startswith(do)


N = TypeVar("N", bound=ast.AST)


def _walk(tree: ast.AST, kind: type[N]) -> Iterator[N]:
    return (node for node in ast.walk(tree) if isinstance(node, kind))


def _returns(method: ast.FunctionDef) -> str:
    return "" if method.returns is None else ast.unparse(method.returns)


def _templates(path: Path) -> Iterator[str]:
    """Regular expressions of the texts that the methods ``conditions`` and ``summary`` of a module can say."""
    for defined in _walk(ast.parse(path.read_text()), ast.ClassDef):
        methods = {m.name: m for m in defined.body if isinstance(m, ast.FunctionDef)}
        for name in ("conditions", "summary"):
            method = methods.get(name)
            if method is None or _returns(method) not in ("list[str]", "DiagnosticSummary"):
                continue
            # What stands within a text is a part of it, and what is compared is not said at all.
            within = [*_walk(method, ast.JoinedStr), *_walk(method, ast.Compare)]
            parts = {id(n) for f in within for n in ast.walk(f)}
            used = {n.attr for n in _walk(method, ast.Attribute) if id(n) not in parts}
            looked_at: list[ast.AST] = [method]
            looked_at += [m for u in used if (m := methods.get(u)) and _returns(m) == "str"]
            # What is kept in an attribute until somebody asks.
            looked_at += [
                node.value
                for node in _walk(defined, ast.Assign)
                if any(isinstance(t, ast.Attribute) and t.attr in used for t in node.targets)
            ]
            for tree in looked_at:
                yield from _texts(tree)


def _texts(tree: ast.AST) -> Iterator[str]:
    if isinstance(tree, ast.FunctionDef):
        for part in tree.body[ast.get_docstring(tree) is not None :]:
            yield from _texts(part)
    elif isinstance(tree, ast.JoinedStr):
        parts = [
            re.escape(str(part.value)) if isinstance(part, ast.Constant) else ".+"
            for part in tree.values
        ]
        if any(part.strip(" .+;:") for part in parts):
            yield "".join(parts)
    elif isinstance(tree, ast.Constant):
        # A word alone is the name of a value or of a phase, unless it is a state below.
        if isinstance(tree.value, str) and (" " in tree.value or tree.value in STATES):
            yield re.escape(tree.value)
    elif not isinstance(tree, ast.Compare):
        for part in ast.iter_child_nodes(tree):
            yield from _texts(part)


def test_no_state_of_a_node_is_missing_above() -> None:
    """A condition that is new in the code must be given an example, and with it words."""
    package = Path(semcal_ros.__file__).parent
    files = [package / "bridge/diagnostics.py"]
    files += [path for room in ("nodes", "drivers") for path in (package / room).rglob("*.py")]
    found = {template: path.name for path in files for template in _templates(path)}
    # As many as the nodes have today, so that the search itself cannot stop finding them.
    assert len(found) >= 25
    missing = {
        template: name
        for template, name in found.items()
        if not any(re.fullmatch(template, state) for state in STATES)
    }
    assert not missing


def test_what_no_table_knows_is_told_as_it_is() -> None:
    note = explain([NodeReport("corrector", 1, "1.0 Hz; something new that nobody knows")])[0]
    assert (note.level, note.text) == ("warn", "says: something new that nobody knows")


def test_an_error_text_stays_one_note() -> None:
    """What was seen, expected and to do is one state, though its own line has semicolons."""
    line = join_states(["9.8 Hz", "last rejection: 16UC9; expected mono8; set the encoding"])
    notes = explain([NodeReport("corrector", 1, line)])
    assert [n.text for n in notes] == ["refused a message: 16UC9, expected mono8, set the encoding"]


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
    calibration = make_calibration()
    assert calibration.magnification_range == (500.0, 8000.0)
    assert describe_magnification(None, calibration).state == "unknown"
    assert describe_magnification(5250.0, None).explanation == "not calibrated"
    inside = describe_magnification(5250.0, calibration)
    assert (inside.text, inside.state) == ("5250×", "ok")
    assert inside.explanation == "calibrated, 500× to 8000×"
    assert describe_magnification(8000.0, calibration).state == "ok"
    outside = describe_magnification(20_000.0, calibration)
    assert (outside.text, outside.state) == ("20000×", "outside")
    assert outside.explanation == "outside the calibration, 500× to 8000×"


def test_the_magnification_says_what_calibrated_it() -> None:
    ladder = replace(make_calibration(), ladder=LadderRecord((500.0, 3000.0), 1e-4))
    at = {g: describe_magnification(g, ladder) for g in (2000.0, 3000.0, 5000.0, 9000.0)}
    assert [at[g].state for g in sorted(at)] == ["ok", "ok", "ok", "outside"]
    by_grid = "calibrated by a grid, 500× to 3000×; by a specimen, 500× to 8000×"
    assert at[2000.0].explanation == at[3000.0].explanation == by_grid
    assert at[5000.0].explanation.startswith("calibrated by a specimen")
    assert at[9000.0].explanation == "outside the calibration, 500× to 8000×"
    alone = replace(ladder, method="specimen", ladder=LadderRecord((2000.0, 2000.0), 1e-4))
    assert describe_magnification(2000.0, alone).explanation == (
        "calibrated by a specimen, 500× to 8000×"
    )


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
