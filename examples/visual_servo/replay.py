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

"""The servoing example as a recording that is replayed to the nodes.

Nothing obeys in a replay. But the recording is of a stage that was servoed, and what the node sees and commands now can
be compared with the truth of every frame and with what was commanded then.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import QoSProfile

from examples.live_nodes import LiveNodes
from examples.visual_servo.loop import LATENCY_S, Run
from semcal_ros.applications.servoing import PlanePose
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.files.bags.writer import SIMULATED_START_NS, write_simulated
from semcal_ros.synthetic import VirtualMicroscope

SILENCE_S = 5.0


@dataclass(frozen=True)
class Shot:
    """What the bag needs to know of a frame."""

    start_time_s: float
    magnification: float


def stamps_of(run: Run) -> list[int]:
    """Header stamps of the frames of a run, ns."""
    return [SIMULATED_START_NS + round(start_s * 1e9) for start_s in run.start_s]


def record(run: Run, microscope: VirtualMicroscope, folder: Path) -> None:
    """The raw frames of a run as a bag; each was published once it was scanned."""
    shots = [Shot(*row) for row in zip(run.start_s, run.magnification, strict=True)]
    truth = {
        "stamp_ns": stamps_of(run),
        "error_m_m_rad": [error.tolist() for error in run.true_error],
        "twist": [twist.tolist() for twist in run.twist],
    }
    # A little before the controller of the run had its command.
    delay_s = microscope.timing.acquisition_time_s + 0.5 * LATENCY_S
    write_simulated(folder, shots, run.raw, truth, delay_s=delay_s, overwrite=True)


def replay(folder: Path, bag: Path, goal: PlanePose, rate: float) -> dict[int, np.ndarray]:
    """Replay a bag to parameter_server, stream_corrector and visual_servo.

    Returns target minus goal (x, y in m, angle in rad) as ~/error has it, by stamp in ns.
    """
    errors: dict[int, np.ndarray] = {}

    def on_error(message: PoseWithCovarianceStamped) -> None:
        pose = message.pose.pose
        turn = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        errors[stamp_ns_from_msg(message)] = np.array([pose.position.x, pose.position.y, turn])

    nodes = LiveNodes(folder / "logs")
    common = {"config": "virtual_sem", "use_sim_time": True}
    calibrated = {**common, "calibration": (folder / "cal.yaml").absolute()}
    goals = {"goal_x_m": goal.x_m, "goal_y_m": goal.y_m}
    goals |= {"goal_rotation_deg": math.degrees(goal.angle_rad)}
    # Live, the newest frame wins; here all frames are to be measured, however busy the machine is.
    every = {"drift_tracking": "every_frame", "qos_overrides./sem/image_raw.subscription.depth": 50}
    rclpy.init()
    node = rclpy.create_node("referee", namespace="/sem")
    try:
        nodes.start("parameter_server", calibrated)
        nodes.start("stream_corrector", {**calibrated, **every})
        # Not started: no stage obeys here, and a servo that sees this measures no more.
        nodes.start("visual_servo", {**common, **goals, "start": False})
        queue = QoSProfile(depth=100)
        node.create_subscription(PoseWithCovarianceStamped, "visual_servo/error", on_error, queue)
        # The servo hears the corrector; both hear the magnification, and the corrector the images.
        playing = {"config": "virtual_sem", "bag": bag.absolute(), "clock": True, "rate": rate}
        wait_until_heard(node, nodes)
        player = nodes.start("bag_player", {**playing, "wait_for_subscribers": 1})
        last_s = time.monotonic()
        while player.poll() is None or time.monotonic() - last_s < SILENCE_S:
            seen = len(errors)
            rclpy.spin_once(node, timeout_sec=0.1)
            nodes.check()
            if player.poll() is None or len(errors) > seen:
                last_s = time.monotonic()
    finally:
        nodes.end()
        node.destroy_node()
        rclpy.try_shutdown()
    return errors


def wait_until_heard(node: rclpy.node.Node, nodes: LiveNodes) -> None:
    """Until the servo can hear the corrector and is heard here."""
    wanted = ("image_rect", "camera_info", "drift", "projection")
    until_s = time.monotonic() + 60.0
    while not (
        all(node.count_publishers(t) and node.count_subscribers(t) for t in wanted)
        and node.count_publishers("visual_servo/error")
    ):
        rclpy.spin_once(node, timeout_sec=0.1)
        nodes.check()
        if time.monotonic() > until_s:
            raise RuntimeError("the nodes did not find each other within a minute")
    until_s = time.monotonic() + 2.0
    while time.monotonic() < until_s:
        rclpy.spin_once(node, timeout_sec=0.1)


def compared(run: Run, errors: dict[int, np.ndarray]) -> list[dict[str, float]]:
    """By magnification: frames that were measured, and the node's error of the place against the truth."""
    rows = []
    stamps, g = np.array(stamps_of(run)), np.array(run.magnification)
    truth = dict(zip(stamps.tolist(), run.true_error, strict=True))
    for value in dict.fromkeys(run.magnification):
        here = [int(s) for s in stamps[g == value] if int(s) in errors]
        wrong = np.array([errors[s] - truth[s] for s in here]).reshape(-1, 3)
        rows.append(
            {
                "magnification": value,
                "frames": int(np.sum(g == value)),
                "measured": len(here),
                "rms_nm": 1e9 * float(np.sqrt(np.mean(np.sum(wrong[:, :2] ** 2, axis=1)))),
                "rms_mrad": 1e3 * float(np.sqrt(np.mean(wrong[:, 2] ** 2))),
            }
        )
    return rows


def replayed(
    folder: Path, run: Run, microscope: VirtualMicroscope, goal: PlanePose, rate: float
) -> list[dict[str, float]]:
    """Record a run, replay it to the nodes, print and return the comparison."""
    bag = folder / "servoed"
    record(run, microscope, bag)
    print(f"{len(run.raw)} frames: {bag}; replaying them at {rate:g} times their rate", flush=True)
    rows = compared(run, replay(folder, bag, goal, rate))
    print("              frames  measured  error of the place  of the angle")
    for row in rows:
        print(
            f"{row['magnification']:12g}x {row['frames']:6} {row['measured']:9}"
            f" {row['rms_nm']:12.1f} nm RMS {row['rms_mrad']:8.3f} mrad"
        )
    (folder / "replay.json").write_text(json.dumps(rows, indent=1))
    return rows
