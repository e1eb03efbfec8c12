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

from semcal_ros.bridge.continuous_parameters import continuous_value
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.core.errors import SemcalError
from semcal_ros.doctor.environment_checks import (
    ENVIRONMENT_CHECKS,
    check_domain,
    check_rclpy,
    collect_environment,
)
from semcal_ros.doctor.findings import CheckResult, Severity, note, ok, problem
from semcal_ros.doctor.graph_checks import (
    CONDITIONS,
    Topic,
    check_nodes,
    check_parameters,
    check_simulated_time,
    check_topic,
    suite_topics,
)
from semcal_ros.doctor.observations import CalibrationSeen, Environment, Session
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

# One row in a thousand: the change of shape when a scaled size is rounded.
_ASPECT = 1e-3


def live_size(session: Session) -> tuple[int, int] | None:
    """Return the width and height of the live images without their data bar, px, or None."""
    image = session.image
    if image is None or image.height <= image.databar_rows:
        return None
    return image.width, image.height - image.databar_rows


def describe_calibration(
    source: str,
    calibration: Calibration,
    magnification: float | None,
    size: tuple[int, int] | None,
) -> CalibrationSeen:
    """Describe a calibration for live images of this size (width, height) and magnification."""
    low, high = calibration.magnification_range
    sigma, trouble = None, ""
    if magnification is not None:
        try:
            camera = calibration.at(magnification).resized(*(size or calibration.image_size))
            centre, *corners = continuous_value("sigma", camera)
            sigma = centre, max(corners)
        except SemcalError as error:
            trouble = str(error)
    return CalibrationSeen(
        source=source,
        trouble=trouble,
        width=calibration.image_width,
        height=calibration.image_height,
        display_width_m=calibration.display_width_m,
        low=low,
        high=high,
        sigma_px=sigma,
    )


def check_calibration(
    seen: CalibrationSeen | None,
    size: tuple[int, int] | None,
    magnification: float | None,
    config: MicroscopeConfig,
) -> list[CheckResult]:
    """Check whether the calibration in force is valid for the live images."""
    if seen is None:
        return [
            note(
                "calibration",
                "no calibration on its topic, and none given",
                do="calibrate (`semcal calibrate`), give the file to the nodes, or to this command: --calibration",
            )
        ]
    if seen.trouble:
        return [problem("calibration", f"{seen.source}: {seen.trouble}")]
    found = [*_range(seen, magnification), *_size(seen, size), *_display(seen, config)]
    if found:
        return found
    return [ok("calibration", f"{seen.source}: {_reach(seen)}{_error(seen)}")]


def _reach(seen: CalibrationSeen) -> str:
    return f"{seen.low:g}x to {seen.high:g}x, {seen.width} x {seen.height} px"


def _error(seen: CalibrationSeen) -> str:
    if seen.sigma_px is None:
        return ""
    centre, corner = seen.sigma_px
    return f", predicted 1-sigma error {centre:.2g} px at the centre, {corner:.2g} px in a corner"


def _range(seen: CalibrationSeen, magnification: float | None) -> list[CheckResult]:
    if magnification is None:
        return [
            note("calibration", f"{seen.source}: {_reach(seen)}; the magnification is not known")
        ]
    if not seen.low * (1 - 1e-9) <= magnification <= seen.high * (1 + 1e-9):
        return [
            problem(
                "calibration",
                f"{seen.source} is extrapolated to {magnification:g}x{_error(seen)}",
                expected=f"{seen.low:g}x to {seen.high:g}x, where it was calibrated",
                do="calibrate there too, check the unit and display width in the configuration, or zoom",
            )
        ]
    return []


def _size(seen: CalibrationSeen, size: tuple[int, int] | None) -> list[CheckResult]:
    if size is None or size == (seen.width, seen.height):
        return []
    width, height = size
    live = f"images of {width} x {height} px, {seen.source} is of {seen.width} x {seen.height} px"
    if abs(width * seen.height / (height * seen.width) - 1.0) > _ASPECT:
        return [
            problem(
                "calibration",
                f"{live}, of another shape",
                expected="the same field of view",
                do="a data bar at the bottom: set image.databar_rows in the configuration; a cropped or reduced scan:"
                " calibrate with it",
            )
        ]
    return [note("calibration", f"{live}: scaled, which holds if the field of view is the same")]


def _display(seen: CalibrationSeen, config: MicroscopeConfig) -> list[CheckResult]:
    source = config.magnification
    is_independent = source.quantity != "magnification" or source.display_width_m is not None
    if is_independent or abs(config.display_width_m / seen.display_width_m - 1.0) < 1e-6:
        return []
    return [
        note(
            "calibration",
            f"its display width is {seen.display_width_m:g} m, that of the configuration {config.display_width_m:g} m",
            expected="the same, or magnification.display_width_m in the configuration",
            do="say to which width the published magnification refers: it is read as that of the calibration",
        )
    ]


def diagnose(
    config_name: str, calibration: Path | None, namespace: str, seconds: float
) -> list[CheckResult]:
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


def _is_problem(finding: CheckResult) -> bool:
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
) -> list[CheckResult]:
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
) -> list[CheckResult]:
    """Evaluate the magnification and the calibration, with the arguments of :func:`evaluate`."""
    found: list[CheckResult] = []
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
