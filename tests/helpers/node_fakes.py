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

"""What a helper of a node is connected with, without ROS at work: messages come in by a call."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from rclpy.clock import Clock

from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.reporter import Reporter


class FakeSubscription:
    """Calls back with what it is given; ``waiting`` is what has arrived and was not handed over yet."""

    def __init__(self, callback: Callable[[Any, Any], None], depth: float) -> None:
        self.callback = callback
        self.depth = depth
        self.lost = 0
        self.restarts = 0
        self.renewals = 0
        self.asked_again = 0
        self.rivals = ""
        self.in_memory = False
        self.names: list[str] = []
        self.waiting: deque[tuple[Any, Any]] = deque()

    def publishers(self) -> list[str]:
        return self.names

    def ask_again(self) -> None:
        self.asked_again += 1

    def find_rivals(self) -> str:
        return self.rivals

    def take(self) -> tuple[Any, Any] | None:
        return self.waiting.popleft() if self.waiting else None

    def take_waiting(self) -> None:
        while (taken := self.take()) is not None:
            self.callback(*taken)


class FakeEndpoints:
    """Keeps the subscriptions by topic; guards run at :meth:`hand_over`."""

    def __init__(self, depth: float = 10) -> None:
        self.subscriptions: dict[str, FakeSubscription] = {}
        self._depth = depth
        self._guards: list[Callable[[], None]] = []

    def subscribe(
        self, _type: Any, topic: str, callback: Any, _profile: Any, _group: Any = None, **_: Any
    ) -> Any:
        self.subscriptions[topic] = FakeSubscription(callback, self._depth)
        return self.subscriptions[topic]

    def guard(self, callback: Callable[[], None]) -> Any:
        self._guards.append(callback)
        return SimpleNamespace(trigger=lambda: None)

    def hand_over(self) -> None:
        """Run what an executor would run for the guards."""
        for callback in self._guards:
            callback()


class FakeParameters:
    """Values of parameters; changes go through what was asked to check and to apply them."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)
        self._changes: dict[str, tuple[Any, Any]] = {}

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def allowed_path(self, path: str) -> Any:
        return path

    def on_change(self, name: str, apply: Any, check: Any = None) -> None:
        self._changes[name] = check or (lambda _value: None), apply

    def set(self, name: str, value: Any) -> None:
        check, apply = self._changes.get(name, (lambda _value: None, lambda _value: None))
        check(value)
        self._values[name] = value
        apply(value)


def fake_reporter() -> tuple[Reporter, list[str]]:
    """A reporter, and the list of what it logs."""
    log: list[str] = []
    return Reporter(SimpleNamespace(info=log.append, warning=log.append), Clock()), log


def fake_context(
    endpoints: Any,
    config: MicroscopeConfig | str = "generic",
    parameters: Any = None,
    reporter: Any = None,
) -> NodeContext:
    """What a node hands its inputs and outputs; without a node that runs."""
    node: Any = SimpleNamespace(get_clock=Clock)
    chosen = load_config(config) if isinstance(config, str) else config
    return NodeContext(node, chosen, parameters, endpoints, reporter or fake_reporter()[0])


def notes(reporter: Reporter) -> dict[str, str]:
    """What the diagnostics would show."""
    return dict(reporter.statistics.summary(0.0).values)
