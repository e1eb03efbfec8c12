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

"""Executable ``suite``: source, corrector, parameter server, viewer and consumers in one process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from semcal_ros.config import MicroscopeConfig
from semcal_ros.core.errors import ConfigError, InvalidValueError
from semcal_ros.drivers.choose import SOURCES
from semcal_ros.drivers.source import FrameSource
from semcal_ros.nodes.bag_player import BagPlayer
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.command_line import command_line, unknown_parameter
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.run import Part, Parts, run_parts
from semcal_ros.nodes.frames.consumer import SKIPPING_DEPTH, Consumer, choose_consumers
from semcal_ros.nodes.microscope import Microscope
from semcal_ros.nodes.parameter_server import ParameterServer
from semcal_ros.nodes.stream_corrector import StreamCorrector
from semcal_ros.nodes.virtual_sem import VirtualSem

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
