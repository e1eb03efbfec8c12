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

"""``semcal acquire``."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import config_option, needs_ros, options_of, refuse_with, require_folder
from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.core.calibration.acquisition import AcquisitionGoal
from semcal_ros.core.calibration.thresholds import VIEWS_MAX
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.core.ladder.acquisition import plan_ladder
from semcal_ros.workflows.options import Option


def _wait_for_enter(text: str) -> None:
    click.echo(text, nl=False)
    if not sys.stdin.readline():
        raise SemcalError("the input has ended", expected="Enter after each view")


@dataclass(frozen=True)
class AcquisitionOptions:
    """What is to be reached, by what, and what is kept of it."""

    output: Annotated[
        Path, Option("Calibration file.", kind="path", names=("-o", "--output"), required=True)
    ]
    magnifications: Annotated[
        tuple[float, float] | None,
        Option("Magnifications to calibrate by a grid.", kind="range", names=("--range",)),
    ] = None
    extended: Annotated[
        Path | None,
        Option(
            "Instead: extend this calibration by a ladder of magnifications over a specimen.",
            kind="path",
            names=("--extend",),
            metavar="CALIBRATION",
        ),
    ] = None
    last: Annotated[
        float | None,
        Option(
            "Magnification that --extend reaches, such as 100000x.",
            kind="magnification",
            names=("--to",),
        ),
    ] = None
    target: Annotated[
        float,
        Option(
            "1-sigma of nm per pixel to reach, repeatability of the magnification aside.",
            kind="ratio",
        ),
    ] = 1e-3
    microscope: Annotated[
        str, Option("Node that moves the microscope, such as virtual_sem.", metavar="TEXT")
    ] = "microscope"
    by_hand: Annotated[bool, Option("Say what to set, and wait for Enter; nothing is moved.")] = (
        False
    )
    tilts: Annotated[
        tuple[float, ...],
        Option("Tilts of each visit; a bare number is in degrees.", kind="tilts"),
    ] = (0.0, math.radians(20.0), math.radians(40.0))
    turn_by: Annotated[
        str,
        Option(
            "What turns the grid in the image between views, or a ladder's last picture.",
            choices=("scan_rotation", "rotation", "nothing"),
        ),
    ] = "scan_rotation"
    most_views: Annotated[
        int, Option("End after so many views, with the target met or not.", between=(6, 1000))
    ] = VIEWS_MAX
    record: Annotated[
        Path | None,
        Option(
            "Recording of all pictures, a new folder. [default: named after the calibration file]",
            kind="path",
        ),
    ] = None
    no_record: Annotated[bool, Option("Record nothing; it cannot be gone on with then.")] = False
    resume: Annotated[
        Path | None,
        Option(
            "Go on with an interrupted acquisition: take over the views of its recording.",
            kind="path",
        ),
    ] = None
    namespace: Annotated[str, Option("Of the nodes and topics.")] = "/sem"

    def check(self) -> None:
        """Refuse options that contradict each other; raises :class:`InvalidValueError`."""
        extended, last, record, resume = self.extended, self.last, self.record, self.resume
        if (self.magnifications is None) == (extended is None):
            raise InvalidValueError(
                "neither --range nor --extend" if extended is None else "--range and --extend",
                expected="one of the two",
            )
        if (extended is None) != (last is None):
            raise InvalidValueError(
                "--to without --extend" if extended is None else "--extend without --to",
                expected="both, such as --extend cal.yaml --to 100000x",
            )
        if extended is not None and last is not None:
            refuse_with(
                "--extend", "which looks at no grid", ("--target", "--tilts", "--most-views")
            )
            # What is wrong is said before anything is started.
            plan_ladder(Calibration.load(extended), last)
        require_folder(self.output)
        if record is not None and self.no_record:
            raise InvalidValueError("--record and --no-record", expected="one of them")
        if record is not None and record.exists():
            raise InvalidValueError(f"--record {record} exists", expected="a new folder")
        if resume is not None and not resume.exists():
            raise InvalidValueError(
                f"--resume {resume} does not exist",
                expected="the recording of an interrupted acquisition",
            )
        if not (self.microscope or self.by_hand):
            raise InvalidValueError(
                "--microscope without a name",
                expected="the name of a node, such as virtual_sem",
                do="take --by-hand to set the microscope yourself",
            )
        if not self.namespace.startswith("/"):
            raise InvalidValueError(
                f"--namespace {self.namespace}", expected="a name that begins with /"
            )

    def check_goal(self, config: MicroscopeConfig) -> None:
        """Refuse what the node would refuse once it has a picture; raises :class:`InvalidValueError`."""
        if self.magnifications is None:
            return
        AcquisitionGoal(
            self.magnifications,
            config.squares_m,
            config.display_width_m,
            self.target,
            self.tilts,
            self.most_views,
        )

    def node_parameters(self, config: str) -> dict[str, object]:
        """Return the parameters of the node ``calibration_server`` that say the same."""
        parameters: dict[str, object] = {
            "config": config,
            "output": str(self.output.absolute()),
            "turn_by": self.turn_by,
        }
        if self.magnifications is not None:
            parameters |= {
                "lowest_magnification": self.magnifications[0],
                "highest_magnification": self.magnifications[1],
                "target": self.target,
                "tilts_deg": f"'{','.join(f'{math.degrees(tilt):.12g}' for tilt in self.tilts)}'",
                "most_views": self.most_views,
            }
        if self.extended is not None and self.last is not None:
            parameters |= {"calibration": str(self.extended.absolute()), "extend_to": self.last}
        if not self.by_hand:
            parameters["microscope"] = self.microscope
        # The node adds a number if there is one already.
        record = self.record or self.output.with_name(f"{self.output.stem}_views")
        if not self.no_record:
            parameters["record"] = str(record.absolute())
        if self.resume is not None:
            parameters["resume"] = str(self.resume.absolute())
        return parameters


@click.command("acquire")
@options_of(AcquisitionOptions)
@config_option
def command(options: AcquisitionOptions, config: str) -> None:
    """Calibrate a live microscope unattended: move it, take views of the grid, until nm per pixel is certain enough.

    Or extend a calibration: move over a flat, textured specimen, from inside the calibrated range to --to.

    The nodes of the microscope must run, with grid or specimen in view and in focus, and moving allowed. Exit status 1
    if the target was not met; what was calibrated is written all the same. All pictures are recorded, so that --resume
    can go on after Ctrl-C, and `semcal calibrate` or `semcal extend` can use them again.

    \b
    Example:
      semcal acquire -o cal.yaml --range 500,10000 --microscope virtual_sem --config virtual_sem
      semcal acquire -o cal.yaml --range 500,10000 --microscope virtual_sem --config virtual_sem --resume cal_views
      semcal acquire -o cal.yaml --range 500,10000 --by-hand
      semcal acquire -o cal_20kx.yaml --extend cal.yaml --to 20000x --microscope virtual_sem --config virtual_sem
    """
    options.check()
    options.check_goal(load_config(config))
    with needs_ros("rclpy for a live microscope"):
        from semcal_ros.nodes.acquire import run_acquisition
    arguments = ["--ros-args", "-r", f"__ns:={options.namespace}", "--log-level", "error"]
    for name, value in options.node_parameters(config).items():
        arguments += ["-p", f"{name}:={value}"]
    sys.exit(run_acquisition(arguments, click.echo, _wait_for_enter))
