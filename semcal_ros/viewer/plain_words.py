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

from semcal_ros.core.wording import counted
from semcal_ros.viewer.source import Note, Rate

__all__ = ["NodeReport", "describe_rates", "explain"]

_OK, _WARN, _ERROR = "ok", "warn", "error"
# Levels of diagnostic_msgs/DiagnosticStatus.
_LEVELS = {0: _OK, 1: _WARN, 2: _ERROR, 3: _ERROR}
_ORDER = (_ERROR, _WARN, _OK)
# A node reports every second by default, and up to once a minute; this one has ended or hangs.
_SILENT_S = 5.0
# Their diagnostics have a rate, but not of frames.
_WITHOUT_FRAMES = ("calibration_server", "parameter_server")

# What a node says -> level, words (with the groups of the expression), what to do. The first that fits counts.
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
    (r"last rejection: (.*)", _WARN, r"refused a frame: \1", ""),
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
    (r"paused", _WARN, "is paused", "press Start"),
    (r"stopped", _WARN, "is stopped", "press Start"),
    (
        r"source lost, trying again: (.*)",
        _ERROR,
        r"has lost the microscope and tries again: \1",
        "look whether the microscope's computer and program run",
    ),
    (r"connecting for (\d+) s", _WARN, r"has been connecting to the microscope for \1 s", ""),
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
        r"(\S+) without (reliability|durability)",
        _WARN,
        r"gets \1 from a source that does not repeat lost messages",
        "set the source to reliable",
    ),
    (
        r"(\S+) on (\S+)",
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
        Its sentence: states with semicolons between them.
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


def _split(message: str) -> list[str]:
    """Split at the semicolons between states; what is within brackets belongs together."""
    return [part.strip() for part in re.split(r";(?![^()]*\))", message) if part.strip()]


def _explain_part(report: NodeReport, part: str) -> Note:
    name = report.name
    for pattern, level, words, do in _SENTENCES:
        if found := re.fullmatch(pattern, part):
            return Note(level, name, found.expand(words), do)
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
        notes = [_explain_part(report, part) for part in _split(report.message)]
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
