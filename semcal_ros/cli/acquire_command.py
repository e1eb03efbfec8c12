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
from pathlib import Path

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import (
    PATH,
    config_option,
    output_option,
    parse_magnification,
    parse_ratio,
    parse_tilts,
    refuse_with,
    require_folder,
)
from semcal_ros.config.config import load_config
from semcal_ros.core.calibration.thresholds import VIEWS_MAX
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.core.ladder.plan import plan_ladder

__all__ = ["command"]


def _parse_range(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a range such as 500,10000") from None
    return low, high


def _wait_for_enter(text: str) -> None:
    click.echo(text, nl=False)
    if not sys.stdin.readline():
        raise SemcalError("the input has ended", expected="Enter after each view")


@click.command("acquire")
@output_option("Calibration file.")
@click.option(
    "--range",
    "magnifications",
    callback=_parse_range,
    metavar="LOW,HIGH",
    help="Magnifications to calibrate by a grid.",
)
@click.option(
    "--extend",
    "extended",
    type=PATH,
    metavar="CALIBRATION",
    help="Instead: extend this calibration by a ladder of magnifications over a specimen.",
)
@click.option(
    "--to",
    "last",
    callback=parse_magnification,
    metavar="G",
    help="Magnification that --extend reaches, such as 100000x.",
)
@click.option(
    "--target",
    default="0.1%",
    show_default=True,
    callback=parse_ratio,
    metavar="RATIO",
    help="1-sigma of nm per pixel to reach, repeatability of the magnification aside.",
)
@click.option(
    "--microscope",
    default="microscope",
    show_default=True,
    help="Node that moves the microscope, such as virtual_sem.",
)
@click.option(
    "--by-hand", is_flag=True, help="Say what to set, and wait for Enter; nothing is moved."
)
@click.option(
    "--tilts",
    default="0deg,20deg,40deg",
    show_default=True,
    callback=parse_tilts,
    metavar="ANGLE,...",
    help="Tilts of each visit; a bare number is in degrees.",
)
@click.option(
    "--turn-by",
    type=click.Choice(["scan_rotation", "rotation", "nothing"]),
    default="scan_rotation",
    show_default=True,
    help="What turns the grid in the image between views, or a ladder's last picture.",
)
@click.option(
    "--most-views",
    type=click.IntRange(6, 1000),
    default=VIEWS_MAX,
    show_default=True,
    help="End after so many views, with the target met or not.",
)
@click.option(
    "--record",
    type=PATH,
    help="Recording of all pictures, a new folder. [default: named after the calibration file]",
)
@click.option("--no-record", is_flag=True, help="Record nothing; it cannot be gone on with then.")
@click.option(
    "--resume",
    type=PATH,
    help="Go on with an interrupted acquisition: take over the views of its recording.",
)
@click.option("--namespace", default="/sem", show_default=True, help="Of the nodes and topics.")
@config_option
def command(
    output: Path,
    magnifications: tuple[float, float] | None,
    extended: Path | None,
    last: float | None,
    target: float,
    microscope: str,
    by_hand: bool,
    tilts: tuple[float, ...],
    turn_by: str,
    most_views: int,
    record: Path | None,
    no_record: bool,
    resume: Path | None,
    namespace: str,
    config: str,
) -> None:
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
    if (magnifications is None) == (extended is None):
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
        refuse_with("--extend", "which looks at no grid", ("target", "tilts", "most_views"))
        # What is wrong is said before anything is started.
        plan_ladder(Calibration.load(extended), last)
    require_folder(output)
    load_config(config)
    if record is not None and no_record:
        raise InvalidValueError("--record and --no-record", expected="one of them")
    if record is not None and record.exists():
        raise InvalidValueError(f"--record {record} exists", expected="a new folder")
    if resume is not None and not resume.exists():
        raise InvalidValueError(
            f"--resume {resume} does not exist",
            expected="the recording of an interrupted acquisition",
        )
    if record is None and not no_record:
        # The node adds a number if there is one already.
        record = output.with_name(f"{output.stem}_views")
    if not namespace.startswith("/"):
        raise InvalidValueError(f"--namespace {namespace}", expected="a name that begins with /")
    try:
        from semcal_ros.nodes.acquire import run_acquisition
    except ImportError as error:
        raise SemcalError(
            f"ROS 2 cannot be imported ({error})",
            expected="rclpy for a live microscope",
            do="source a ROS 2 workspace or run `make setup`",
        ) from error
    parameters: dict[str, object] = {
        "config": config,
        "output": str(output.absolute()),
        "turn_by": turn_by,
    }
    if magnifications is not None:
        parameters |= {
            "lowest_magnification": magnifications[0],
            "highest_magnification": magnifications[1],
            "target": target,
            "tilts_deg": f"'{','.join(f'{math.degrees(tilt):.12g}' for tilt in tilts)}'",
            "most_views": most_views,
        }
    if extended is not None and last is not None:
        parameters |= {"calibration": str(extended.absolute()), "extend_to": last}
    if not by_hand:
        parameters["microscope"] = microscope
    if record is not None:
        parameters["record"] = str(record.absolute())
    if resume is not None:
        parameters["resume"] = str(resume.absolute())
    arguments = ["--ros-args", "-r", f"__ns:={namespace}", "--log-level", "error"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={value}"]
    sys.exit(run_acquisition(arguments, click.echo, _wait_for_enter))
