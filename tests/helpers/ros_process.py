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

"""Run executables in processes of their own and talk to them over real DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from tests.helpers.node_template import Copy, Template

REPOSITORY = Path(__file__).resolve().parents[2]
# Generous: other jobs may run on the same machine. Nothing waits longer than it has to.
TIMEOUT_S = 30.0
# Tests wait for what nodes report; once a second, as in earnest, they would do little else.
REPORT_PERIOD_S = 0.1
_CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL}
# Fast DDS reads it when a process creates its first participant.
_PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


# Every frame counts in a test, however busy the machine is.
PATIENT = {"qos_overrides./sem/image_raw.subscription.depth": 50}


_TEMPLATE = Template()


class NodeProcess:
    """One executable; ``output`` is what it wrote so far.

    It is a copy of a process that has done the imports already. With ``cold`` it is started as a user starts it, by the
    command that ``place`` makes of it.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, Any] | None = None,
        arguments: tuple[str, ...] = (),
        *,
        cold: bool = False,
        place: Callable[[list[str]], list[str]] | None = None,
    ) -> None:
        self.name = name
        command = ["--ros-args"]
        given = {"diagnostics_period": REPORT_PERIOD_S, **(parameters or {})}
        for key, value in given.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ["-p", f"{key}:={text}"]
        command += arguments
        environment = dict(os.environ)
        paths = [str(REPOSITORY), environment.get("PYTHONPATH", "")]
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
        self._log = tempfile.TemporaryFile(mode="w+")  # noqa: SIM115 - lives as long as the process
        self.process: subprocess.Popen[bytes] | Copy
        if cold or place is not None:
            started = [sys.executable, "-m", f"semcal_ros.nodes.{name}", *command]
            self.process = subprocess.Popen(
                started if place is None else place(started),
                stdout=self._log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
            )
        else:
            self.process = _TEMPLATE.copy(name, command, environment, self._log.fileno())

    @property
    def output(self) -> str:
        """Everything written to stdout and stderr."""
        self._log.flush()
        self._log.seek(0)
        return self._log.read()

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Exit status once it has ended by itself."""
        return self.process.wait(timeout_s)

    def stop(self, with_signal: int = signal.SIGINT, timeout_s: float = TIMEOUT_S) -> int:
        """Exit status after a signal; a node that crashes, even at its end, holds others up in shared memory."""
        if self.process.poll() is None:
            self.process.send_signal(with_signal)
        try:
            status = self.process.wait(timeout_s)
            assert -status not in _CRASHES, f"{self.name} crashed: {status}, {self.output}"
            return status
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise AssertionError(f"{self.name} did not stop: {self.output}") from None

    def close(self) -> None:
        """Forget the output; only after the end."""
        self._log.close()


def ended(name: str, parameters: Mapping[str, Any] | None = None) -> tuple[int, str]:
    """Exit status and output of an executable that ends by itself."""
    process = NodeProcess(name, parameters)
    try:
        return process.wait(), process.output
    finally:
        process.close()


@contextmanager
def running(
    name: str,
    parameters: Mapping[str, Any] | None = None,
    *arguments: str,
    cold: bool = False,
) -> Iterator[NodeProcess]:
    """An executable that is stopped at the end."""
    process = NodeProcess(name, parameters, arguments, cold=cold)
    try:
        yield process
    finally:
        try:
            process.stop()
        finally:
            process.close()


@contextmanager
def _quick_discovery() -> Iterator[None]:
    """What is created within announces itself ten times a second; the nodes under test keep the defaults."""
    with pytest.MonkeyPatch.context() as patch:
        if _PROFILE not in os.environ:
            patch.setenv(_PROFILE, str(REPOSITORY / "tests" / "helpers" / "quick_discovery.xml"))
        yield


class Peer:
    """A node of the test with what it has received, spun only while the test waits."""

    def __init__(self, name: str = "peer", namespace: str = "sem") -> None:
        self.context = Context()
        with _quick_discovery():
            rclpy.init(context=self.context, signal_handler_options=SignalHandlerOptions.NO)
            self.node = Node(name, context=self.context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.diagnostics = self.collect(DiagnosticArray, "/diagnostics")

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def collect(self, message_type: Any, topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """List that fills with the messages of a topic."""
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, qos)
        return received

    def state(self, node: str) -> dict[str, str]:
        """Latest diagnostics of a node, by its fully qualified name; ``level`` and ``message`` too."""
        for array in reversed(self.diagnostics):
            for status in array.status:
                if status.name == f"{node}: stream":
                    values = {value.key: value.value for value in status.values}
                    level = int.from_bytes(status.level, "little")
                    return {**values, "level": str(level), "message": status.message}
        return {}

    def wait_heard(self, node: str, *topics: str) -> None:
        """Wait until a node itself says that somebody receives what it publishes.

        That this side knows of the publisher is not enough: the other side learns of the subscription on its own.
        """
        for topic in topics:
            self.wait_for(
                lambda key=f"subscribers.{topic}": int(self.state(node).get(key, "0")) > 0,
                f"{node} to find a subscriber of {topic}",
            )

    def wait_for(
        self, condition: Callable[[], Any], what: str, timeout_s: float = TIMEOUT_S
    ) -> Any:
        """Result of ``condition`` as soon as it is true."""
        deadline = time.monotonic() + timeout_s
        while not (result := condition()):
            if time.monotonic() > deadline:
                raise AssertionError(f"waited {timeout_s:g} s in vain for {what}")
            self._executor.spin_once(timeout_sec=0.05)
        return result

    def spin(self, seconds: float) -> None:
        """Handle what arrives for a while."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def call(self, service_type: Any, name: str, request: Any, timeout_s: float = TIMEOUT_S) -> Any:
        """Answer of a service."""
        client = self.node.create_client(service_type, name)
        try:
            self.wait_for(client.service_is_ready, f"service {name}", timeout_s)
            future = client.call_async(request)
            self.wait_for(future.done, f"the answer of {name}", timeout_s)
            return future.result()
        finally:
            self.node.destroy_client(client)

    def trigger(self, name: str, timeout_s: float = TIMEOUT_S) -> Any:
        """Answer of a Trigger service."""
        return self.call(Trigger, name, Trigger.Request(), timeout_s)

    def get_parameters(self, node: str, *names: str) -> list[ParameterValue]:
        """Values by the ordinary parameter protocol."""
        request = GetParameters.Request(names=list(names))
        return list(self.call(GetParameters, f"{node}/get_parameters", request).values)

    def set_parameter(self, node: str, name: str, value: ParameterValue) -> Any:
        """Result of setting one parameter."""
        request = SetParameters.Request(parameters=[ParameterMessage(name=name, value=value)])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]
