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

"""Faults at random, every second, on a running suite; in quiet intervals between them every frame must be right."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64, String

from benchmarks.network.namespaces import Network
from tests.helpers.node_scenes import SIZE, image_message, magnification_message, texture
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer
from tests.helpers.stream_bench import (
    CALIBRATION,
    CORRECTOR,
    NOISE,
    RECTIFIER,
    Restartable,
    Watch,
    difference,
    noisy,
    pixels,
    resident_kib,
    restartable,
)

__all__ = ["MACHINES", "Soak"]

# The microscope's, on which the test runs, and one for the nodes of each namespace.
MACHINES = ("microscope", "sem", "lab")
# Long enough for a stream to stand still, short of the 20 s after which Fast DDS forgets a participant.
UNPLUGGED_S = 3.0

FRAME_PERIOD_S = 0.1
FAULT_PERIOD_S = 1.0
# Every so many faults a look whether all is well.
FAULTS_PER_ROUND = 5
QUIET_FRAMES = 6
RECOVERY_S = 60.0
# What a process may have grown by since its first quiet interval, however long the soak is.
GROWTH_KIB = 24 * 1024
MAGNIFICATIONS = (700.0, 1500.0, 3000.0, 6000.0)


@dataclass
class _Frame:
    picture: np.ndarray
    magnification: float


@dataclass
class Soak:
    """A virtual SEM and a microscope played by the test, all nodes of the suite, and somebody who breaks things.

    The rectifier and the stream corrector work on the test's own frames, whose truth is known; the compensator and the
    calibration server on those of the virtual SEM.

    On a network the test itself runs on the machine ``microscope``; the nodes of each namespace have a machine of that
    name, and their cables are pulled out, too.
    """

    peer: Peer
    folder: Path
    seed: int
    network: Network | None = None
    restarts: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    history: list[str] = field(default_factory=list)
    checked: int = 0

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._watch = Watch(self.peer)
        self._sent: dict[int, _Frame] = {}
        self._number = 0
        self._stamp_s = 1_000_000
        self._magnification = MAGNIFICATIONS[1]
        node = self.peer.node
        self._image = node.create_publisher(Image, "image_raw", RELIABLE)
        self._value = node.create_publisher(Float64, "magnification", LATCHED)
        self._text = node.create_publisher(String, "calibration", LATCHED)
        self._knob = node.create_publisher(Float64, "/lab/virtual_sem/set_magnification", RELIABLE)
        # The corrector has outputs of its own, for the rectifier uses the same names.
        self._outputs = {
            RECTIFIER: self.peer.collect(Image, "image_rect"),
            CORRECTOR: self.peer.collect(Image, "/sem/corrected/image_rect"),
        }
        self._infos = self.peer.collect(CameraInfo, "camera_info")
        self._memory: dict[str, tuple[int, int]] = {}

    # -- the whole -------------------------------------------------------------------------------------

    def run(self, duration_s: float) -> None:
        """Break things for that long; raises AssertionError at the first that is not as it should be."""
        CALIBRATION.save(self.folder / "cal.yaml")
        with ExitStack() as stack:
            self._nodes = {
                name: stack.enter_context(
                    restartable(executable, parameters, *arguments, place=self._place(name))
                )
                for name, (executable, parameters, arguments) in self._plan().items()
            }
            self._set_magnification(self._magnification)
            self._quiet()
            deadline = time.monotonic() + duration_s
            while time.monotonic() < deadline:
                for _ in range(FAULTS_PER_ROUND):
                    name, fault = self._random.choice(self._faults())
                    self.faults[name] += 1
                    self.history.append(f"{name} before frame {self._number + 1}")
                    fault()
                    self._stream(FAULT_PERIOD_S)
                self._quiet()
            for name, node in self._nodes.items():
                assert node.alive(), f"{name}: {node.output}"

    def _plan(self) -> dict[str, tuple[str, dict[str, Any], tuple[str, ...]]]:
        file = self.folder / "cal.yaml"
        lab = ("-r", "__ns:=/lab")
        remap = [
            text
            for topic in ("image_rect", "camera_info", "drift", "drift_velocity")
            for text in ("-r", f"{topic}:=/sem/corrected/{topic}")
        ]
        sem = {"width": 64, "height": 64, "rate": 5.0, "specimen": "gold", "drift": "slow"}
        return {
            "/sem/parameter_server": ("parameter_server", {"calibration": file}, ()),
            "/sem/rectifier": ("rectifier", {}, ()),
            "/sem/stream_corrector": ("stream_corrector", {"calibration": file}, tuple(remap)),
            "/lab/virtual_sem": ("virtual_sem", sem, lab),
            "/lab/drift_compensator": ("drift_compensator", {}, lab),
            "/lab/calibration_server": ("calibration_server", {"config": "virtual_sem"}, lab),
        }

    def _place(self, name: str) -> Callable[[list[str]], list[str]] | None:
        network = self.network
        if network is None:
            return None
        return lambda command: network.command(name.split("/")[1], command)

    # -- the stream ------------------------------------------------------------------------------------

    def _set_magnification(self, magnification: float) -> None:
        self._magnification = magnification
        self._value.publish(magnification_message(magnification))

    def _send(self) -> int:
        """One good frame; its number, which is the nanoseconds of its stamp."""
        self._number += 1
        self._stamp_s += 1
        picture = noisy(texture(), self._number)
        self._sent[self._number] = _Frame(picture, self._magnification)
        self._sent.pop(self._number - 500, None)
        message = image_message(picture, self._stamp_s)
        message.header.stamp.nanosec = self._number
        self._image.publish(message)
        return self._number

    def _stream(self, duration_s: float) -> None:
        deadline = time.monotonic() + duration_s
        while time.monotonic() < deadline:
            self._send()
            self.peer.spin(FRAME_PERIOD_S)

    # -- faults ----------------------------------------------------------------------------------------

    def _faults(self) -> list[tuple[str, Callable[[], None]]]:
        kills = [(f"kill {name}", lambda n=name: self._kill(n)) for name in self._nodes]
        others = [
            ("bad frame", self._bad_frame),
            ("bad magnification", self._bad_magnification),
            ("bad calibration", self._bad_calibration),
            ("burst", self._burst),
            ("other magnification", self._other_magnification),
            ("knob", self._turn_knob),
            ("clock back", self._clock_back),
        ]
        if self.network is not None:
            others += [
                (f"cable of {name}", lambda n=name: self._unplug(n)) for name in MACHINES[1:]
            ]
        return kills + others

    def _unplug(self, name: str) -> None:
        assert self.network is not None
        # Fast DDS never uses a network that was down when its process started.
        for node in self._nodes:
            if node.startswith(f"/{name}/"):
                self._until(lambda n=node: self._watch.states(n), f"{node} to report")
        self.network.plug(name, connected=False)
        self._stream(UNPLUGGED_S)
        self.network.plug(name, connected=True)

    def _kill(self, name: str) -> None:
        node: Restartable = self._nodes[name]
        assert node.alive(), f"{name}: {node.output}"
        assert "Traceback" not in node.output, node.output
        node.kill()
        # What it said last is still on its way.
        self.peer.spin(FRAME_PERIOD_S)
        self._watch.forget()
        node.start_again()
        self.restarts[name] += 1
        self._memory.pop(name, None)

    def _bad_frame(self) -> None:
        message = image_message(texture(), self._stamp_s)
        change = self._random.choice(
            [
                ("encoding", "bayer_rggb8"),
                ("encoding", ""),
                ("step", 2**32 - 1),
                ("step", 0),
                ("height", 0),
                ("height", 2**31),
                ("width", 2**20),
            ]
        )
        setattr(message, *change)
        if self._random.random() < 0.5:
            del message.data[self._random.randrange(SIZE * SIZE) :]
        self._image.publish(message)

    def _bad_magnification(self) -> None:
        absurd = (0.0, -1.0, float("nan"), float("inf"), 1e12, 1e-300, 5e-324)
        self._value.publish(magnification_message(self._random.choice(absurd)))
        self._send_unusable()
        self._set_magnification(self._magnification)

    def _send_unusable(self) -> None:
        """A frame at no known magnification: nothing may come of it."""
        self._sent.pop(self._send())

    def _bad_calibration(self) -> None:
        text = CALIBRATION.dumps()
        self._text.publish(String(data=text[: self._random.randrange(len(text) - 1)]))

    def _burst(self) -> None:
        for _ in range(100):
            self._send()

    def _other_magnification(self) -> None:
        self._set_magnification(self._random.choice(MAGNIFICATIONS))

    def _turn_knob(self) -> None:
        self._knob.publish(Float64(data=self._random.choice((*MAGNIFICATIONS, -1.0, 1e300))))

    def _clock_back(self) -> None:
        self._stamp_s -= self._random.choice((2, 100, 100_000))

    # -- quiet intervals -------------------------------------------------------------------------------

    def _quiet(self) -> None:
        """Without faults: everybody is there, and each of a few frames in a row comes out right."""
        self._watch.forget()
        for name in self._nodes:
            self._until(lambda n=name: self._watch.states(n), f"{name} to report")
        self._until(self._comes_through, "frames in a row from both")
        # Before the calibration has come a restarted rectifier passes frames on, and says so.
        told = {m.header.stamp.nanosec: any(m.k) for m in self._infos}
        for kind, images in self._outputs.items():
            for message in images:
                number = message.header.stamp.nanosec
                # Nothing is known of frames of a burst long ago, or without a magnification.
                if number in self._sent:
                    # The first camera_info of a restarted node may come before it is found, the image after.
                    known = True if kind is CORRECTOR else told.get(number)
                    self._check(kind, message, self._sent[number], known)
            images.clear()
        self._infos.clear()
        for name, node in self._nodes.items():
            assert node.alive(), f"{name}: {node.output}"
            assert "Traceback" not in node.output, f"{name}: {node.output}"
            self._check_memory(name, node)

    def _until(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + RECOVERY_S
        while not condition():
            assert time.monotonic() < deadline, (
                f"waited {RECOVERY_S:g} s in vain for {what}; sent {self._number}; {self._tell()}"
            )
            self._send()
            self.peer.spin(FRAME_PERIOD_S)

    def _tell(self) -> str:
        """What helps to find out who is to blame."""
        newest = {
            k.node: [m.header.stamp.nanosec for m in v][-8:] for k, v in self._outputs.items()
        }
        states = {name: self._watch.latest(name).get("message") for name in self._nodes}
        silent = {
            name: (node.alive(), node.output[-600:])
            for name, node in self._nodes.items()
            if states[name] is None
        }
        return f"newest {newest}; {states}; {self.history[-12:]}; silent: {silent}"

    def _comes_through(self) -> bool:
        wanted = set(range(self._number - QUIET_FRAMES, self._number))
        got = [{m.header.stamp.nanosec for m in images} for images in self._outputs.values()]
        calibrated = {m.header.stamp.nanosec for m in self._infos if any(m.k)}
        return all(wanted <= numbers for numbers in (*got, calibrated))

    def _check(self, kind: Any, message: Any, frame: _Frame, calibrated: bool | None) -> None:
        """Whether an image is the corrected frame, the frame itself, or, where that is not known, either."""
        rights = {True: kind.right(frame.picture, frame.magnification), False: frame.picture}
        wanted = [r for known, r in rights.items() if calibrated in (known, None)]
        error = min(difference(pixels(message), right) for right in wanted)
        number = message.header.stamp.nanosec
        assert error < 2.0 * NOISE, (
            f"{kind.node}, frame {number}, {calibrated=}: {error:.1f} grey levels; {self.history[-20:]}"
        )
        self.checked += 1

    def _check_memory(self, name: str, node: Restartable) -> None:
        now_kib = resident_kib(node.pid)
        pid, first_kib = self._memory.setdefault(name, (node.pid, now_kib))
        assert pid == node.pid
        grown_kib = now_kib - first_kib
        assert grown_kib < GROWTH_KIB, f"{name} has grown by {grown_kib} KiB; {self.history[-20:]}"
