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

"""Machines on one network: namespaces joined by virtual cables and a switch, with a rate and buffers.

Each machine has its own interfaces, shared memory and processes; the processor, the clock and the file system are
shared. Needs root, iproute2 and util-linux, on Linux.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

__all__ = ["Network", "why_not"]

# What a machine's own queue holds, bytes: a process that sends waits for its network card.
_CARD_QUEUE = 32 * 2**20
# Buffer of a switch's port, bytes; what exceeds it is lost. Small managed switches have 0.5 to 2 MB.
_PORT_QUEUE = 2**20
# Seconds of the full rate that go out at once. The kernel's timer needs some ms.
_BURST_S = 0.004
_REPOSITORY = Path(__file__).resolve().parents[2]
_RELAY = ("-m", "benchmarks.network.relay")
_TOOLS = ("ip", "tc", "unshare", "mount", "umount")
# Fast DDS tells machines apart by their interfaces and shares memory within one, so that each gets memory of its own.
_OWN_MEMORY = 'mount --bind "$0" /dev/shm && exec "$@"'


def why_not() -> str:
    """Why namespaces cannot be made here; empty where they can."""
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} not installed"
    if os.geteuid() != 0:
        return "only root makes network namespaces"
    probe = f"semcal-probe-{os.getpid()}"
    made = _try("ip", "netns", "add", probe)
    if made.returncode:
        return made.stderr.strip()
    _run("ip", "netns", "delete", probe)
    return ""


class Network:
    """Machines by name; a context manager that removes them at its end, with what still runs in them.

    Parameters
    ----------
    names
        The machines.
    mbit_per_s
        Rate of each cable, both ways.
    multicast
        Whether the network passes multicast on.
    loss
        Fraction of the packets that the cable of each of these machines loses, both ways.
    stem
        What the names of the namespaces begin with: that of another process' network, to use it without making it.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        mbit_per_s: float = 1000.0,
        multicast: bool = True,
        loss: Mapping[str, float] | None = None,
        stem: str | None = None,
    ) -> None:
        self.stem = stem or f"semcal-{os.getpid()}"
        self._switch = f"{self.stem}-switch"
        self._names = list(names)
        self._rate, self._multicast = mbit_per_s, multicast
        self._loss = dict(loss or {})
        self._relays: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Network:
        try:
            self._build()
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._remove()

    def address(self, name: str) -> str:
        """IPv4 address of a machine."""
        return f"10.83.0.{1 + self._names.index(name)}"

    def command(self, name: str, command: Sequence[str]) -> list[str]:
        """The command that runs another one on a machine; signals reach the latter."""
        own_memory = ["unshare", "--mount", "sh", "-c", _OWN_MEMORY, self._memory(name)]
        return _inside(self._space(name), *own_memory, *command)

    def plug(self, name: str, *, connected: bool) -> None:
        """Pull the cable of a machine out of the switch, or put it in again."""
        port, state = self._port(name), "up" if connected else "down"
        _run("ip", "-n", self._switch, "link", "set", port, state)

    def _space(self, name: str) -> str:
        return f"{self.stem}-{name}"

    def _memory(self, name: str) -> str:
        """Folder of the shared memory of a machine."""
        return f"/run/{self.stem}/{name}"

    def _port(self, name: str) -> str:
        return f"port{self._names.index(name)}"

    def _build(self) -> None:
        # Not in /dev/shm, which a machine that starts a process on another has its own in place of.
        Path(f"/run/{self.stem}").mkdir()
        _run("mount", "-t", "tmpfs", "tmpfs", f"/run/{self.stem}")
        _run("ip", "netns", "add", self._switch)
        inside = ("ip", "-n", self._switch)
        # Without a router that asks who listens, a switch that snoops would stop passing multicast on.
        _run(*inside, "link", "add", "bridge", "type", "bridge", "mcast_snooping", "0")
        _run(*inside, "link", "set", "bridge", "up")
        for name in self._names:
            self._connect(name)

    def _connect(self, name: str) -> None:
        space, port = self._space(name), self._port(name)
        card, own = "eth0", ("ip", "-n", space)
        _run("ip", "netns", "add", space)
        Path(self._memory(name)).mkdir()
        _run(*own, "link", "set", "lo", "up")
        _run(
            *(*own, "link", "add", card, "type", "veth", "peer", "name", port),
            *("netns", self._switch),
        )
        if self._loss.get(name):
            self._put_relay_before(port, self._loss[name])
        else:
            _run("ip", "-n", self._switch, "link", "set", port, "master", "bridge", "up")
        _run(*own, "address", "add", f"{self.address(name)}/24", "dev", card)
        _run(*own, "link", "set", card, "up")
        _run(*own, "route", "add", "default", "dev", card)
        if self._loss:
            # Not only the packets of the machine behind the relay come to it.
            _run(*_inside(space, sys.executable, *_RELAY, "--prepare", card))
        if not self._multicast:
            # As many managed switches and wireless networks do.
            port_of = ("ip", "-n", self._switch, "link", "set", port, "type", "bridge_slave")
            _run(*port_of, "mcast_flood", "off")
        for where, device, queue in ((space, card, _CARD_QUEUE), (self._switch, port, _PORT_QUEUE)):
            burst = max(int(self._rate * 1e6 / 8.0 * _BURST_S), 70_000)
            rate = f"{self._rate:g}mbit"
            _run(
                *("tc", "-n", where, "qdisc", "add", "dev", device, "root", "tbf"),
                *("rate", rate, "burst", str(burst), "limit", str(queue)),
            )

    def _put_relay_before(self, port: str, loss: float) -> None:
        """Lead the cable of a port through a process that loses packets, and then into the switch."""
        near, far = f"{port}-near", f"{port}-far"
        inside = ("ip", "-n", self._switch, "link")
        _run(*inside, "add", near, "type", "veth", "peer", "name", far)
        _run(*inside, "set", far, "master", "bridge", "up")
        for end in (near, port):
            _run(*inside, "set", end, "up")
        relay = subprocess.Popen(
            _inside(self._switch, sys.executable, *_RELAY, port, near, "--loss", str(loss)),
            cwd=_REPOSITORY,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._relays.append(relay)
        assert relay.stdout is not None
        if relay.stdout.readline() != "ready\n":
            raise OSError("the relay does not start")

    def _remove(self) -> None:
        for relay in self._relays:
            relay.kill()
            relay.communicate()
        for space in [*map(self._space, self._names), self._switch]:
            for pid in _try("ip", "netns", "pids", space).stdout.split():
                _try("kill", "-9", pid)
            _try("ip", "netns", "delete", space)
        _try("umount", "--lazy", f"/run/{self.stem}")
        with suppress(OSError):
            Path(f"/run/{self.stem}").rmdir()


def _inside(space: str, *command: str) -> list[str]:
    return ["ip", "netns", "exec", space, *command]


def _run(*command: str) -> None:
    made = _try(*command)
    if made.returncode:
        raise OSError(f"{' '.join(command)}: {made.stderr.strip()}")


def _try(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, check=False, capture_output=True, text=True, cwd=_REPOSITORY)
