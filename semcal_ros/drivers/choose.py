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

"""The sources by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import ConfigError
from semcal_ros.drivers.folder import FolderSource, default_journal
from semcal_ros.drivers.openfibsem import OpenFibsemSource, require_fibsem
from semcal_ros.drivers.source import FrameSource
from semcal_ros.drivers.video import SideFile, VideoSource


class Settings(Protocol):
    """Values of the parameters of the node, by name."""

    def __getitem__(self, name: str) -> Any: ...


def _make_folder(config: MicroscopeConfig, settings: Settings) -> FrameSource:
    if not settings["folder"]:
        raise ConfigError(
            "no folder", expected="the parameter folder", do="give --ros-args -p folder:=PATH"
        )
    folder = Path(settings["folder"]).expanduser().absolute()
    journal = settings["journal"]
    return FolderSource(
        folder,
        Path(journal).expanduser().absolute() if journal else default_journal(folder),
        pattern=settings["pattern"],
        settle_s=settings["settle"],
        poll_s=settings["poll"],
        give_up_s=settings["give_up"],
        backlog=settings["backlog"],
        stamps=settings["stamps"],
        field_width_m=lambda: float(settings["field_width_m"]),
        keep_databar=config.image.databar_rows is not None,
    )


def _make_openfibsem(_config: MicroscopeConfig, settings: Settings) -> FrameSource:
    require_fibsem()
    manufacturer, configuration = settings["manufacturer"], settings["fibsem_config"]
    return OpenFibsemSource(
        "" if manufacturer == "configured" else manufacturer,
        settings["ip_address"],
        Path(configuration).expanduser().absolute() if configuration else None,
        settings["beam"],
    )


def _make_video(config: MicroscopeConfig, settings: Settings) -> FrameSource:
    if not settings["video"]:
        raise ConfigError(
            "no video",
            expected="the parameter video",
            do="give --ros-args -p video:=/dev/video0, an address or a file",
        )
    file = settings["magnification_file"]
    side = SideFile(Path(file).expanduser(), config.display_width_m) if file else None

    def field_width_m() -> float | None:
        stated_m = None if side is None else side.field_width_m()
        return stated_m or settings["field_width_m"] or None

    return VideoSource(settings["video"], field_width_m, form=settings["video_format"])


SOURCES: Mapping[str, Callable[[MicroscopeConfig, Settings], FrameSource]] = {
    "folder": _make_folder,
    "openfibsem": _make_openfibsem,
    "video": _make_video,
}
"""What makes each source from the configuration and the parameters of the node."""


def make_source(name: str, config: MicroscopeConfig, settings: Settings) -> FrameSource:
    """Return a source; it is not opened yet.

    Raises
    ------
    ConfigError
        A parameter that it needs is missing, or a package.
    """
    return SOURCES[name](config, settings)
