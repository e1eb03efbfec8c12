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

"""DDS security: the shipped policy, refusal instead of running open, and what who is outside a policy gets."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import ParameterType, ParameterValue
from rclpy._rclpy_pybind11 import RCLError
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tests.helpers.dds_keystore import Keystore, Rights, read_policy, rights
from tests.helpers.long_tests import long_but
from tests.helpers.node_scenes import make_calibration, write_recording
from tests.helpers.project import NODES
from tests.helpers.ros_process import LATCHED, NodeProcess, Peer, running

POLICY = Path(__file__).resolve().parents[2] / "security" / "semcal_policy.xml"
GRANTED = read_policy(POLICY)
# Subscribed with use_sim_time only, published with `clock`, or compressed on demand.
SOMETIMES = {
    "rt/clock",
    "rt/tf_static",  # where tf2 is installed
    "rt/sem/image_rect/compressed",
    "rt/sem/image_stabilized/compressed",
}
OWN_SERVICES = (
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
)
UNBUILT = "doesn't have the security libraries"
SMALL = {"width": 64, "height": 64, "rate": 20.0}
VARIABLES = (
    "ROS_SECURITY_ENABLE",
    "ROS_SECURITY_STRATEGY",
    "ROS_SECURITY_KEYSTORE",
    "ROS_SECURITY_ENCLAVE_OVERRIDE",
)


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """The variables of ROS security as given, and those that are not given unset."""
    with pytest.MonkeyPatch.context() as patch:
        for name in VARIABLES:
            patch.delenv(name, raising=False)
        for name, value in values.items():
            patch.setenv(name, value)
        yield


def enforced(keystore: Path, enclave: str = "") -> dict[str, str]:
    """Environment of a process that must be secure."""
    values = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": str(keystore),
    }
    return values | ({"ROS_SECURITY_ENCLAVE_OVERRIDE": enclave} if enclave else {})


@contextmanager
def peer(name: str, values: Mapping[str, str]) -> Iterator[Peer]:
    """A node of the test in an environment of its own."""
    with environment(values):
        made = Peer(name)
    try:
        yield made
    finally:
        made.close()


# -- the policy ------------------------------------------------------------------------------------


def test_only_the_two_servers_may_publish_a_calibration() -> None:
    senders = {name for name, granted in GRANTED.items() if "rt/sem/calibration" in granted.publish}
    assert senders == {"/sem/calibration_server", "/sem/parameter_server"}


def test_only_the_operator_may_call_the_whole_suite_and_only_it_has_wildcards() -> None:
    calls = {name: {t for t in g.publish if t[:2] == "rq"} for name, g in GRANTED.items()}
    wild = {name for name, g in GRANTED.items() if any("*" in t for t in g.all)}
    assert wild == {"/sem/operator"}
    # The servo lets the corrector begin anew where its image has left the field.
    assert calls.pop("/sem/visual_servo") == {"rq/sem/stream_corrector/resetRequest"}
    assert {name for name, called in calls.items() if called} == {"/sem/operator"}


def parameters_of(node: str, folder: Path) -> dict[str, Any]:
    """With what a node uses everything that it can use."""
    if node == "bag_player":
        write_recording(folder / "bag", [1000.0])
        return {"bag": folder / "bag", "start_paused": True}
    if node == "microscope":
        return {"source": "folder", "folder": folder, "journal": folder / "journal"}
    if node == "calibration_server":
        return {"microscope": "microscope"}
    if node == "parameter_server":
        return {"monitor_period": 60.0}
    return {"input": "stabilized"} if node == "rectifier" else {}


def used_by(node: str, observer: Peer) -> Rights:
    """What the ROS graph says that a node has."""
    graph = observer.node
    return (
        rights("publish", names(graph.get_publisher_names_and_types_by_node(node, "/sem")))
        | rights("subscribe", names(graph.get_subscriber_names_and_types_by_node(node, "/sem")))
        | rights("reply", names(graph.get_service_names_and_types_by_node(node, "/sem")))
        | rights("request", names(graph.get_client_names_and_types_by_node(node, "/sem")))
    )


def names(found: list[tuple[str, list[str]]]) -> list[str]:
    """The names without the types."""
    return [name for name, _types in found]


# One process has one enclave, which for the suite would hold the rights of all its nodes: the policy has none for it.
ENCLAVED = tuple(node for node in NODES if node != "suite")


@pytest.mark.parametrize(
    "node", long_but(lambda node: node in ("calibration_server", "stream_corrector"), ENCLAVED)
)
def test_the_policy_grants_a_node_what_it_uses_and_no_more(node: str, tmp_path: Path) -> None:
    granted = GRANTED[f"/sem/{node}"]
    needed = granted.all - SOMETIMES
    # Each executable is started here as a user starts it.
    with peer("peer", {}) as observer, running(node, parameters_of(node, tmp_path), cold=True):
        # Its last entity is made before it reports.
        observer.wait_for(lambda: observer.state(f"/sem/{node}"), f"{node} to report")
        known = observer.node.get_node_names_and_namespaces
        observer.wait_for(lambda: (node, "/sem") in known(), f"{node} in the graph")
        with suppress(AssertionError):  # what is missing then is said below
            observer.wait_for(lambda: needed <= used_by(node, observer).all, "the rest")
        used = used_by(node, observer)
    assert used.publish - granted.publish == set()
    assert used.subscribe - granted.subscribe == set()
    assert granted.publish - used.publish - SOMETIMES == set()
    assert granted.subscribe - used.subscribe - SOMETIMES == set()


# -- refusal ---------------------------------------------------------------------------------------


def refusals(values: Mapping[str, str], *nodes: str) -> list[str]:
    """What executables say that must not start, each with an enclave of its own."""
    with environment(values):
        processes = [NodeProcess(node, arguments=("--enclave", f"/sem/{node}")) for node in nodes]
    try:
        statuses = [process.wait() for process in processes]
        # A launch file does not start such a node again.
        assert set(statuses) == {2}
        return [process.output for process in processes]
    finally:
        for process in processes:
            process.stop()
            process.close()


def test_a_node_without_its_enclave_does_not_run_open(tmp_path: Path) -> None:
    (tmp_path / "enclaves").mkdir()
    # ROS looks for the enclave before anything that differs between nodes.
    nodes = ("calibration_server", "stream_corrector")
    for node, said in zip(nodes, refusals(enforced(tmp_path), *nodes), strict=True):
        assert f"'{tmp_path}/enclaves/sem/{node}' does not exist" in said


def test_a_node_whose_enclave_is_empty_does_not_run_open(tmp_path: Path) -> None:
    (tmp_path / "enclaves/sem/rectifier").mkdir(parents=True)
    (said,) = refusals(enforced(tmp_path), "rectifier")
    assert UNBUILT in said or "couldn't find all security files" in said


def test_a_node_without_a_keystore_does_not_run_open() -> None:
    values = enforced(Path())
    del values["ROS_SECURITY_KEYSTORE"]
    (said,) = refusals(values, "rectifier")
    assert "ROS_SECURITY_KEYSTORE is not set" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("name", "value"),
    [("ROS_SECURITY_ENABLE", "True"), ("ROS_SECURITY_STRATEGY", "enforce")],
)
def test_values_that_ros_takes_for_no_security_are_refused(
    tmp_path: Path, name: str, value: str
) -> None:
    (said,) = refusals({**enforced(tmp_path), name: value}, "rectifier")
    assert f"{name} is {value!r}" in said
    assert "Traceback" not in said


# -- enforcement -----------------------------------------------------------------------------------


def own_rights(name: str) -> Rights:
    """What a peer needs to be a node and to see diagnostics."""
    return (
        rights("publish", ["/rosout", "/parameter_events"])
        | rights("subscribe", ["/diagnostics"])
        | rights("reply", [f"/sem/{name}/{service}" for service in OWN_SERVICES])
    )


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The policy of the suite, and two peers of the same authority: one with rights, one without."""
    root = tmp_path_factory.mktemp("security")
    (root / "probe/enclaves/sem/rectifier").mkdir(parents=True)
    (said,) = refusals(enforced(root / "probe"), "rectifier")
    if UNBUILT in said:
        pytest.skip("the Fast DDS that is installed is built without security (SECURITY=OFF)")
    if shutil.which("openssl") is None:
        pytest.skip("no openssl command to make certificates with")
    store = Keystore(root / "keystore", int(os.environ["ROS_DOMAIN_ID"]))
    for enclave, granted in GRANTED.items():
        store.add(enclave, granted)
    rights_of_insider = (
        rights("subscribe", ["/sem/image_raw"])
        | rights("publish", ["/sem/calibration"])
        | rights("request", ["/sem/calibration_server/*"])
    )
    store.add("/sem/insider", own_rights("insider") | rights_of_insider)
    store.add("/sem/outsider", own_rights("outsider"))
    return store.root


@contextmanager
def started(
    node: str, keystore: Path | None, parameters: Mapping[str, Any] | None = None
) -> Iterator[NodeProcess]:
    """A node of the suite in its enclave, or open without a keystore."""
    arguments = ("--enclave", f"/sem/{node}") if keystore else ()
    with ExitStack() as stack:
        # Only while it starts: the peers have environments of their own.
        with environment(enforced(keystore) if keystore else {}):
            process = stack.enter_context(running(node, parameters, *arguments))
        yield process


@contextmanager
def audience(keystore: Path) -> Iterator[tuple[Peer, Peer, Peer]]:
    """An insider, an outsider, and a stranger without any security."""
    with (
        peer("insider", enforced(keystore, "/sem/insider")) as insider,
        peer("outsider", enforced(keystore, "/sem/outsider")) as outsider,
        peer("stranger", {}) as stranger,
    ):
        yield insider, outsider, stranger


def test_images_reach_nobody_outside_of_the_policy(keystore: Path) -> None:
    with audience(keystore) as (insider, outsider, stranger):
        seen = insider.collect(Image, "image_raw")
        overheard = stranger.collect(Image, "image_raw")
        with pytest.raises(RCLError):
            outsider.collect(Image, "image_raw")
        with started("virtual_sem", keystore, SMALL):
            insider.wait_for(lambda: len(seen) >= 10, "images for who is in the policy")
            stranger.spin(0.5)
            assert not overheard
        with started("virtual_sem", None, SMALL):
            stranger.wait_for(lambda: overheard, "images of a microscope without security")


def test_a_calibration_is_taken_from_nobody_outside_of_the_policy(keystore: Path) -> None:
    text = make_calibration().dumps()
    forged = String(data=text.replace("method: joint", "method: pda"))
    assert forged.data != text
    node = "/sem/parameter_server"
    with audience(keystore) as (insider, outsider, stranger):
        with pytest.raises(RCLError):
            outsider.node.create_publisher(String, "calibration", LATCHED)
        # Latched: whenever the server should find this publisher, it would get the forgery.
        stranger.node.create_publisher(String, "calibration", LATCHED).publish(forged)
        with started("parameter_server", keystore) as server:
            insider.wait_for(lambda: insider.state(node), "the server to report")
            stranger.spin(0.5)
            insider.node.create_publisher(String, "calibration", LATCHED).publish(String(data=text))
            insider.wait_for(lambda: insider.state(node).get("calibration") == "topic", "it")
            assert server.output.count("calibration from topic") == 1
            assert "calibration from topic: joint" in server.output
            assert not stranger.state(node)
        with started("parameter_server", None) as server:
            stranger.wait_for(lambda: stranger.state(node).get("calibration") == "topic", "it")
            assert "calibration from topic: pda" in server.output


def test_services_answer_nobody_outside_of_the_policy(keystore: Path) -> None:
    service, node = "calibration_server/calibrate", "/sem/calibration_server"
    pda = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="pda")
    with audience(keystore) as (insider, outsider, stranger):
        with pytest.raises(RCLError):
            outsider.node.create_client(Trigger, service)
        client = stranger.node.create_client(Trigger, service)
        with started("calibration_server", keystore):
            assert not insider.trigger(service).success  # answered: there are no views
            assert insider.set_parameter(node, "method", pda).successful
            stranger.spin(0.5)
            assert not client.service_is_ready()
        with started("calibration_server", None):
            stranger.wait_for(client.service_is_ready, "a service without security")
            assert stranger.set_parameter(node, "method", pda).successful


def test_the_nodes_work_together_in_their_enclaves(keystore: Path, tmp_path: Path) -> None:
    make_calibration().save(tmp_path / "cal.yaml")
    calibration = {"calibration": tmp_path / "cal.yaml"}
    with (
        peer("viewer", enforced(keystore, "/sem/viewer")) as viewer,
        started("stream_corrector", keystore),
        started("parameter_server", keystore, calibration),
        started("virtual_sem", keystore, SMALL),
    ):
        rectified = viewer.collect(Image, "image_rect")
        viewer.wait_for(
            lambda: viewer.state("/sem/stream_corrector").get("calibration") == "topic",
            "the calibration of parameter_server",
        )
        rectified.clear()
        viewer.wait_for(lambda: rectified, "images rectified with it")
