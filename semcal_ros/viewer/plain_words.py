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

"""The diagnostics of the nodes in plain words, each with what to do about it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from semcal_ros.bridge.diagnostics import split_states
from semcal_ros.core.wording import counted
from semcal_ros.viewer.source import Note, Rate

_OK, _WARN, _ERROR = "ok", "warn", "error"
# Levels of diagnostic_msgs/DiagnosticStatus.
_LEVELS = {0: _OK, 1: _WARN, 2: _ERROR, 3: _ERROR}
_ORDER = (_ERROR, _WARN, _OK)
# A node reports every second by default, and up to once a minute; this one has ended or hangs.
_SILENT_S = 5.0
# Their diagnostics have a rate, but not of frames.
_WITHOUT_FRAMES = ("calibration_server", "parameter_server", "suite")

# What a node says -> level, words (with the groups of the expression), what to do. The first that fits counts.
# `tests/viewer/test_words.py` finds all states in the code of the nodes, and wants a sentence for each.
_SENTENCES: tuple[tuple[str, str, str, str], ...] = (
    (r"[\d.]+ Hz", _OK, "works", ""),
    (r"ready", _OK, "is ready", ""),
    (r"no frame received yet", _WARN, "has not seen a frame yet", "start the microscope"),
    (
        r"no frame for ([\d.]+) s",
        _ERROR,
        r"has seen no frame for \1 s",
        "press Start; look whether the microscope still scans",
    ),
    (
        r"(\d+) frames dropped or rejected",
        _WARN,
        r"has lost or refused \1 of the last frames",
        "if it goes on, this computer is too slow for the stream",
    ),
    (
        r"last rejection: (.*)",
        _WARN,
        r"refused a message: \1",
        "correct what sends it, or the configuration",
    ),
    (
        r"uncalibrated",
        _WARN,
        "has no calibration: lengths are nominal, and the distortion stays",
        "calibrate, or load a calibration file",
    ),
    (
        r"scale of the calibration: (.*)",
        _WARN,
        r"doubts the scale of the calibration: \1",
        "see the report of the calibration",
    ),
    (
        r"magnification outside the calibrated range",
        _WARN,
        "has no calibration for this magnification, and guesses on from the nearest",
        "go back into the range, or calibrate here",
    ),
    (
        r"other conditions: (.*)",
        _WARN,
        r"sees other conditions than those of the calibration: \1",
        "check the calibration, or set the conditions back",
    ),
    (
        r"calibration (?:degraded|invalid)(.*)",
        _WARN,
        r"finds in the picture of the grid that the calibration does not hold any more\1",
        "add views and press Check; then update the calibration, or calibrate anew",
    ),
    (
        r"calibration (\S+) not used while (\S+) plays",
        _WARN,
        r"does not use the calibration \1 that comes from the recording that \2 plays",
        "to use it, set replayed_calibration to take and play again, or load its file",
    ),
    (
        r"waiting for magnification",
        _WARN,
        "does not know the magnification",
        "look whether it is published, and under which name",
    ),
    (
        r"drift coasting: (.*)",
        _WARN,
        r"cannot measure the drift and goes on with the last velocity: \1",
        "focus; if the specimen was moved, press Reset drift",
    ),
    (
        r"(\d+) publishers on (\S+): (.*)",
        _ERROR,
        r"hears \1 sources at once on \2: \3",
        "end all but one",
    ),
    (
        r"the image is (dark|even): (.*)",
        _WARN,
        r"sees nothing: the image is \1, \2",
        "check beam blank, shutter and detector",
    ),
    (
        r"odd lines are shifted against even ones by (.*) px, .*",
        _WARN,
        r"gets pictures whose odd lines are shifted against the even ones by \1 px",
        "if the scan is bidirectional, set bidirectional: true under scan in the configuration",
    ),
    (
        r"blank frames",
        _WARN,
        "gets pictures without anything in them",
        "check beam blank, shutter and detector; it goes on by itself",
    ),
    (
        r"magnification turned at the microscope: field width (\S+) m, (\S+) m asked for",
        _WARN,
        r"sees another magnification than was set from here: a field of \1 m, not \2 m",
        "if that was wanted, press Start; else set it again",
    ),
    (
        r"accelerating voltage (\S+) V, (\S+) V at the start",
        _WARN,
        r"sees \1 V of accelerating voltage, \2 V at the start: the scale changes with it",
        "set it back; if it was wanted, press Start and check the calibration",
    ),
    (
        r"not moving any more: (.*)",
        _ERROR,
        r"does not move anything any more: \1",
        "look at the stage; then press Start to allow moves again",
    ),
    (
        r"standing still: (.*)",
        _WARN,
        r"keeps the stage still: \1",
        "it goes on by itself once that is over; a fault needs ~/start",
    ),
    (r"paused", _WARN, "is paused", "press Start"),
    (
        r"consumer (\S+) raised (.*)",
        _WARN,
        r"runs the consumer \1, which raised \2",
        "correct it; the log has the traceback, and the stream goes on",
    ),
    (r"stopped", _WARN, "is stopped", "press Start"),
    (
        r"source lost, trying again: (.*)",
        _ERROR,
        r"has lost the microscope and tries again: \1",
        "look whether the microscope's computer and program run",
    ),
    (
        r"connecting for (\d+) s",
        _WARN,
        r"has been connecting to the microscope for \1 s",
        "if it goes on, look whether the microscope's computer and program run",
    ),
    (
        r"source does not answer for (\d+) s",
        _ERROR,
        r"has had no answer from the microscope for \1 s",
        "look whether the microscope's program hangs",
    ),
    (
        r"files wait for subscribers of (\S+)",
        _WARN,
        r"keeps files until someone listens to \1",
        "start the corrector",
    ),
    (
        r"no joint (\S+) on (\S+)",
        _WARN,
        r"does not find the joint \1 of the stage on \2",
        "correct its name in the configuration, under stage",
    ),
    (
        r"(\S+) (\S+) rad on (\S+): degrees\?",
        _WARN,
        r"does not use the stage: a \1 of \2 on \3 is no angle in rad",
        "let the stage publish rad instead of degrees",
    ),
    (
        r"(images of .*|the Fast DDS profile cannot be used: .*), (set the environment of .*)",
        _WARN,
        r"loses time with each image: \1",
        r"\2",
    ),
    (
        r"(\S+) without (reliability|durability)",
        _WARN,
        r"gets \1 from a source that does not repeat lost messages",
        "set the source to reliable",
    ),
    (
        r"([\w/]+(?:, [\w/]+)*) on (\S+)",
        _ERROR,
        r"hears the wrong kind of message, \1, on \2",
        "correct the configuration",
    ),
)


@dataclass(frozen=True)
class NodeReport:
    """What a node said last about itself.

    Attributes
    ----------
    name
        Of the node, without its namespace.
    level
        0 to 3: OK, WARN, ERROR, STALE.
    message
        Its line: states, as :func:`~semcal_ros.bridge.diagnostics.join_states` joins them.
    values
        Its figures, as texts.
    age_s
        How long ago that was.
    """

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    age_s: float = 0.0


def _explain_part(report: NodeReport, part: str) -> Note:
    name = report.name
    for pattern, level, words, do in _SENTENCES:
        if found := re.fullmatch(pattern, part):
            return Note(level, name, found.expand(words), found.expand(do))
    # What this table does not know is in words already.
    return Note(_LEVELS.get(report.level, _WARN), name, f"says: {part}", "")


def explain(reports: Sequence[NodeReport]) -> tuple[Note, ...]:
    """Say in plain words how all nodes are, the worst first.

    What is fine is said in one line for all, and only of nodes that have nothing else to say.
    """
    found: list[Note] = []
    fine: list[str] = []
    for report in reports:
        if report.age_s > _SILENT_S:
            text = f"has said nothing for {report.age_s:.0f} s"
            found.append(Note(_ERROR, report.name, text, "it has ended or hangs; start it again"))
            continue
        notes = [_explain_part(report, part) for part in split_states(report.message)]
        troubles = [note for note in notes if note.level != _OK]
        found += troubles
        if not troubles:
            fine.append(report.name)
    found.sort(key=lambda note: _ORDER.index(note.level))
    if fine:
        found.append(Note(_OK, ", ".join(fine), f"{counted(len(fine), 'node')} without trouble"))
    elif not found:
        found.append(
            Note(
                _WARN,
                "",
                "no node of the suite has reported yet",
                "start the nodes, or look under which --namespace they are",
            )
        )
    return tuple(found)


def _number(values: Mapping[str, str], key: str) -> float | None:
    try:
        return float(values[key])
    except (KeyError, ValueError):
        return None


def describe_rates(reports: Sequence[NodeReport]) -> tuple[Rate, ...]:
    """Return the frames per second of all nodes that publish some.

    A calibration server has views, which come as they are asked for, and a parameter server has no frames.
    """
    rates = []
    for report in reports:
        rate = _number(report.values, "rate_hz")
        published = _number(report.values, "published")
        gone = report.age_s > _SILENT_S
        if rate is None or not published or gone or report.name in _WITHOUT_FRAMES:
            continue
        latency = _number(report.values, "latency_mean_ms")
        longest = _number(report.values, "latency_max_ms")
        rates.append(Rate(report.name, rate, latency, longest if latency is not None else None))
    return tuple(rates)
