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

"""Executable ``suite``: source, corrector, parameter server, viewer and consumers in one process.

Consumers are what others do with the frames: the entry points ``semcal_ros.consumers``.
"""

from __future__ import annotations

import inspect
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from rclpy.node import Node

from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.calibrated_frame import CalibratedFrame
from semcal_ros.core.errors import ConfigError, InvalidValueError
from semcal_ros.core.wording import nearest_name
from semcal_ros.drivers.choose import SOURCES
from semcal_ros.drivers.source import FrameSource
from semcal_ros.nodes.bag_player import BagPlayer
from semcal_ros.nodes.common.base import DEFAULT_NAMESPACE, SemNode
from semcal_ros.nodes.common.command_line import command_line, unknown_parameter
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.run import Part, Parts, run_parts
from semcal_ros.nodes.frames.stream import is_late
from semcal_ros.nodes.microscope import Microscope
from semcal_ros.nodes.parameter_server import ParameterServer
from semcal_ros.nodes.stream_corrector import StreamCorrector
from semcal_ros.nodes.virtual_sem import VirtualSem

CONSUMERS = "semcal_ros.consumers"
"""The group of entry points."""
SKIPPING_DEPTH = 10
"""Of so many waiting frames those that have waited too long are skipped; of more, none is."""

_LOG_AGAIN_S = 10.0

MakeSource = Callable[[MicroscopeConfig], FrameSource]

_PARAMETERS = (
    ParameterDeclaration(
        "source",
        "none",
        "What the frames come from: a source of the node microscope, bag for bag_player, virtual_sem; none: another"
        " process.",
        choices=("none", *SOURCES, "bag", "virtual_sem"),
        fixed=True,
    ),
    ParameterDeclaration(
        "viewer",
        True,
        "Also show the stream in the browser, as `semcal view` does; its parameters are host, port and token.",
        fixed=True,
    ),
    ParameterDeclaration(
        "consumers",
        "all",
        "Entry points semcal_ros.consumers that get the frames: names with commas between them, all, or none.",
        fixed=True,
    ),
    ParameterDeclaration(
        "consumer_depth",
        SKIPPING_DEPTH,
        f"How many frames wait for each consumer. With more than {SKIPPING_DEPTH} it gets all of them, however late;"
        " otherwise those that have waited too long are skipped for newer ones.",
        low=1,
        high=1000,
        fixed=True,
    ),
)


def choose_consumers(names: str, installed: Iterable[EntryPoint] | None = None) -> list[EntryPoint]:
    """Return the entry points that are named.

    Parameters
    ----------
    names
        Names with commas between them, ``all``, or ``none``.
    installed
        What there is; by default the entry points of the environment.

    Raises
    ------
    InvalidValueError
        A name is not installed, or two packages have it.
    """
    found = sorted(entry_points(group=CONSUMERS) if installed is None else installed)
    known = {entry.name: entry for entry in found}
    wanted = names.replace(",", " ").split()
    if wanted == ["all"]:
        wanted = list(known)
    elif wanted == ["none"]:
        wanted = []
    for name in wanted:
        if name not in known:
            near = nearest_name(name, list(known))
            raise InvalidValueError(
                f"consumer {name}, which no installed package has",
                expected=f"{near}, perhaps" if near else f"one of {', '.join(known) or 'none'}",
                do=f"install its package, or look at the entry points {CONSUMERS}",
            )
        if len({entry.value for entry in found if entry.name == name}) > 1:
            raise InvalidValueError(
                f"consumer {name} in two installed packages", expected="a name for each"
            )
    return [known[name] for name in dict.fromkeys(wanted)]


class Consumer:
    """Calls a function of others with each frame, between the callbacks of a node of its own.

    The function is that of the entry point; of a class, an instance is made with the node first. What it raises is
    counted and logged, and the next frame comes all the same.

    Parameters
    ----------
    entry
        The entry point; its name is that of the node.
    depth
        How many frames wait while one is being worked on; with more than :data:`SKIPPING_DEPTH` none is skipped for
        having waited too long.

    Attributes
    ----------
    node, part
        The node, which a class may use for publishers, parameters and timers, and what runs it.
    frames, missed, failed
        Frames that it was called with; that were skipped since it is too slow; and on which it, or another callback
        of its node, raised.
    trouble
        What it raised last, if that was with the latest frame.

    Raises
    ------
    ConfigError
        The entry point cannot be loaded, or cannot be called.
    """

    def __init__(self, entry: EntryPoint, depth: int = SKIPPING_DEPTH) -> None:
        self.name = entry.name
        self.frames = self.missed = self.failed = 0
        self.trouble = ""
        self.node = Node(entry.name, namespace=DEFAULT_NAMESPACE)
        try:
            self._call = self._make(entry)
        except BaseException:
            self.node.destroy_node()
            raise
        self._depth = depth
        self._waiting: deque[tuple[float, CalibratedFrame]] = deque()
        self._before_s: float | None = None
        self._interval_s = 0.0
        self._logged: dict[str, float] = {}
        self.part = Part(self.node, lambda error: self.fail(error, "a callback of its node"))

    def _make(self, entry: EntryPoint) -> Callable[[CalibratedFrame], object]:
        try:
            loaded: Any = entry.load()
            is_class: bool = inspect.isclass(loaded)
            call: Any = loaded(self.node) if is_class else loaded
        except Exception as error:  # whatever the code of others may raise
            raise ConfigError(
                f"consumer {entry.name} ({entry.value}): {type(error).__name__}: {error}",
                expected="a function of a frame, or a class that is made with a node",
            ) from error
        if not callable(call):
            raise ConfigError(
                f"consumer {entry.name} ({entry.value}), which cannot be called",
                expected="a function of a frame, or a class whose instances are",
            )
        return call

    @property
    def waiting(self) -> int:
        """How many frames wait."""
        return len(self._waiting)

    def receive(self, frame: CalibratedFrame) -> None:
        """Take a frame, in any thread; the oldest makes room for it if too many wait."""
        now_s = time.monotonic()
        if self._before_s is not None:
            self._interval_s = now_s - self._before_s
        self._before_s = now_s
        self._waiting.append((now_s, frame))
        while len(self._waiting) > self._depth:
            self._waiting.popleft()
            self.missed += 1
        self.part.post(self._on_arrival)

    def _on_arrival(self) -> None:
        if not self._waiting:
            return
        since_s, frame = self._waiting.popleft()
        while (
            self._depth <= SKIPPING_DEPTH
            and self._waiting
            and is_late(time.monotonic() - since_s, self._interval_s)
        ):
            self.missed += 1
            since_s, frame = self._waiting.popleft()
        self.frames += 1
        try:
            self._call(frame)
            self.trouble = ""
        except (
            Exception,
            SystemExit,
            KeyboardInterrupt,
        ) as error:  # whatever the code of others may raise
            self.fail(error, "the call with a frame")
        if self._waiting:
            self.part.post(self._on_arrival)

    def fail(self, error: BaseException, where: str) -> None:
        """Count and log what the code of others raised, and where."""
        self.failed += 1
        self.trouble = f"{type(error).__name__}: {' '.join(str(error).split())}"
        now_s = time.monotonic()
        if now_s - self._logged.get(self.trouble, -_LOG_AGAIN_S) < _LOG_AGAIN_S:
            return
        # Only the latest text: one that differs each time, as by a number, must not fill the memory.
        self._logged = {self.trouble: now_s}
        lines = "".join(traceback.format_exception(error))
        self.node.get_logger().error(f"{where} raised; the next frame comes all the same:\n{lines}")


class Suite(SemNode):
    """The node of the main thread, which tells of the consumers; the others are nodes as in processes of their own.

    Parameters
    ----------
    make_own
        Makes another source than those of the parameter ``source``, from the configuration.
    """

    def __init__(self, make_own: MakeSource | None = None) -> None:
        super().__init__("suite", _PARAMETERS)
        self._make_own = make_own
        self._consumers: list[Consumer] = []
        self._suite_nodes: list[SemNode] = []

    def idle(self) -> bool:
        """Override the base class: frames come to the other nodes."""
        return True

    def introduction(self) -> list[str]:
        """Extend the base class: also say what runs here."""
        names = [node.get_name() for node in self._suite_nodes]
        names += [f"consumer {consumer.name}" for consumer in self._consumers]
        return [*super().introduction(), f"with {', '.join(names)}"]

    def conditions(self) -> list[str]:
        """Extend the base class: also report consumers that raise; note their counts."""
        self._note_counts()
        failing = [c for c in self._consumers if c.trouble]
        return super().conditions() + [f"consumer {c.name} raised {c.trouble}" for c in failing]

    def _note_counts(self) -> None:
        for consumer in self._consumers:
            for what in ("frames", "missed", "failed"):
                self.reporter.note(f"consumer.{consumer.name}.{what}", getattr(consumer, what))

    def has_work(self) -> bool:
        """Return whether anything waits that was handed over in memory."""
        waiting = sum(node.endpoints.waiting for node in self._suite_nodes)
        return waiting + sum(consumer.waiting for consumer in self._consumers) > 0

    @classmethod
    def with_parts(cls, make_own: MakeSource | None = None) -> Parts:
        """Make this node and the others, connected in memory.

        Raises
        ------
        SemcalError
            One of them cannot start, or a parameter is none of any node.
        """
        if any(argument.startswith("__node:=") for argument in command_line().arguments):
            raise InvalidValueError(
                "one name for all nodes of the suite",
                expected="one for each, as in -r stream_corrector:__node:=NAME",
            )
        suite = cls(make_own)
        try:
            return Parts(suite, suite._make_parts(), suite.has_work)
        except BaseException:
            suite.destroy_node()
            raise

    def _make_parts(self) -> list[Part]:
        corrector = StreamCorrector()
        self._keep(corrector)
        self._keep(ParameterServer())
        if self.parameters["viewer"]:
            self._keep(_make_viewer())
        for entry in choose_consumers(self.parameters["consumers"]):
            consumer = Consumer(entry, self.parameters["consumer_depth"])
            self.closing.callback(consumer.node.destroy_node)
            self._consumers.append(consumer)
            corrector.hand_to(consumer.receive)
        receivers = list(self._suite_nodes)
        source = self._make_source()
        if source is not None:
            self._keep(source)
            for node in receivers:
                node.endpoints.take_in_memory_from(source)
        self._refuse_unknown()
        for node in self._suite_nodes:
            node.introduce()
        self.introduce()
        # From here on the parts end what they are.
        self.closing.pop_all()
        parts = [Part(node) for node in self._suite_nodes]
        return parts + [consumer.part for consumer in self._consumers]

    def _keep(self, node: SemNode) -> None:
        self.closing.callback(node.destroy_node)
        self._suite_nodes.append(node)

    def _make_source(self) -> SemNode | None:
        name = self.parameters["source"]
        if self._make_own is not None:
            return Microscope(self._make_own)
        if name == "none":
            return None
        if name == "bag":
            return BagPlayer()
        return VirtualSem() if name == "virtual_sem" else Microscope()

    def _refuse_unknown(self) -> None:
        """Refuse parameters that none of the nodes has."""
        nodes = [self, *self._suite_nodes]
        unknown = set.intersection(*(node.unknown_parameters() for node in nodes))
        for key in sorted(unknown):
            if not any(consumer.node.has_parameter(key) for consumer in self._consumers):
                known = {name for node in nodes for name in node._parameters}
                raise unknown_parameter(key, "the suite", known)


def _make_viewer() -> SemNode:
    try:
        from semcal_ros.nodes.viewer import Viewer
    except ImportError as error:
        raise ConfigError(
            f"the page needs the package {error.name}, which is not installed",
            expected="the extra `view`",
            do="run `pip install tornado`, or start with -p viewer:=false",
        ) from error
    return Viewer()


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_parts(Suite.with_parts, args)


if __name__ == "__main__":
    raise SystemExit(main())
