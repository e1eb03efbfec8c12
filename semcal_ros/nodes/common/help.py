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

"""What the executables print when they are asked for help; the table at the top of ``doc/nodes.md``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from semcal_ros.nodes.common.parameters import DIRECTORY, ParameterDeclaration

_WIDTH = 100  # characters


@dataclass(frozen=True)
class ExecutableHelp:
    """What one executable is for.

    Attributes
    ----------
    purpose
        One sentence.
    inputs, outputs, services
        Topics and services, as the documentation lists them.
    example
        Arguments of a typical start.
    nodes
        Executables whose parameters it takes besides its own.
    """

    purpose: str
    inputs: str
    outputs: str
    services: str
    example: str
    nodes: tuple[str, ...] = ()


EXECUTABLES = {
    "stream_corrector": ExecutableHelp(
        "Removes drift and distortion from the live stream in one interpolation.",
        "image_raw, magnification, calibration, conditions",
        "image_rect, camera_info, projection_stamped, projection_covariance_stamped, drift, drift_velocity, ~/moving",
        "~/reset",
        "-p config:=jsm820 -p calibration:=cal.yaml",
    ),
    "drift_compensator": ExecutableHelp(
        "Removes drift from the live stream; needs no calibration.",
        "image_raw, magnification",
        "image_stabilized, drift, drift_velocity, ~/moving",
        "~/reset",
        "-p config:=jsm820",
    ),
    "rectifier": ExecutableHelp(
        "Removes distortion from the live stream.",
        "image_raw or image_stabilized, magnification, calibration, conditions",
        "image_rect, camera_info, projection_stamped, projection_covariance_stamped",
        "",
        "-p config:=jsm820 -p calibration:=cal.yaml",
    ),
    "parameter_server": ExecutableHelp(
        "Serves the calibration at any magnification, on topics and as parameters.",
        "magnification, calibration, conditions; image_raw with monitor_period",
        "calibration, camera_info, projection, projection_covariance, /tf_static where tf2 is installed; parameters"
        " such as `p@5250`",
        "~/reload",
        "-p config:=jsm820 -p calibration:=cal.yaml",
    ),
    "calibration_server": ExecutableHelp(
        "Collects views of the grid from the live stream, and calibrates from them.",
        "image_raw, magnification, stage, conditions",
        "calibration, ~/progress, ~/overlay",
        "~/add_view, ~/calibrate, ~/calibrate_start, ~/acquire, ~/extend, ~/cancel, ~/check, ~/update, ~/save, ~/clear",
        "-p config:=jsm820 -p output:=live.yaml",
    ),
    "virtual_sem": ExecutableHelp(
        "A simulated live microscope with a stage and a magnification knob.",
        "~/stage, ~/move_stage, ~/set_magnification",
        "image_raw, magnification, stage, conditions, ~/motion",
        "~/start, ~/stop",
        "-p specimen:=gold -p drift:=slow -p magnification:=5000.0",
    ),
    "microscope": ExecutableHelp(
        "Puts a microscope, a folder of its pictures or a frame grabber on the topics.",
        "~/set_magnification, ~/move_stage",
        "image_raw, magnification, stage, conditions, ~/motion",
        "~/start, ~/stop",
        "-p config:=jsm820 -p source:=folder -p folder:=/mnt/sem",
    ),
    "visual_servo": ExecutableHelp(
        "Brings a target to a pose in the sem frame by velocities of the stage.",
        "image_rect, camera_info, projection_stamped or projection, projection_covariance_stamped, drift,"
        " magnification",
        "velocity of the stage, ~/error",
        "~/start, ~/stop",
        "-p goal_x_m:=1e-6 -p start:=true",
    ),
    "suite": ExecutableHelp(
        "The suite in one process, with the parameters of all its nodes: source, stream_corrector, parameter_server,"
        " viewer, and consumers of others.",
        "what its nodes do; frames go from node to node in memory",
        "what its nodes do, images only where somebody subscribes",
        "those of its nodes",
        "-p config:=jsm820 -p source:=openfibsem -p consumers:=none",
        (
            "stream_corrector",
            "parameter_server",
            "microscope",
            "bag_player",
            "virtual_sem",
        ),
    ),
    "bag_player": ExecutableHelp(
        "Replays a recording on its own topics.",
        "a recording, ~/seek, ~/set_rate",
        "its topics, /clock",
        "~/pause, ~/resume, ~/toggle_paused, ~/play_next",
        "-p bag:=recording -p rate:=2.0",
    ),
}


def format_help(name: str, declarations: Sequence[ParameterDeclaration]) -> str:
    """Return the help text of an executable.

    Parameters
    ----------
    name
        Of the executable.
    declarations
        Its parameters; the last declaration of a name counts.
    """
    parameters = {declaration.name: declaration for declaration in declarations}
    if any(declaration.confined for declaration in parameters.values()):
        parameters.setdefault(DIRECTORY.name, DIRECTORY)
    about = EXECUTABLES[name]
    lines = [
        about.purpose,
        "",
        f"usage: ros2 run semcal_ros {name} [--ros-args [-p PARAMETER:=VALUE]... [-r OLD:=NEW]...]",
        "",
        f"  subscribes  {about.inputs}",
        f"  publishes   {about.outputs}, /diagnostics",
    ]
    if about.services:
        lines.append(f"  services    {about.services}")
    lines += ["", "Names are relative; the namespace is /sem unless -r __ns:=/NAME gives another."]
    lines += ["", "parameters (* only read at start):"]
    for declaration in parameters.values():
        mark = "*" if declaration.fixed else " "
        lines.append(f" {mark}{declaration.name} = {_format_default(declaration.default)}")
        text = f"{declaration.description} Accepted: {declaration.expected}."
        lines += textwrap.wrap(
            text, _WIDTH, initial_indent=8 * " ", subsequent_indent=8 * " ", break_on_hyphens=False
        )
    if about.nodes:
        lines += [
            "",
            "and the parameters of its nodes, each as for the executable of that name (--help):",
        ]
        lines.append(f"  {', '.join(about.nodes)}")
    lines += ["", f"example: ros2 run semcal_ros {name} --ros-args {about.example}"]
    return "\n".join(lines)


def _format_default(value: bool | float | str) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) if value != "" else "''"
