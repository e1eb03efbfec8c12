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

"""``semcal demo``."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.cli.options import needs_ros, options_of
from semcal_ros.cli.output import show_progress
from semcal_ros.cli.view_command import require_view
from semcal_ros.workflows.options import Option

# Views of the grid for the calibration: some seconds of work, good to a few tenths of a per cent.
_MAGNIFICATIONS = (1500.0, 2200.0, 3200.0, 4700.0, 6800.0, 9000.0)
_VIEWS, _VIEW_SIZE = 4, 320


@dataclass(frozen=True)
class DemoOptions:
    """Where and how the virtual microscope is shown."""

    port: Annotated[int, Option("Port of the page; 0 takes a free one.", between=(0, 65535))] = 8060
    size: Annotated[int, Option("Width and height of the images, px.", between=(64, 4096))] = 512
    duration_s: Annotated[
        float | None, Option("End by itself after this time, such as 60s.", kind="time")
    ] = None
    browser: Annotated[bool, Option("Also open the page in the browser of this computer.")] = False


@click.command("demo")
@options_of(DemoOptions)
def command(options: DemoOptions) -> None:
    """Show a virtual microscope in the browser, raw and corrected: no instrument, no files.

    It calibrates the virtual microscope from simulated pictures of the grid, starts virtual_sem, parameter_server and
    stream_corrector, and turns the magnification up and down.

    \b
    Example:
      semcal demo
    """
    require_view()
    with needs_ros():
        from semcal_ros.nodes.demo import run_demo
    from semcal_ros.viewer.server import refuse_taken_port
    from semcal_ros.workflows.calibrate import CalibrateOptions, calibrate_recording
    from semcal_ros.workflows.simulate import simulate

    refuse_taken_port(options.port)
    with tempfile.TemporaryDirectory(prefix="semcal-demo-") as folder:
        bag, file = Path(folder) / "grid", Path(folder) / "calibration.yaml"
        with show_progress() as on_progress:
            simulate(
                bag,
                magnifications=_MAGNIFICATIONS,
                views=_VIEWS,
                size=_VIEW_SIZE,
                on_progress=on_progress,
            )
            done = calibrate_recording(
                bag, CalibrateOptions(config="virtual_sem", on_progress=on_progress)
            )
        done.calibration.save(file)

        def say(address: str, about: str) -> None:
            click.echo(f"open {address} ({about})")
            if options.browser:
                webbrowser.open(address)

        status = run_demo(
            file,
            port=options.port,
            size=options.size,
            duration_s=options.duration_s or 0.0,
            say=say,
        )
    sys.exit(status)
