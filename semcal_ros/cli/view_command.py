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
import signal
import sys
import threading
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import click

from semcal_ros.cli.options import needs_ros, options_of
from semcal_ros.cli.recording_input import optional_recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.inputs import open_source, resolve_calibration, resolve_config
from semcal_ros.workflows.options import Option

_TOKEN = "SEMCAL_VIEW_TOKEN"


def require_view() -> None:
    """Refuse, with the command that helps, where the server of the page is not installed."""
    if find_spec("tornado") is None:
        raise SemcalError(
            "the page needs the package tornado, which is not installed",
            expected="the extra `view`",
            do="run `pip install tornado`",
        )


@dataclass(frozen=True)
class ViewOptions:
    """What the page shows, and where it is served."""

    calibration: Annotated[
        Path | None,
        Option("Calibration file; of a live stream, that on the topic by default.", kind="path"),
    ] = None
    drift: Annotated[
        bool, Option("Do not follow the drift of RECORDING.", names=("--no-drift",))
    ] = True
    namespace: Annotated[str, Option("Of the nodes and topics.")] = "/sem"
    host: Annotated[str, Option("Address to listen on.")] = "localhost"
    port: Annotated[int, Option("Port to listen on; 0 takes a free one.", between=(0, 65535))] = (
        8060
    )


@click.command("view")
@optional_recording_input
@options_of(ViewOptions)
@click.pass_context
def command(
    context: click.Context,
    recording: RecordedFiles | None,
    config: MicroscopeConfig,
    options: ViewOptions,
) -> None:
    """Show the live stream, or RECORDING, in the browser: raw and corrected, with lengths and their uncertainty.

    The page is for users of this computer. With another --host, whoever opens it must bring the token that is printed,
    or that the environment variable SEMCAL_VIEW_TOKEN holds.

    \b
    Example:
      semcal view
      semcal view --namespace /lab/sem --config jsm820
      semcal view recordings/gold --calibration cal.yaml
    """
    require_view()
    token = os.environ.get(_TOKEN, "")
    calibration, host, port = options.calibration, options.host, options.port
    if recording is not None:
        _show_recording(recording, config, calibration, options.drift, host, port, token)
        return
    with needs_ros("rclpy for a live stream, or a RECORDING"):
        from semcal_ros.nodes.viewer import run_viewer
    if not options.drift:
        raise InvalidValueError("--no-drift for a live stream", expected="a RECORDING with it")
    if not options.namespace.startswith("/"):
        raise InvalidValueError(
            f"--namespace {options.namespace}", expected="a name that begins with /"
        )
    parameters = {
        # The node reads it by its name.
        "config": context.params["config"],
        "calibration": "" if calibration is None else str(calibration.absolute()),
        "host": host,
        "port": str(port),
        "token": token,
    }
    arguments = ["--ros-args", "-r", f"__ns:={options.namespace}"]
    for name, value in parameters.items():
        if value:
            arguments += ["-p", f"{name}:={value}"]
    sys.exit(run_viewer(arguments))


def _show_recording(
    recording: RecordedFiles,
    config: MicroscopeConfig,
    calibration: Path | None,
    drift: bool,
    host: str,
    port: int,
    token: str,
) -> None:
    from semcal_ros.viewer.recording import RecordingSource
    from semcal_ros.viewer.server import PageServer

    model = resolve_calibration(calibration)
    microscope = resolve_config(config, model)
    ended = threading.Event()

    def end(_number: int, _frame: Any) -> None:
        ended.set()

    source = RecordingSource(
        lambda: open_source(recording, microscope, model), model, microscope, drift=drift
    )
    try:
        server = PageServer(source, host, port, token)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        server.start()
        click.echo(f"{source.name}: open {server.address}")
        # A wait without end does not let Python handle signals on every platform.
        while not ended.wait(0.5):
            pass
        server.stop()
    finally:
        source.close()
