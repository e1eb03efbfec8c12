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
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.cli.options import config_option, needs_ros, options_of
from semcal_ros.workflows.options import Option


@dataclass(frozen=True)
class PlayOptions:
    """How a recording is replayed."""

    rate: Annotated[float, Option("How many times as fast.", kind="factor")] = 1.0
    loop: Annotated[bool, Option("Start again at the end.")] = False
    paused: Annotated[bool, Option("Start paused; a call of ~/pause goes on.")] = False
    wait: Annotated[
        int,
        Option(
            "Wait until images and magnification have this many subscribers each.", between=(0, 100)
        ),
    ] = 0
    clock: Annotated[bool, Option("Do not publish /clock.", names=("--no-clock",))] = True
    topics: Annotated[
        str,
        Option(
            "What is played. inputs: images, magnification and stage by the configuration, and conditions; all: also"
            " what nodes published while it was recorded.",
            metavar="inputs|all|NAME,...",
        ),
    ] = "inputs"
    exclude: Annotated[str | None, Option("Topics that are not played.", metavar="NAME,...")] = None


@click.command("play")
@click.argument("recording", type=click.Path(path_type=Path))
@options_of(PlayOptions)
@config_option
def command(recording: Path, options: PlayOptions, config: str) -> None:
    """Replay RECORDING as ROS topics, as `ros2 run semcal_ros bag_player` does.

    \b
    Example:
      semcal play recordings/zoom --rate 2
      semcal play recordings/session --topics all --exclude calibration
    """
    _require_bag(recording)
    with needs_ros():
        from semcal_ros.nodes.bag_player import main as play
    parameters: dict[str, bool | int | float | str] = {
        "bag": str(recording.absolute()),
        "rate": options.rate,
        "loop": options.loop,
        "start_paused": options.paused,
        "wait_for_subscribers": options.wait,
        "clock": options.clock,
        "topics": options.topics,
        "exclude": options.exclude or "",
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
