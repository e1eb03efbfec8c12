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

"""``semcal play``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from semcal_ros.cli.options import config_option
from semcal_ros.core.errors import SemcalError


@click.command("play")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option(
    "--rate", type=click.FloatRange(min=0.0, min_open=True), default=1.0, show_default=True
)
@click.option("--loop", is_flag=True, help="Start again at the end.")
@click.option("--paused", is_flag=True, help="Start paused; a call of ~/pause goes on.")
@click.option(
    "--wait",
    type=click.IntRange(0, 100),
    default=0,
    show_default=True,
    help="Wait until images and magnification have this many subscribers each.",
)
@click.option("--no-clock", is_flag=True, help="Do not publish /clock.")
@click.option(
    "--topics",
    default="inputs",
    show_default=True,
    metavar="inputs|all|NAME,...",
    help="What is played. inputs: images, magnification and stage by the configuration, and conditions; all: also what"
    " nodes published while it was recorded.",
)
@click.option("--exclude", default="", metavar="NAME,...", help="Topics that are not played.")
@config_option
def command(
    recording: Path,
    rate: float,
    loop: bool,
    paused: bool,
    wait: int,
    no_clock: bool,
    topics: str,
    exclude: str,
    config: str,
) -> None:
    """Replay RECORDING as ROS topics, as `ros2 run semcal_ros bag_player` does.

    \b
    Example:
      semcal play recordings/zoom --rate 2
      semcal play recordings/session --topics all --exclude calibration
    """
    _require_bag(recording)
    try:
        from semcal_ros.nodes.bag_player import main as play
    except ImportError as error:
        raise SemcalError(
            f"ROS 2 cannot be imported ({error})",
            expected="rclpy",
            do="source a ROS 2 workspace or run `make setup`",
        ) from error
    parameters: dict[str, bool | int | float | str] = {
        "bag": str(recording.absolute()),
        "rate": rate,
        "loop": loop,
        "start_paused": paused,
        "wait_for_subscribers": wait,
        "clock": not no_clock,
        "topics": topics,
        "exclude": exclude,
        "config": config,
    }
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        # ROS reads a value as YAML, which holds JSON: a name such as 2024 stays a text in its quotes.
        arguments += ["-p", f"{name}:={json.dumps(value, ensure_ascii=False)}"]
    sys.exit(play(arguments) or 0)


def _require_bag(recording: Path) -> None:
    """Refuse what cannot be played, before ROS is loaded.

    Raises
    ------
    BagError
        It is no bag, or a damaged one.
    """
    # Imported here, as ROS below: the help need not wait for the library of bags.
    from semcal_ros.files.bags.reader import open_bag
    from semcal_ros.files.images.image_series import refuse_images

    refuse_images(recording)
    with open_bag(recording):
        pass
