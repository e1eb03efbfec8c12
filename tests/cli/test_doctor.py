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

"""`semcal doctor` without ROS at work: each check on what was seen, and the command on a machine without rclpy."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from semcal_ros.bridge.magnification import MagnificationReading
from semcal_ros.cli import main
from semcal_ros.config.config import MagnificationConfig, MicroscopeConfig, StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.doctor import environment_checks as checks
from semcal_ros.doctor.diagnosis import check_calibration, describe_calibration, evaluate
from semcal_ros.doctor.findings import CheckResult, Severity
from semcal_ros.doctor.graph_checks import (
    check_nodes,
    check_parameters,
    check_simulated_time,
    check_topic,
    suite_topics,
)
from semcal_ros.doctor.observations import (
    SUITE,
    Arrival,
    Endpoint,
    Environment,
    Graph,
    ImageSeen,
    NodeStatus,
    Session,
)
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
from semcal_ros.middleware import PROFILE_VARIABLES
from semcal_ros.workflows.simulate import simulate
from tests.helpers.node_scenes import make_calibration, write_recording
from tests.helpers.project import NODES, ROOT

OK, NOTE, PROBLEM = Severity.OK, Severity.NOTE, Severity.PROBLEM
MIB = 1024**2
CONFIG = MicroscopeConfig("test", 0.12)
CALIBRATION = make_calibration()
IMAGES, MAGNIFICATION, STAGE, RECT, *_, CONDITIONS = suite_topics(CONFIG, "/sem")
NOW_NS = 1_800_000_000_000_000_000
AROUND = Environment(
    python=(3, 12),
    packages={"numpy": "2.1.0", "ros-rclpy": "7.1.6", "ros-sensor-msgs": "5.3.6"},
    requirements={
        "semcal-ros": ("numpy>=1.26",),
        "ros-rclpy": ("ros-sensor-msgs~=5.3.6", 'ros-rmw-fastrtps-cpp~=8.4; extra == "fastrtps"'),
    },
    import_errors={},
    rclpy_file="/venv/lib/rclpy/__init__.py",
    prefix="/venv",
    installations=(),
    environment={"AMENT_PREFIX_PATH": "/venv"},
    script_prefixes=("/venv",),
    rmw="rmw_fastrtps_cpp",
    shm_free_bytes=64 * MIB,
    receive_buffer_bytes=64 * MIB,
)


def only(found: list[CheckResult], level: Severity, *words: str) -> None:
    """There is one finding, of this level and with these words."""
    assert [finding.level for finding in found] == [level], found
    for word in words:
        assert word in str(found[0])
    if level is PROBLEM:
        assert "; " in str(found[0]), "a problem without advice"


def worst(found: list[CheckResult]) -> set[Severity]:
    return {finding.level for finding in found}


def around(**changes: Any) -> Environment:
    return replace(AROUND, **changes)


def with_environment(**values: str) -> Environment:
    return around(environment={**AROUND.environment, **values})


# -- surroundings ----------------------------------------------------------------------------------


def test_sound_surroundings_are_all_ok() -> None:
    found = [finding for check in checks.ENVIRONMENT_CHECKS for finding in check(AROUND)]
    assert worst(found) == {OK}


@pytest.mark.parametrize(
    ("version", "level"), [((3, 9), PROBLEM), ((3, 10), OK), ((3, 15), PROBLEM)]
)
def test_python(version: tuple[int, int], level: Severity) -> None:
    only(checks.check_python(around(python=version)), level, ".".join(map(str, version)))


def test_packages_are_new_enough() -> None:
    old = around(packages={"numpy": "1.25.2"})
    only(checks.check_packages(old), PROBLEM, "numpy 1.25.2", "1.26", "pip install")
    only(checks.check_packages(around(packages={})), PROBLEM, "not installed")
    only(checks.check_packages(around(packages={"numpy": "1.26"})), OK)
    opencv = around(
        requirements={"semcal-ros": ("opencv-python-headless>=4.8", "not a requirement")},
        packages={"opencv-python": "4.9"},
    )
    only(checks.check_packages(opencv), OK, "opencv-python 4.9")


def test_a_package_that_cannot_be_imported_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(name: str) -> Any:
        raise ImportError(f"libGL.so.1, for {name}")

    monkeypatch.setattr(sys.modules["semcal_ros.cli.main"], "import_module", broken)
    assert main(["doctor"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "semcal doctor cannot be loaded (libGL.so.1" in line
    assert "make setup" in line


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"import_errors": {"rclpy": "No module named 'rclpy'"}}, ("make setup",)),
        (
            {
                "import_errors": {"rclpy": "No module named 'rclpy'"},
                "installations": ("/opt/ros/jazzy",),
            },
            ("/opt/ros/jazzy", "not sourced"),
        ),
        (
            {"import_errors": {"rclpy": "undefined symbol: x"}},
            ("undefined symbol", "made for this Python"),
        ),
        ({"import_errors": {"std_srvs.srv": "No module named 'std_srvs'"}}, ("std_srvs",)),
    ],
)
def test_rclpy_is_missing(changes: dict[str, Any], words: tuple[str, ...]) -> None:
    only(checks.check_rclpy(around(**changes)), PROBLEM, *words)


def test_wheels_are_of_one_distribution_and_alone() -> None:
    mixed = around(packages={"ros-rclpy": "7.1.6", "ros-sensor-msgs": "5.5.1"})
    only(checks.check_one_ros(mixed), PROBLEM, "ros-rclpy 7.1.6", "5.5.1", "5.3.6")
    later = around(packages={"ros-rclpy": "7.1.6", "ros-sensor-msgs": "5.3.9"})
    only(checks.check_one_ros(later), OK)
    foreign = around(rclpy_file="/opt/ros/jazzy/lib/rclpy/__init__.py")
    only(checks.check_one_ros(foreign), PROBLEM, "/opt/ros/jazzy", "one of the two")
    sourced = with_environment(AMENT_PREFIX_PATH="/venv:/opt/ros/jazzy")
    only(checks.check_one_ros(sourced), NOTE, "/opt/ros/jazzy")
    assert checks.check_one_ros(around(packages={})) == []


def test_scripts_find_the_packages_of_the_environment() -> None:
    only(checks.check_package_index(around()), OK, "/venv")
    for prefixes in ((), ("/opt/ros/jazzy",)):
        found = checks.check_package_index(around(script_prefixes=prefixes))
        only(
            found, PROBLEM, "get_package_share_directory", "/venv in it", "export AMENT_PREFIX_PATH"
        )
    # A workspace that was sourced has its own.
    assert checks.check_package_index(around(packages={})) == []


def test_middleware() -> None:
    broken = replace(
        with_environment(RMW_IMPLEMENTATION="rmw_other"),
        import_errors={"rclpy": "Expected identifier of 'rmw_other'"},
        rmw="",
    )
    only(checks.check_rmw(broken), PROBLEM, "rmw_other", "unset")
    assert checks.check_rclpy(broken) == []
    only(checks.check_rmw(around(rmw="rmw_cyclonedds_cpp")), NOTE, "profile")
    assert checks.check_rmw(around(rmw="")) == []


@pytest.mark.parametrize(
    ("given", "level"),
    [
        ("", OK),
        ("0", OK),
        ("101", OK),
        ("102", NOTE),
        ("232", NOTE),
        ("233", PROBLEM),
        ("-1", PROBLEM),
        ("a", PROBLEM),
    ],
)
def test_domain(given: str, level: Severity) -> None:
    only(checks.check_domain(with_environment(ROS_DOMAIN_ID=given)), level, given)


@pytest.mark.parametrize(
    ("environment", "level"),
    [
        ({}, OK),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, OK),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"}, PROBLEM),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, PROBLEM),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.1"}, OK),
        ({"ROS_LOCALHOST_ONLY": "1"}, NOTE),
        ({"ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}, NOTE),
    ],
)
def test_discovery(environment: Mapping[str, str], level: Severity) -> None:
    only(checks.check_discovery(with_environment(**environment)), level)


def test_profile_and_the_room_for_its_shared_memory() -> None:
    shipped = str(ROOT / "dds" / "fastdds_large_images.xml")
    good = with_environment(**dict.fromkeys(PROFILE_VARIABLES, shipped))
    only(checks.check_profile(good), OK, "128.0 MiB")
    only(checks.check_shared_memory(good), PROBLEM, "64 MiB are free", "128.0 MiB", "--shm-size")
    only(checks.check_shared_memory(replace(good, shm_free_bytes=128 * MIB)), OK)
    only(checks.check_shared_memory(around(shm_free_bytes=None)), NOTE)
    only(
        checks.check_profile(with_environment(FASTRTPS_DEFAULT_PROFILES_FILE="/no.xml")),
        PROBLEM,
        "/no.xml",
    )
    only(checks.check_profile(with_environment(FASTDDS_BUILTIN_TRANSPORTS="UDPv4")), NOTE, "UDPv4")
    assert checks.check_profile(around(rmw="rmw_cyclonedds_cpp")) == []


def test_a_variable_that_this_fast_dds_does_not_read(tmp_path: Path) -> None:
    (tmp_path / "share" / "fastrtps").mkdir(parents=True)
    environment = {"AMENT_PREFIX_PATH": str(tmp_path), "FASTDDS_DEFAULT_PROFILES_FILE": "/p.xml"}
    found = checks.check_profile(around(environment=environment))
    only(
        found,
        PROBLEM,
        "FASTDDS_DEFAULT_PROFILES_FILE is not read",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
    )


def test_socket_buffers_matter_for_other_hosts() -> None:
    small = around(receive_buffer_bytes=4 * MIB)
    only(checks.check_socket_buffers(small), NOTE, "net.core.rmem_max", "sysctl")
    local = replace(small, environment={"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    assert checks.check_socket_buffers(local) == []


# -- graph -----------------------------------------------------------------------------------------

SEM = Endpoint("/driver", IMAGES.type)
HEAR = Endpoint("/sem/rectifier", IMAGES.type)


def images(
    publishers: tuple[Endpoint, ...], subscriptions: tuple[Endpoint, ...] = (HEAR,)
) -> Graph:
    return Graph(publishers={IMAGES.name: publishers}, subscriptions={IMAGES.name: subscriptions})


def test_the_names_are_those_of_the_executables() -> None:
    assert sorted(SUITE) == sorted(NODES)


def test_nodes() -> None:
    only(check_nodes(Graph(("/sem/rectifier", "/other")), "/sem"), OK, "/sem/rectifier")
    only(check_nodes(Graph(("/lab/rectifier",)), "/sem"), NOTE, "/lab/rectifier", "--namespace")
    twice = check_nodes(Graph(("/sem/rectifier", "/sem/rectifier")), "/sem")
    only(twice[:1], PROBLEM, "2 nodes", "/sem/rectifier")
    only(check_nodes(Graph(("/a", "/a")), "/sem")[:1], NOTE, "2 nodes", "/a")


def test_a_topic_as_it_should_be() -> None:
    only(check_topic(IMAGES, images((SEM,))), OK, "/driver", "/sem/rectifier", "reliable")
    only(check_topic(IMAGES, images((SEM,), ())), NOTE, "nobody listens")
    assert check_topic(RECT, Graph(subscriptions={RECT.name: (HEAR,)})) == []


def test_a_missing_input_and_where_it_may_be() -> None:
    only(check_topic(IMAGES, Graph()), PROBLEM, "nobody publishes", IMAGES.type)
    elsewhere = Graph(publishers={"/camera/image_raw": (SEM,), "/camera/other": (SEM,)})
    only(check_topic(IMAGES, elsewhere), PROBLEM, "/camera/image_raw", "image.topic")
    assert "/camera/other" not in str(check_topic(IMAGES, elsewhere)[0])


def test_types_that_differ() -> None:
    wrong = replace(SEM, type="sensor_msgs/msg/CompressedImage")
    found = check_topic(IMAGES, images((SEM, wrong)))
    only(found[:1], PROBLEM, "CompressedImage", "/driver", IMAGES.type, "image.type")
    deaf = replace(HEAR, type="std_msgs/msg/String")
    only(check_topic(IMAGES, images((SEM,), (deaf,))), PROBLEM, "std_msgs/msg/String", deaf.node)


def test_two_publishers_of_one_stream() -> None:
    only(check_topic(IMAGES, images((SEM, replace(SEM, node="/second")))), PROBLEM, "/second")
    info = next(t for t in suite_topics(CONFIG, "/sem") if t.name.endswith("camera_info"))
    ends = (Endpoint("/sem/rectifier", info.type), Endpoint("/sem/parameter_server", info.type))
    only(check_topic(info, Graph(publishers={info.name: ends})), OK)


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("lasting", [True, False])
def test_qualities_that_do_not_meet(reliable: bool, lasting: bool) -> None:
    """A demand for less is met by everything; a demand for more by equals only (DDS, requested and offered)."""
    strict = replace(HEAR, reliable=True, transient_local=True)
    offered = replace(SEM, reliable=reliable, transient_local=lasting)
    found = check_topic(IMAGES, images((offered,), (strict,)))
    assert (PROBLEM in worst(found)) == (not (reliable and lasting))
    assert ("asks for" in " ".join(map(str, found))) == (not (reliable and lasting))
    humble = replace(HEAR, reliable=False)
    assert PROBLEM not in worst(check_topic(IMAGES, images((offered,), (humble,))))


def test_what_follows_from_a_weak_publisher() -> None:
    weak = replace(SEM, reliable=False)
    only(
        check_topic(IMAGES, images((weak,), (replace(HEAR, reliable=False),))),
        NOTE,
        "best effort",
        "lost",
    )
    knob = Endpoint("/driver", MAGNIFICATION.type)
    graph = Graph(publishers={MAGNIFICATION.name: (knob,)})
    only(check_topic(MAGNIFICATION, graph), NOTE, "volatile", "starts later")


def test_parameters_and_configuration() -> None:
    def graph(**values: tuple[bool, str] | None) -> Graph:
        return Graph(parameters={f"/sem/{name}": value for name, value in values.items()})

    only(check_parameters(graph(rectifier=(False, "generic")), "generic"), OK)
    only(check_parameters(graph(rectifier=None), "generic"), PROBLEM, "/sem/rectifier")
    only(check_parameters(graph(rectifier=(False, "lab")), "generic"), NOTE, "--config lab")
    only(check_parameters(graph(virtual_sem=(False, "virtual_sem")), "generic"), OK)
    assert check_parameters(Graph(), "generic") == []


@pytest.mark.parametrize(
    ("clock", "simulated", "level"),
    [(False, False, OK), (True, True, OK), (False, True, PROBLEM), (True, False, NOTE)],
)
def test_clock_and_simulated_time(clock: bool, simulated: bool, level: Severity) -> None:
    player = Endpoint("/sem/bag_player", "rosgraph_msgs/msg/Clock")
    graph = Graph(
        publishers={"/clock": (player,)} if clock else {},
        parameters={"/sem/bag_player": (False, "x"), "/sem/rectifier": (simulated, "x")}
        if clock
        else {"/sem/rectifier": (simulated, "x")},
    )
    only(check_simulated_time(graph), level)


# -- messages --------------------------------------------------------------------------------------


def arrivals(
    count: int = 5, period_s: float = 0.1, age_s: float = 0.02, transport_s: float = 0.001
) -> tuple[Arrival, ...]:
    times = [NOW_NS + round(i * period_s * 1e9) for i in range(count)]
    return tuple(Arrival(t, t - round(transport_s * 1e9), t - round(age_s * 1e9)) for t in times)


def session(**changes: Any) -> Session:
    made = Session(
        seconds=3.0,
        graph=Graph(
            nodes=("/driver", "/sem/rectifier"),
            publishers={
                IMAGES.name: (SEM,),
                MAGNIFICATION.name: (Endpoint("/driver", MAGNIFICATION.type, True, True),),
                STAGE.name: (Endpoint("/driver", STAGE.type, True, True),),
            },
            subscriptions={
                IMAGES.name: (HEAR,),
                MAGNIFICATION.name: (Endpoint("/sem/rectifier", MAGNIFICATION.type, True, True),),
            },
        ),
        arrivals={IMAGES.name: arrivals()},
        image=ImageSeen(96, 96, "mono8", 96 * 96),
        reading=MagnificationReading(1000.0, None, CONFIG),
        stage=StageReading(0.1, 0.2),
        statuses=(NodeStatus("/sem/rectifier", 0, "10 Hz"),),
    )
    return replace(made, **changes)


def test_images() -> None:
    only(check_images(IMAGES, session()), OK, "10 Hz", "96 x 96 mono8")
    only(
        check_images(IMAGES, session(arrivals={})),
        PROBLEM,
        "nothing arrived within 3 s",
        "--seconds",
    )
    bad = ImageSeen(96, 96, "bayer_rggb8", 9216, "bad encoding; expected mono8")
    only(check_images(IMAGES, session(image=bad)), PROBLEM, "bayer_rggb8")
    assert check_images(IMAGES, session(graph=Graph())) == []


def test_large_images_use_the_rule_of_the_nodes() -> None:
    only(check_large_images(session(), {}, "rmw_fastrtps_cpp"), OK)
    large = session(image=ImageSeen(2048, 2048, "mono8", 4 * MIB))
    only(check_large_images(large, {}, "rmw_fastrtps_cpp"), NOTE, "4.0 MiB", "Large images")


@pytest.mark.parametrize(
    ("age_s", "level", "words"),
    [
        (0.02, OK, "20 ms"),
        (-0.5, PROBLEM, "0.5 s in the future"),
        (30.0, NOTE, "30 s old"),
        (1e6, NOTE, "another clock"),
        (-1e6, NOTE, "another clock"),
    ],
)
def test_stamps(age_s: float, level: Severity, words: str) -> None:
    heard = session(arrivals={IMAGES.name: arrivals(age_s=age_s)})
    only(check_stamps(IMAGES, heard), level, words)


def test_stamps_of_a_replay_and_bad_ones() -> None:
    old = session(arrivals={IMAGES.name: arrivals(age_s=1e6)})
    publishers = {**old.graph.publishers, "/clock": (SEM,)}
    only(check_stamps(IMAGES, replace(old, graph=Graph(publishers=publishers))), OK, "replay")
    zero = tuple(replace(a, stamp_ns=0) for a in arrivals())
    only(check_stamps(IMAGES, session(arrivals={IMAGES.name: zero})), PROBLEM, "zero")
    same = tuple(replace(a, stamp_ns=arrivals()[0].stamp_ns) for a in arrivals())
    found = check_stamps(IMAGES, session(arrivals={IMAGES.name: same}))
    only(found[:1], NOTE, "4 of 4 stamps")


@pytest.mark.parametrize(("seconds", "level"), [(0.001, OK), (-0.2, PROBLEM), (2.0, NOTE)])
def test_clocks_of_two_hosts(seconds: float, level: Severity) -> None:
    heard = session(arrivals={IMAGES.name: arrivals(transport_s=seconds)})
    only(check_transport_time(IMAGES, heard), level)


@pytest.mark.parametrize(("made", "level"), [(30, OK), (29, OK), (10, NOTE), (0, PROBLEM)])
def test_the_output_keeps_up(made: int, level: Severity) -> None:
    graph = Graph(publishers={RECT.name: (Endpoint("/sem/rectifier", RECT.type),)})
    heard = session(graph=graph, arrivals={IMAGES.name: arrivals(30), RECT.name: arrivals(made)})
    only(check_output_rate(IMAGES, RECT, heard), level)
    assert check_output_rate(IMAGES, RECT, session()) == []


def test_magnification() -> None:
    def found(heard: Session, config: MicroscopeConfig = CONFIG) -> list[CheckResult]:
        return check_magnification(MAGNIFICATION, describe_magnifications(heard, config), heard)

    only(found(session()), OK, "1000")
    only(found(session(reading=None)), PROBLEM, "nothing arrived", "transient local")
    only(
        found(session(reading=None, reading_trouble="a value of -1; expected more")), PROBLEM, "-1"
    )
    pixel = replace(CONFIG, magnification=MagnificationConfig("pixel_size", unit="nm"))
    reading = MagnificationReading(1e-6, None, pixel)
    # 96 px of 1 um on a display of 0.12 m.
    only(found(session(reading=reading), pixel), OK, "1250")
    only(found(session(reading=reading, image=None), pixel), PROBLEM, "width")


def test_a_stage_is_not_needed_but_must_be_of_its_type() -> None:
    knob = Endpoint("/driver", STAGE.type, True, True)
    # Nobody has to listen before something is calibrated.
    only(check_topic(STAGE, Graph(publishers={STAGE.name: (knob,)})), OK, "/driver")
    only(check_topic(STAGE, Graph()), NOTE, "nobody publishes", "stage.topic", "do without")
    twist = Graph(publishers={STAGE.name: (replace(knob, type="geometry_msgs/msg/Twist"),)})
    only(check_topic(STAGE, twist), PROBLEM, "Twist", STAGE.type, "stage.topic")
    assert check_stage(STAGE, session(graph=twist), CONFIG) == []
    volatile = Graph(publishers={STAGE.name: (replace(knob, transient_local=False),)})
    only(check_topic(STAGE, volatile), NOTE, "starts later gets the stage only")
    without = suite_topics(replace(CONFIG, stage=None), "/sem")
    assert STAGE.name not in [topic.name for topic in without]
    own = replace(CONFIG, stage=StageConfig(topic="/axes"))
    assert "/axes" in [topic.name for topic in suite_topics(own, "/sem")]


def test_what_the_conditions_say() -> None:
    knob = Endpoint("/driver", CONDITIONS.type, True, True)
    graph = Graph(publishers={CONDITIONS.name: (knob,)})
    only(check_topic(CONDITIONS, graph), OK, "/driver")
    # Most microscopes say none, and need not.
    assert check_topic(CONDITIONS, Graph()) == check_conditions(CONDITIONS, session()) == []
    only(check_conditions(CONDITIONS, session(graph=graph)), NOTE, "nothing arrived within 3 s")
    heard = session(graph=graph, conditions={"accelerating_voltage_v": 5e3, "detector": "SE2"})
    only(check_conditions(CONDITIONS, heard), OK, "voltage 5 kV", "detector SE2")
    only(check_conditions(CONDITIONS, session(graph=graph, conditions={})), NOTE, "nothing that is")
    text = Graph(publishers={CONDITIONS.name: (replace(knob, type="std_msgs/msg/String"),)})
    only(check_topic(CONDITIONS, text), PROBLEM, "std_msgs/msg/String", CONDITIONS.type)
    assert check_conditions(CONDITIONS, session(graph=text)) == []


def test_a_recording_says_its_conditions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    simulate(tmp_path / "zoom", "zoom", frames=3, size=64)
    main(["doctor", str(tmp_path / "zoom"), "--config", "virtual_sem"])
    assert "voltage 10 kV" in capsys.readouterr().out


def test_what_the_stage_says() -> None:
    only(check_stage(STAGE, session(), CONFIG), OK, "tilt 5.7 degrees, rotation 11.5 degrees")
    only(check_stage(STAGE, session(stage=None), CONFIG), NOTE, "nothing arrived within 3 s")
    doubted = session(stage=None, stage_trouble="tilt 30 rad; expected radians; publish radians")
    only(check_stage(STAGE, doubted, CONFIG), PROBLEM, "tilt 30 rad")
    named = replace(CONFIG, stage=StageConfig(rotation="R"))
    heard = session(stage=StageReading(None, None, 0.1))
    only(check_stage(STAGE, heard, CONFIG), NOTE, "no joint tilt on /sem/stage", "stage.tilt")
    only(check_stage(STAGE, heard, named), NOTE, "no joint tilt, R")
    assert check_stage(STAGE, session(), replace(CONFIG, stage=None)) == []
    assert check_stage(STAGE, session(graph=Graph()), CONFIG) == []


def test_diagnostics() -> None:
    only(check_diagnostics(session(), "/sem"), OK, "10 Hz")
    for level, expected in ((1, NOTE), (2, PROBLEM), (3, PROBLEM)):
        said = session(statuses=(NodeStatus("/sem/rectifier", level, "uncalibrated"),))
        only(check_diagnostics(said, "/sem"), expected, "/sem/rectifier", "uncalibrated")
    only(check_diagnostics(session(statuses=()), "/sem"), NOTE, "no diagnostics")


# -- calibration -----------------------------------------------------------------------------------


def calibrated(
    g: float | None = 1000.0,
    size: tuple[int, int] | None = (96, 96),
    config: MicroscopeConfig = CONFIG,
) -> list[CheckResult]:
    seen = describe_calibration("cal.yaml", CALIBRATION, g, size)
    return check_calibration(seen, size, g, config)


def test_a_calibration_that_fits() -> None:
    only(calibrated(), OK, "500x to 8000x", "96 x 96", "1-sigma")
    seen = describe_calibration("cal.yaml", CALIBRATION, 1000.0, (96, 96))
    assert seen.sigma_px is not None
    assert 0.0 < seen.sigma_px[0] < seen.sigma_px[1] < 1.0


@pytest.mark.parametrize(
    ("g", "size", "level", "words"),
    [
        (499.0, (96, 96), PROBLEM, "extrapolated to 499x"),
        (8001.0, (96, 96), PROBLEM, "500x to 8000x"),
        (1000.0, (192, 192), NOTE, "192 x 192 px"),
        (1000.0, (96, 80), PROBLEM, "databar_rows"),
        (None, (96, 96), NOTE, "not known"),
    ],
)
def test_a_calibration_that_does_not_fit(
    g: float | None, size: tuple[int, int], level: Severity, words: str
) -> None:
    only(calibrated(g, size), level, words)


def test_another_display_and_no_calibration() -> None:
    only(calibrated(config=replace(CONFIG, display_width_m=0.3)), NOTE, "0.3 m", "0.12 m")
    only(check_calibration(None, None, None, CONFIG), NOTE, "--calibration")


# -- all together ----------------------------------------------------------------------------------


def judged(heard: Session, given: tuple[str, Any] | None = None) -> list[CheckResult]:
    return evaluate(heard, AROUND, ("generic", CONFIG), given, "/sem")


def test_the_calibration_in_force_is_the_given_one_or_that_of_the_topic() -> None:
    text = CALIBRATION.dumps()
    found = judged(session(calibration_text=text))
    assert worst(found) == {OK}
    assert any("topic calibration" in str(finding) for finding in found)
    assert worst(judged(session(calibration_text=text), ("cal.yaml", CALIBRATION))) == {OK}
    other = replace(CALIBRATION, magnifications=(500.0, 900.0))
    found = judged(session(calibration_text=text), ("other.yaml", other))
    assert [f.level for f in found if "extrapolated" in str(f)] == [PROBLEM]
    assert [f.level for f in found if "another calibration than other.yaml" in str(f)] == [NOTE]
    broken = [f for f in judged(session(calibration_text="{}")) if f.level is PROBLEM]
    only(broken, PROBLEM, "calibration", "topic")


def doctor(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit status and output of the command."""
    capsys.readouterr()
    try:
        status = main(["doctor", *arguments])
    except SystemExit as end:
        status = int(end.code or 0)
    return status, capsys.readouterr().out


@pytest.fixture
def no_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("semcal_ros.doctor.diagnosis")
    seen = around(import_errors={"rclpy": "No module named 'rclpy'"}, rclpy_file="", rmw="")
    monkeypatch.setattr(module, "collect_environment", lambda: seen)


def test_without_ros_it_says_so_and_checks_the_rest(
    no_ros: None, capsys: pytest.CaptureFixture[str]
) -> None:
    status, output = doctor(capsys)
    assert status == 1
    lines = output.splitlines()
    # Problems first, after the counts.
    assert lines[0].startswith("1 problem, ")
    levels = [line.split(maxsplit=1)[0] for line in lines[1:] if not line.startswith(" ")]
    assert levels == sorted(levels, key=["problem", "note", "ok"].index)
    assert set(levels) == {"problem", "note", "ok"}
    assert lines[-1].startswith("         shared memory: ")
    assert any(line.startswith("ok       Python") for line in lines)
    assert any(line.startswith("problem  ROS 2: rclpy is not installed") for line in lines)
    assert any(line.startswith("note     topics: not checked") for line in lines)
    status, output = doctor(capsys, "--json")
    told = json.loads(output)
    assert status == told["problems"] == 1
    assert {"level", "subject", "seen", "expected", "do"} == set(told["findings"][0])


@pytest.mark.parametrize(
    "arguments",
    [
        ("--config", "nowhere"),
        ("--calibration", "missing.yaml"),
        ("--namespace", "a b"),
        ("--seconds", "0"),
    ],
)
def test_bad_input(arguments: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert arguments[1] in line


@pytest.mark.slow
def test_a_middleware_that_cannot_be_loaded_does_not_end_the_command(tmp_path: Path) -> None:
    """Loading it ends a process at once, so a process of its own tries it."""
    done = subprocess.run(
        [sys.executable, "-m", "semcal_ros", "doctor", "--seconds", "0.1"],
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "RMW_IMPLEMENTATION": "rmw_nowhere"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 1, done.stderr
    assert "problem  middleware: RMW_IMPLEMENTATION is rmw_nowhere" in done.stdout
    assert "Traceback" not in done.stderr


def test_a_recording_is_checked_without_ros(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    CALIBRATION.save(tmp_path / "cal.yaml")
    path = tmp_path / "bag"
    write_recording(path, [1000.0, 2000.0, 3000.0], size=32)
    arguments = (str(path), "--config", "virtual_sem", "--calibration", str(tmp_path / "cal.yaml"))
    status, output = doctor(capsys, *arguments)
    assert status == 0, output
    for line in (
        "ok       /sem/image_raw: sensor_msgs/msg/Image in the recording",
        "ok       images: 5 Hz, 32 x 32 mono8, 1024 bytes",
        "ok       stamps: frames are 0 ms old when they arrive",
        "ok       magnification: 3000",
    ):
        assert line in output
    assert "scaled, which holds if the field of view is the same" in output


def test_what_is_wrong_with_a_recording_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Each magnification after its image.
    path = tmp_path / "late"
    write_recording(path, [1000.0, 2000.0], size=32, lead_s=-0.001)
    status, output = doctor(capsys, str(path), "--config", "virtual_sem")
    assert status == 0
    assert "note     magnification: 1 image comes before the first one" in output
    status, output = doctor(capsys, str(path), "--config", "pixel_size_nm")
    assert status == 1
    first = output.splitlines()[1]
    assert first.startswith("problem  /sem/pixel_size: not in the recording, which holds ")
    assert "/sem/image_raw (sensor_msgs/msg/Image)" in first
    assert main(["doctor", str(tmp_path / "nothing")]) == 2
