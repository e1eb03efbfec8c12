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

"""All checks in order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.core.errors import SemcalError
from semcal_ros.doctor.calibration_checks import (
    check_calibration,
    describe_calibration,
    live_size,
)
from semcal_ros.doctor.environment_checks import (
    ENVIRONMENT_CHECKS,
    check_domain,
    check_rclpy,
    collect_environment,
)
from semcal_ros.doctor.findings import Finding, Severity, note, problem
from semcal_ros.doctor.graph_checks import (
    CONDITIONS,
    Topic,
    check_nodes,
    check_parameters,
    check_simulated_time,
    check_topic,
    suite_topics,
)
from semcal_ros.doctor.observations import Environment, Session
from semcal_ros.doctor.stream_checks import (
    check_conditions,
    check_diagnostics,
    check_images,
    check_large_images,
    check_magnification,
    check_output_rate,
    check_stage,
    check_stamps,
    check_transport_time,
    describe_magnifications,
)


def diagnose(
    config_name: str, calibration: Path | None, namespace: str, seconds: float
) -> list[Finding]:
    """Run all checks and return their findings.

    Parameters
    ----------
    config_name
        Configuration of the microscope.
    calibration
        A calibration file to be checked, or None.
    namespace
        Namespace of the suite, such as ``/sem``.
    seconds
        How long to listen, s.

    Raises
    ------
    ConfigError, CalibrationFileError
        A given name or file cannot be used.
    """
    config = load_config(config_name)
    given = None if calibration is None else (str(calibration), Calibration.load(calibration))
    around = collect_environment()
    found = [finding for check in ENVIRONMENT_CHECKS for finding in check(around)]
    session = None
    # With an invalid domain id the middleware would end this process.
    needed = [*check_rclpy(around), *check_domain(around)]
    if "rclpy" not in around.import_errors and not any(map(_is_problem, needed)):
        try:
            session = _observe(config, namespace, seconds)
        except (SemcalError, RuntimeError) as error:
            found.append(problem("ROS 2", f"does not start here: {' '.join(str(error).split())}"))
    if session is None:
        do = "first correct the problems above"
        return [*found, note("topics", "not checked, since ROS 2 does not work here", do=do)]
    return found + evaluate(session, around, (config_name, config), given, namespace)


def _is_problem(finding: Finding) -> bool:
    return finding.level is Severity.PROBLEM


def _observe(config: MicroscopeConfig, namespace: str, seconds: float) -> Session:
    # Imports ROS, which need not be installed.
    from semcal_ros.doctor.live import observe

    return observe(config, suite_topics(config, namespace), namespace, seconds)


def evaluate(
    session: Session,
    around: Environment,
    configured: tuple[str, MicroscopeConfig],
    given: tuple[str, Calibration] | None,
    namespace: str,
) -> list[Finding]:
    """Evaluate what was observed.

    Parameters
    ----------
    session, around
        The observations.
    configured
        Name of the configuration, and the configuration.
    given
        Name of a calibration file, and the calibration; None to check only the one on the topic.
    namespace
        Namespace of the suite.
    """
    name, config = configured
    topics = suite_topics(config, namespace)
    images, magnification = topics[:2]
    graph = session.graph
    found = check_nodes(graph, namespace)
    found += [finding for topic in topics for finding in check_topic(topic, graph)]
    found += check_parameters(graph, name) + check_simulated_time(graph)
    found += check_images(images, session) + check_stamps(images, session)
    found += check_transport_time(images, session)
    found += check_large_images(session, around.environment, around.rmw)
    for output in topics[2:]:
        if output.type == "sensor_msgs/msg/Image":
            found += check_output_rate(images, output, session)
    found += judge_calibrations(session, magnification, config, given)
    for topic in topics:
        if topic.keys == "stage":
            found += check_stage(topic, session, config)
        if topic.what == CONDITIONS:
            found += check_conditions(topic, session)
    return found + check_diagnostics(session, namespace)


def judge_calibrations(
    session: Session,
    topic: Topic,
    config: MicroscopeConfig,
    given: tuple[str, Calibration] | None,
) -> list[Finding]:
    """Evaluate the magnification and the calibration, with the arguments of :func:`evaluate`."""
    found: list[Finding] = []
    live = None
    if session.calibration_text is not None:
        try:
            live = "topic calibration", Calibration.loads(session.calibration_text)
        except SemcalError as error:
            found.append(problem("calibration", f"on its topic: {error}"))
    used = given or live
    effective = config
    if used is not None:
        effective = replace(config, display_width_m=used[1].display_width_m)
    magnification = describe_magnifications(session, effective)
    g = None if magnification is None else magnification.value
    found += check_magnification(topic, magnification, session)
    size = live_size(session)
    seen = None if used is None else describe_calibration(*used, g, size)
    found += check_calibration(seen, size, g, config)
    if given and live and given[1].dumps() != live[1].dumps():
        found.append(
            note(
                "calibration",
                f"the nodes have another calibration than {given[0]}",
                do="give it to the nodes, or to parameter_server alone and call its ~/reload",
            )
        )
    return found
