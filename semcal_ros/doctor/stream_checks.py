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

"""Checks of what arrives: images, magnification, stamps, clocks, and the nodes' own diagnostics."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from semcal_ros.bridge.images import image_from_message
from semcal_ros.bridge.stage import missing_joints
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.conditions import describe_condition
from semcal_ros.core.errors import SemcalError
from semcal_ros.core.wording import counted
from semcal_ros.doctor.findings import CheckResult, note, ok, problem
from semcal_ros.doctor.graph_checks import Topic
from semcal_ros.doctor.observations import Arrival, ImageSeen, Session
from semcal_ros.files.images.databar import DatabarCutter
from semcal_ros.middleware import transport_advice

# A stamp that differs by more is from another clock, such as a recording's.
_OTHER_CLOCK_S = 3600.0
# Clocks that NTP synchronises on one network agree much better.
_SKEW_S = 0.05
# From publishing to arrival. 4096 x 4096 pixels of 16 bits take 0.27 s at 1 Gbit/s.
_SLOW_S = 1.0
# From the stamp to arrival. It includes the scan, which may take longer than this: hence a note.
_OLD_S = 5.0
_SYNCHRONISE = "synchronise the clocks of the hosts (chrony or NTP)"


def describe_image(messages: Sequence[Any], config: MicroscopeConfig) -> ImageSeen | None:
    """Describe the last of some images, which tell a data bar together; None for compressed ones.

    Only uncompressed images show their size without being decoded.
    """
    if not messages or not hasattr(messages[-1], "encoding"):
        return None
    trouble, databar = "", DatabarCutter(config.image.databar_rows)
    try:
        for message in messages:
            databar.cut(image_from_message(message))
    except SemcalError as error:
        trouble = str(error)
    last = messages[-1]
    return ImageSeen(
        int(last.width),
        int(last.height),
        str(last.encoding),
        len(last.data),
        trouble,
        databar.rows,
    )


def rate_hz(arrivals: tuple[Arrival, ...]) -> float | None:
    """Return the messages per second, or None for fewer than two messages."""
    if len(arrivals) < 2:
        return None
    span_ns = arrivals[-1].received_ns - arrivals[0].received_ns
    return (len(arrivals) - 1) * 1e9 / span_ns if span_ns > 0 else None


def _format_rate(arrivals: tuple[Arrival, ...]) -> str:
    rate = rate_hz(arrivals)
    return "one" if rate is None else f"{rate:.3g} Hz"


def check_images(topic: Topic, session: Session) -> list[CheckResult]:
    """Check whether usable images arrive; empty without a publisher, which another check reports."""
    if not session.graph.publishers.get(topic.name):
        return []
    arrivals = session.arrivals.get(topic.name, ())
    if not arrivals:
        return [
            problem(
                "images",
                f"{topic.name} has a publisher, but nothing arrived within {session.seconds:g} s",
                do="a slow scan: give more --seconds; else see the lines above, and check a firewall (UDP from 7400"
                " on), or users and containers that do not share /dev/shm",
            )
        ]
    image = session.image
    if image is None:
        return [ok("images", f"{_format_rate(arrivals)} of {topic.type}")]
    seen = f"{_format_rate(arrivals)}, {image.width} x {image.height} {image.encoding}, {image.bytes} bytes"
    if image.trouble:
        return [problem("images", f"{seen}: {image.trouble}")]
    return [ok("images", seen)]


def check_large_images(
    session: Session, environment: Mapping[str, str], rmw: str
) -> list[CheckResult]:
    """Check whether this shell's environment suits the images; the nodes report theirs in their diagnostics."""
    if session.image is None:
        return []
    advice = transport_advice(session.image.bytes, environment, rmw)
    return [
        note("large images", f"in this shell, {advice}")
        if advice
        else ok("large images", "none too large for this shell's environment")
    ]


@dataclass(frozen=True)
class MagnificationSeen:
    """The last magnification as the nodes read it, or None and the reason."""

    value: float | None
    trouble: str = ""


def describe_magnifications(session: Session, config: MicroscopeConfig) -> MagnificationSeen | None:
    """The magnification by the display width of ``config``; None where no message came."""
    if session.reading is None:
        return MagnificationSeen(None, session.reading_trouble) if session.reading_trouble else None
    width = None if session.image is None else session.image.width
    try:
        return MagnificationSeen(replace(session.reading, config=config).magnification(width))
    except SemcalError as error:
        return MagnificationSeen(None, str(error))


def check_magnification(
    topic: Topic, seen: MagnificationSeen | None, session: Session
) -> list[CheckResult]:
    """Check whether a magnification is known."""
    if not session.graph.publishers.get(topic.name):
        return []
    if seen is None:
        return [
            problem(
                "magnification",
                f"{topic.name} has a publisher, but nothing arrived within {session.seconds:g} s; frames"
                " are not used before it is known",
                do="change the magnification once, or make the publisher transient local",
            )
        ]
    if seen.value is None:
        return [problem("magnification", seen.trouble)]
    return [ok("magnification", f"{seen.value:g}")]


def check_stage(topic: Topic, session: Session, config: MicroscopeConfig) -> list[CheckResult]:
    """Check whether the stage says its angles; empty without a publisher of the right type."""
    senders = session.graph.publishers.get(topic.name, ())
    if config.stage is None or not any(sender.type == topic.type for sender in senders):
        return []
    if session.stage_trouble:
        return [problem("stage", session.stage_trouble)]
    if session.stage is None:
        return [
            note(
                "stage",
                f"{topic.name} has a publisher, but nothing arrived within {session.seconds:g} s; views have no tilt"
                " before it is known",
                do="move the stage once, or make the publisher transient local",
            )
        ]
    missing = missing_joints([session.stage], config.stage)
    if missing:
        return [
            note(
                "stage",
                f"no joint {', '.join(missing)} on {topic.name}",
                expected="the joints that the configuration names",
                do="correct the names in the configuration (stage.tilt and the like), or the node",
            )
        ]
    return [ok("stage", _format_angles(session.stage))]


def check_conditions(topic: Topic, session: Session) -> list[CheckResult]:
    """Check whether the microscope says its conditions; empty without a publisher of the right type."""
    senders = session.graph.publishers.get(topic.name, ())
    if not any(sender.type == topic.type for sender in senders):
        return []
    if session.conditions is None:
        return [
            note(
                topic.what,
                f"{topic.name} has a publisher, but nothing arrived within {session.seconds:g} s; nodes cannot tell"
                " whether the calibration was made under the same conditions",
                do="change one of the conditions once, or make the publisher transient local",
            )
        ]
    if not session.conditions:
        return [
            note(
                topic.what,
                f"{topic.name} says nothing that is known",
                expected="key-value pairs such as accelerating_voltage_v and working_distance_m, in SI units",
                do="correct the keys (doc/nodes.md, Conditions), or the node",
            )
        ]
    parts = (describe_condition(name, (value,)) for name, value in session.conditions.items())
    return [ok(topic.what, ", ".join(f"{label} {text}" for label, text in parts))]


def _format_angles(stage: StageReading) -> str:
    angles = (
        ("tilt", stage.tilt_rad),
        ("rotation", stage.rotation_rad),
        ("scan rotation", stage.scan_rotation_rad),
    )
    return ", ".join(f"{name} {math.degrees(a):.1f} degrees" for name, a in angles if a is not None)


def check_stamps(topic: Topic, session: Session) -> list[CheckResult]:
    """Check whether stamps are set, advance, and are of this clock."""
    arrivals = [a for a in session.arrivals.get(topic.name, ()) if a.stamp_ns is not None]
    stamps = [a.stamp_ns for a in arrivals if a.stamp_ns is not None]
    if not stamps:
        return []
    if not any(stamps):
        return [
            problem(
                "stamps",
                "all stamps are zero",
                expected="the time of the acquisition",
                do="make the driver set header.stamp: drift rates and the pairing of topics rest on it",
            )
        ]
    found = []
    back = sum(b <= a for a, b in itertools.pairwise(stamps))
    if back:
        found.append(
            note(
                "stamps",
                f"{back} of {len(stamps) - 1} stamps are not later than the previous one",
                expected="a stamp of its own for each frame",
                do="two publishers, or a recording that loops; otherwise correct the driver",
            )
        )
    age_s = median(
        (a.received_ns - stamp) * 1e-9 for a, stamp in zip(arrivals, stamps, strict=True)
    )
    return [*found, _check_age(age_s, bool(session.graph.publishers.get("/clock")))]


def _check_age(age_s: float, replay: bool) -> CheckResult:
    if abs(age_s) > _OTHER_CLOCK_S:
        seen = f"stamps are {abs(age_s) / 3600:.3g} h {'old' if age_s > 0 else 'in the future'}: from another clock"
        if replay:
            return ok("stamps", f"{seen}, as in a replay with /clock")
        return note(
            "stamps",
            seen,
            expected="the time of this host, unless this is a replay",
            do="a replay: `semcal play` publishes /clock; a driver: make it stamp with the time of the host",
        )
    if age_s < -_SKEW_S:
        return problem(
            "stamps",
            f"stamps are {-age_s:.3g} s in the future",
            expected="the past",
            do=_SYNCHRONISE,
        )
    if age_s > _OLD_S:
        return note(
            "stamps",
            f"frames are {age_s:.3g} s old when they arrive",
            do=f"expected of a slow scan stamped at its start; else a queue is full, or {_SYNCHRONISE}",
        )
    return ok("stamps", f"frames are {1e3 * age_s:.3g} ms old when they arrive")


def check_transport_time(topic: Topic, session: Session) -> list[CheckResult]:
    """Check, by the apparent transport time, whether the clocks of the publisher's host and of this one agree."""
    times = [
        (a.received_ns - a.published_ns) * 1e-9
        for a in session.arrivals.get(topic.name, ())
        if a.published_ns
    ]
    if not times:
        return []
    least = min(times)
    if least < -_SKEW_S:
        return [
            problem(
                "clocks",
                f"images arrive {-least:.3g} s before they were published",
                expected="clocks that agree",
                do=_SYNCHRONISE,
            )
        ]
    if least > _SLOW_S:
        return [
            note(
                "clocks",
                f"images seem to take {least:.3g} s from publisher to here",
                do=f"the transport is too slow for them, or {_SYNCHRONISE}",
            )
        ]
    return [ok("clocks", f"images take {1e3 * median(times):.3g} ms from publisher to here")]


def check_output_rate(source: Topic, output: Topic, session: Session) -> list[CheckResult]:
    """Check whether an output keeps up with the images."""
    taken, made = session.arrivals.get(source.name, ()), session.arrivals.get(output.name, ())
    senders = session.graph.publishers.get(output.name, ())
    if not senders or len(taken) < 2:
        return []
    nodes = ", ".join(dict.fromkeys(e.node for e in senders))
    if not made:
        return [
            problem(
                output.name,
                f"{nodes} published nothing for {counted(len(taken), 'image')}",
                do="see its diagnostics below",
            )
        ]
    seen = f"{_format_rate(made)} for {_format_rate(taken)} of images"
    # Either count may miss one message at each end of the interval.
    if len(made) + 2 < 0.8 * len(taken):
        return [
            note(
                output.name,
                f"{seen}: {nodes} does not keep up",
                do="lower the rate or the size, choose linear interpolation, or see `large images`",
            )
        ]
    return [ok(output.name, seen)]


def check_diagnostics(session: Session, namespace: str) -> list[CheckResult]:
    """Report the diagnostics of the suite's nodes."""
    found = []
    for status in session.statuses:
        if status.level == 0:
            found.append(ok(status.node, status.message))
        elif status.level == 1:
            found.append(
                note(status.node, f"warns: {status.message}", do="see Diagnostics in doc/nodes.md")
            )
        else:
            found.append(problem(status.node, status.message, do="see Diagnostics in doc/nodes.md"))
    heard = {status.node for status in session.statuses}
    silent = [name for name in session.graph.suite(namespace) if name not in heard]
    return found + [
        note(name, "no diagnostics arrived", expected="one a second", do="give more --seconds")
        for name in silent
    ]
