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

"""What is wrong with a recording: the checks of a live stream, without those of nodes and transport."""

from __future__ import annotations

import struct
from collections import deque
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from semcal_ros.bridge.conditions import read_conditions
from semcal_ros.bridge.magnification import read_magnification
from semcal_ros.bridge.stage import read_stage, require_radians
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.core.errors import MessageError, SemcalError
from semcal_ros.core.wording import counted
from semcal_ros.doctor.diagnosis import judge_calibrations
from semcal_ros.doctor.findings import CheckResult, note, ok, problem
from semcal_ros.doctor.graph_checks import CONDITIONS, Topic, suite_topics
from semcal_ros.doctor.observations import Arrival, Endpoint, Graph, Session
from semcal_ros.doctor.stream_checks import (
    check_conditions,
    check_images,
    check_stage,
    check_stamps,
    describe_image,
)
from semcal_ros.files.bags.reader import BagReader, RawMessage, open_bag, topic_matches

_RECORDING = "the recording"
_CALIBRATION = "calibration"
# Bytes of the encapsulation; after it comes the stamp of a message that begins with std_msgs/Header.
_ENCAPSULATION = 4
_NS_PER_S = 1_000_000_000  # nanoseconds per second


def diagnose_recording(path: Path, config_name: str, calibration: Path | None) -> list[CheckResult]:
    """Check what a recording holds, and return the findings.

    Parameters
    ----------
    path
        A rosbag2 folder or file.
    config_name
        Configuration of the microscope.
    calibration
        A calibration file to be checked with it, or None for the one that is recorded.

    Raises
    ------
    BagError, ConfigError, CalibrationFileError
        What is given cannot be read.
    """
    config = load_config(config_name)
    given = None if calibration is None else (str(calibration), Calibration.load(calibration))
    with open_bag(path) as bag:
        topics = suite_topics(config, _find_namespace(bag, config))
        images, magnification = topics[:2]
        types = {topic.name: topic.type for topic in bag.topics}
        found = [_check_presence(topic, types) for topic in topics if topic.is_input]
        session, early = _read(bag, topics, config)
    found += check_images(images, session) + check_stamps(images, session)
    if early:
        found.append(
            note(
                "magnification",
                f"{counted(early, 'image comes', 'images come')} before the first one: not used",
                do="publish the magnification before the first image, or make it transient local",
            )
        )
    recorded, used = session.calibration_text, session
    if given is not None:
        used = replace(session, calibration_text=None)
        if recorded is not None and recorded != given[1].dumps():
            found.append(
                note(
                    _CALIBRATION,
                    f"the recording holds another one than {given[0]}",
                    do="give the nodes the file: it stays in force in a replay",
                )
            )
    found += judge_calibrations(used, magnification, config, given)
    for topic in topics:
        if topic.keys == "stage":
            found += check_stage(topic, session, config)
        if topic.what == CONDITIONS:
            found += check_conditions(topic, session)
    return found


def _find_namespace(bag: BagReader, config: MicroscopeConfig) -> str:
    wanted = config.image.topic
    for topic in bag.topics:
        if not wanted.startswith("/") and topic_matches(wanted, topic.name):
            return topic.name.removesuffix(f"/{wanted}")
    return "/sem"


def _check_presence(topic: Topic, types: dict[str, str]) -> CheckResult:
    kind = types.get(topic.name)
    if kind == topic.type:
        return ok(topic.name, f"{kind} in {_RECORDING}")
    seen = "not in the recording" if kind is None else f"{kind} in {_RECORDING}"
    held = ", ".join(f"{name} ({kind})" for name, kind in sorted(types.items())) or "nothing"
    make = note if topic.optional else problem
    return make(
        topic.name,
        f"{seen}, which holds {held}",
        expected=f"{topic.type} ({topic.what})",
        do=f"name the topic and its type in a configuration ({topic.keys}, --config)",
    )


def _read(
    bag: BagReader, topics: tuple[Topic, ...], config: MicroscopeConfig
) -> tuple[Session, int]:
    """Read the recording; also return the number of images before the first magnification."""
    images, magnification = topics[:2]
    namespace = next(t.name for t in topics if t.what == _CALIBRATION)
    wanted = {t.name: t.type for t in topics if t.is_input or t.what in (_CALIBRATION, CONDITIONS)}
    held = {t.name for t in bag.topics if wanted.get(t.name) == t.type}
    arrivals: dict[str, list[Arrival]] = {name: [] for name in held}
    last: dict[str, RawMessage] = {}
    # As many images as tell whether they have a data bar.
    newest: deque[RawMessage] = deque(maxlen=2)
    early = 0
    for raw in bag.raw_messages(held):
        begins_with_stamp = raw.topic != namespace and _has_header(raw.type)
        stamp_ns = _stamp_ns(raw.data) if begins_with_stamp else None
        arrivals[raw.topic].append(Arrival(raw.log_time_ns, None, stamp_ns))
        early += raw.topic == images.name and magnification.name not in last
        last[raw.topic] = raw
        if raw.topic == images.name:
            newest.append(raw)
    session = Session(
        seconds=bag.duration_s,
        graph=Graph(publishers={t.name: (Endpoint(_RECORDING, t.type),) for t in bag.topics}),
        arrivals={name: tuple(heard) for name, heard in arrivals.items()},
        image=describe_image([bag.decode(raw) for raw in newest], config),
    )
    messages = {name: bag.decode(raw) for name, raw in last.items()}
    session = _with_readings(session, messages, topics, config)
    text = getattr(messages.get(namespace), "data", None)
    return replace(session, calibration_text=text), early if magnification.name in last else 0


def _has_header(type_name: str) -> bool:
    return type_name.startswith("sensor_msgs/") or type_name.endswith("Stamped")


def _stamp_ns(data: bytes) -> int:
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, _ENCAPSULATION)
    return int(seconds * _NS_PER_S + nanoseconds)


def _with_readings(
    session: Session,
    messages: dict[str, Any],
    topics: tuple[Topic, ...],
    config: MicroscopeConfig,
) -> Session:
    magnification = topics[1]
    if magnification.name in messages:
        try:
            reading = read_magnification(messages[magnification.name], config)
            session = replace(session, reading=reading)
        except SemcalError as error:
            session = replace(session, reading_trouble=str(error))
    stage = next((messages.get(t.name) for t in topics if t.keys == "stage"), None)
    if stage is not None and config.stage is not None:
        try:
            position = read_stage(stage, config.stage)
            require_radians(position, config.stage)
            session = replace(session, stage=position)
        except SemcalError as error:
            session = replace(session, stage_trouble=str(error))
    message = next((messages.get(t.name) for t in topics if t.what == CONDITIONS), None)
    if message is not None:
        # A recording may redefine the type: then nothing is known.
        with suppress(MessageError):
            session = replace(session, conditions=read_conditions(message))
    return session
