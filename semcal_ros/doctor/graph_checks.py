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

"""Checks of the ROS graph: nodes, topics, types, quality of service, and clocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from semcal_ros.bridge.conditions import CONDITIONS_TYPE
from semcal_ros.config.config import MicroscopeConfig, StageConfig
from semcal_ros.doctor.findings import CheckResult, note, ok, problem
from semcal_ros.doctor.observations import Endpoint, Graph

_IMAGE = "sensor_msgs/msg/Image"
_CLOCK = "/clock"
#: What the topic with the operating conditions carries.
CONDITIONS = "conditions"


@dataclass(frozen=True)
class Topic:
    """A topic that the suite reads or writes.

    Attributes
    ----------
    name, type
        Full name and message type.
    what
        What it carries.
    is_input
        Whether the microscope has to publish it.
    single
        Whether two publishers would contradict each other.
    keys
        Keys of the configuration that name the topic; empty for fixed names.
    optional
        Whether an input may be missing.
    """

    name: str
    type: str
    what: str
    is_input: bool = False
    single: bool = True
    keys: str = ""
    optional: bool = False


def resolve_topic(topic: str, namespace: str) -> str:
    """Full name of a topic."""
    return topic if topic.startswith("/") else f"{namespace}/{topic}"


def suite_topics(config: MicroscopeConfig, namespace: str) -> tuple[Topic, ...]:
    """The topics of the suite for one microscope, the inputs first."""
    images, g, stage = config.image, config.magnification, config.stage
    outputs = (
        ("image_rect", _IMAGE, "rectified images", True),
        ("image_stabilized", _IMAGE, "images without drift", True),
        ("camera_info", "sensor_msgs/msg/CameraInfo", "camera", False),
        ("drift", "geometry_msgs/msg/PoseWithCovarianceStamped", "drift", True),
        ("drift_velocity", "geometry_msgs/msg/TwistWithCovarianceStamped", "drift rate", True),
        ("projection", "std_msgs/msg/Float64MultiArray", "projection", True),
        ("projection_stamped", _IMAGE, "projection of each image", True),
        ("projection_covariance", "std_msgs/msg/Float64MultiArray", "its covariance", True),
        ("projection_covariance_stamped", _IMAGE, "covariance of each projection", True),
        ("calibration", "std_msgs/msg/String", "calibration", False),
    )
    return (
        Topic(resolve_topic(images.topic, namespace), images.type, "images", True, keys="image"),
        Topic(resolve_topic(g.topic, namespace), g.type, g.quantity, True, keys="magnification"),
        *([] if stage is None else [_stage_topic(stage, namespace)]),
        *(
            Topic(resolve_topic(name, namespace), kind, what, single=one)
            for name, kind, what, one in outputs
        ),
        # Published by some microscopes only, and named by no configuration: checked where it is.
        Topic(resolve_topic("conditions", namespace), CONDITIONS_TYPE, CONDITIONS),
    )


def _stage_topic(stage: StageConfig, namespace: str) -> Topic:
    name = resolve_topic(stage.topic, namespace)
    return Topic(name, stage.type, "stage", is_input=True, keys="stage", optional=True)


def check_nodes(graph: Graph, namespace: str) -> list[CheckResult]:
    """Check which nodes of the suite run, and whether two have the same name."""
    found = [
        # Others may not mind.
        (problem if name in graph.suite() else note)(
            "nodes",
            f"{count} nodes have the name {name}",
            expected="one",
            do="stop all but one, or give them other names or namespaces: `--ros-args -r __ns:=/other`",
        )
        for name, count in Counter(graph.nodes).items()
        if count > 1
    ]
    here = graph.suite(namespace)
    elsewhere = [name for name in graph.suite() if name not in here]
    if here:
        found.append(ok("nodes", ", ".join(here)))
    else:
        seen = f"no node of the suite runs in {namespace}"
        seen += f", but {', '.join(elsewhere)}" if elsewhere else ""
        found.append(
            note(
                "nodes",
                seen,
                do="start one (doc/nodes.md), give --namespace, or check that ROS_DOMAIN_ID is the same",
            )
        )
    return found


def check_topic(topic: Topic, graph: Graph) -> list[CheckResult]:
    """Publishers and subscribers of a topic, with type and quality of service; empty for an unused output."""
    publishers = graph.publishers.get(topic.name, ())
    subscriptions = graph.subscriptions.get(topic.name, ())
    if not publishers and not topic.is_input:
        return []
    found = [
        *_check_types(topic, publishers, "published"),
        *_check_types(topic, subscriptions, "expected"),
    ]
    senders = [p for p in publishers if p.type == topic.type]
    listeners = [s for s in subscriptions if s.type == topic.type]
    if not publishers:
        return [*found, _find_unpublished(topic, graph)]
    if topic.single and len(senders) > 1:
        found.append(
            problem(
                topic.name,
                f"{_format_nodes(senders)} publish on it",
                expected="one publisher",
                do="stop all but one, or remap the topic of the others",
            )
        )
    found += _check_qualities(topic, senders, listeners)
    if not found:
        heard = f"heard by {_format_nodes(listeners)}" if listeners else "nobody listens"
        sent = f"{topic.type} by {_format_nodes(senders)} ({senders[0].quality})"
        # Only a calibration needs the stage.
        made = note if topic.is_input and not topic.optional and not listeners else ok
        found.append(made(topic.name, f"{sent}, {heard}"))
    return found


def _format_nodes(endpoints: list[Endpoint]) -> str:
    return ", ".join(dict.fromkeys(e.node for e in endpoints))


def _check_types(topic: Topic, ends: tuple[Endpoint, ...], verb: str) -> Iterator[CheckResult]:
    for end in ends:
        if end.type != topic.type:
            change = "correct the node"
            if topic.keys:
                # No other type can be a stage.
                key = "topic" if topic.keys == "stage" else "type"
                change = f"correct {topic.keys}.{key} in the configuration, or the node"
            yield problem(
                topic.name,
                f"{end.type} is {verb} by {end.node}; types that differ never meet",
                expected=f"{topic.type} ({topic.what})",
                do=change,
            )


def _find_unpublished(topic: Topic, graph: Graph) -> CheckResult:
    last = topic.name.rpartition("/")[2]
    same = [
        name
        for name, ends in graph.publishers.items()
        if any(e.type == topic.type for e in ends) and name.rpartition("/")[2] == last
    ]
    seen = "nobody publishes on it" + (f", but on {', '.join(sorted(same))}" if same else "")
    if topic.optional:
        return note(
            topic.name,
            f"{seen}; calibrations do without the {topic.what}",
            expected=f"{topic.type} ({topic.what})",
            do=f"publish it if there is one, or name its topic in a configuration ({topic.keys}.topic, --config)",
        )
    return problem(
        topic.name,
        seen,
        expected=f"{topic.type} ({topic.what})",
        do="start the microscope's node in this domain; or name its topic in a configuration"
        f" ({topic.keys}.topic, --config), remap it, or give --namespace",
    )


def _check_qualities(
    topic: Topic, senders: list[Endpoint], listeners: list[Endpoint]
) -> Iterator[CheckResult]:
    for sender in senders:
        for listener in listeners:
            refused = [
                kind
                for kind, wanted, offered in (
                    ("reliable", listener.reliable, sender.reliable),
                    ("transient local", listener.transient_local, sender.transient_local),
                )
                if wanted and not offered
            ]
            if refused:
                yield problem(
                    topic.name,
                    f"{listener.node} asks for {' and '.join(refused)}, {sender.node} offers {sender.quality}:"
                    " nothing arrives there",
                    expected="a publisher that offers at least what is asked for",
                    do="change the quality of service of either; nodes of the suite adapt by themselves",
                )
        if not sender.reliable:
            yield note(
                topic.name,
                f"{sender.node} publishes {sender.quality}: what is not delivered at once is lost, most often"
                " images larger than the shared memory",
                expected="reliable",
                do="change the quality of service of the publisher",
            )
        if topic.keys in ("magnification", "stage") and not sender.transient_local:
            yield note(
                topic.name,
                f"{sender.node} publishes {sender.quality}: a node that starts later gets the {topic.what} only with"
                " its next message",
                expected="transient local",
                do="change the durability of the publisher, or publish it repeatedly",
            )


def check_parameters(graph: Graph, config: str) -> list[CheckResult]:
    """Check whether the nodes answer parameter requests, and use the configuration given here."""
    found = []
    for name, values in graph.parameters.items():
        if values is None:
            found.append(
                problem(
                    name,
                    "does not answer when it is asked for its parameters",
                    do="it hangs, or is very busy: see its diagnostics; restart it",
                )
            )
        # The virtual microscope is configured by what it simulates.
        elif values[1] != config and not name.endswith("/virtual_sem"):
            found.append(
                note(
                    name,
                    f"uses the configuration {values[1]}, this command {config}",
                    do=f"give --config {values[1]}",
                )
            )
    if graph.parameters and not found:
        found.append(ok("parameters", "all nodes answer"))
    return found


def check_simulated_time(graph: Graph) -> list[CheckResult]:
    """Check whether /clock and the parameters `use_sim_time` are consistent."""
    clocks = [e.node for e in graph.publishers.get(_CLOCK, ())]
    known = {name: values[0] for name, values in graph.parameters.items() if values is not None}
    simulated = [name for name, value in known.items() if value]
    # A replaying node is the source of simulated time and itself uses real time.
    real = [name for name, value in known.items() if not value and name not in clocks]
    if simulated and not clocks:
        return [
            problem(
                "time",
                f"{', '.join(simulated)}: simulated time, but nobody publishes /clock; it stands still",
                do="set use_sim_time to false, or play with /clock: `semcal play`",
            )
        ]
    if clocks and real:
        return [
            note(
                "time",
                f"{', '.join(clocks)} publishes /clock, but {', '.join(real)} use the real time",
                expected="use_sim_time:=true for all nodes of a replay",
                do="otherwise frames are still corrected, but no latency is reported",
            )
        ]
    return [ok("time", "simulated, by /clock" if clocks else "real, no /clock")] if known else []
