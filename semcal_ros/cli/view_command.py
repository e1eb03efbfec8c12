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

"""``semcal view``."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

import click

from semcal_ros.cli.options import PATH, config_option
from semcal_ros.core.errors import InvalidValueError, SemcalError

__all__ = ["command", "require_view"]

_TOKEN = "SEMCAL_VIEW_TOKEN"


def require_view() -> None:
    """Refuse, with the command that helps, where the server of the page is not installed."""
    if find_spec("tornado") is None:
        raise SemcalError(
            "the page needs the package tornado, which is not installed",
            expected="the extra `view`",
            do="run `pip install tornado`",
        )


@click.command("view")
@config_option
@click.option("--calibration", type=PATH, help="Calibration file; by default that on the topic.")
@click.option("--namespace", default="/sem", show_default=True, help="Of the nodes and topics.")
@click.option("--host", default="localhost", show_default=True, help="Address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=8060,
    show_default=True,
    help="Port to listen on; 0 takes a free one.",
)
def command(
    config: str | None, calibration: os.PathLike[str] | None, namespace: str, host: str, port: int
) -> None:
    """Show the live stream in the browser, raw and corrected, with lengths and their uncertainty.

    The page is for users of this computer. With another --host, whoever opens it must bring the token that is printed,
    or that the environment variable SEMCAL_VIEW_TOKEN holds.

    \b
    Example:
      semcal view
      semcal view --namespace /lab/sem --config jsm820
    """
    require_view()
    try:
        from semcal_ros.nodes.viewer import run_viewer
    except ImportError as error:
        raise SemcalError(
            f"ROS 2 cannot be imported ({error})",
            expected="rclpy",
            do="source a ROS 2 workspace or run `make setup`",
        ) from error
    if not namespace.startswith("/"):
        raise InvalidValueError(f"--namespace {namespace}", expected="a name that begins with /")
    parameters = {
        "config": config or "generic",
        "calibration": "" if calibration is None else os.path.abspath(calibration),
        "host": host,
        "port": str(port),
        "token": os.environ.get(_TOKEN, ""),
    }
    arguments = ["--ros-args", "-r", f"__ns:={namespace}"]
    for name, value in parameters.items():
        if value:
            arguments += ["-p", f"{name}:={value}"]
    sys.exit(run_viewer(arguments))
