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

"""Where ``msg_configs`` files lie: in the source tree or under ``share`` of an installation."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from semcal_ros.core.errors import ConfigError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.text_files import read_text_file

__all__ = ["config_directories", "config_names", "find_config_file", "read_config_text"]

_SUFFIXES = (".yaml", ".yml")
_MAX_BYTES = 1024 * 1024  # the commented template has 3 kB; this only keeps other files out


def config_directories() -> tuple[Path, ...]:
    """Existing folders with configurations, the most specific first.

    The folder beside the package (a source tree), the one inside the package,
    ``share/semcal_ros/msg_configs`` under each prefix of the ament index, and the same under the
    Python environment's prefix.
    """
    return tuple(dict.fromkeys(place for place in _list_candidates() if place.is_dir()))


def _list_candidates() -> Iterator[Path]:
    package = Path(__file__).resolve().parents[1]
    yield package.parent / "msg_configs"
    yield package / "msg_configs"
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for prefix in [*filter(None, prefixes), sys.prefix]:
        yield Path(prefix) / "share" / "semcal_ros" / "msg_configs"


def config_names() -> tuple[str, ...]:
    """Bare names of all configurations that are found, sorted."""
    names = {
        path.stem
        for place in config_directories()
        for path in place.iterdir()
        if path.suffix in _SUFFIXES and path.is_file()
    }
    return tuple(sorted(names))


def find_config_file(name_or_path: str | Path) -> Path:
    """Path of a configuration given by path or by bare name.

    Raises
    ------
    ConfigError
        There is no such configuration.
    """
    text = str(name_or_path)
    path = _find_existing_file(Path(text))
    if path is None and text == Path(text).name:
        path = _find_shipped_file(Path(text))
    if path is not None:
        return path
    raise ConfigError(
        f"no configuration {text[:200]!r}",
        expected="the path of a YAML file or one of the names " + ", ".join(config_names()),
        do=did_you_mean(text[:200], config_names())
        or "check the spelling or copy msg_configs/generic.yaml",
    )


def _find_shipped_file(name: Path) -> Path | None:
    stem = name.stem if name.suffix in _SUFFIXES else name.name
    candidates = (
        _find_existing_file(place / f"{stem}{suffix}")
        for place in config_directories()
        for suffix in _SUFFIXES
    )
    return next(filter(None, candidates), None)


def _find_existing_file(path: Path) -> Path | None:
    try:
        expanded = path.expanduser()
        return expanded if expanded.is_file() else None
    except (OSError, RuntimeError, ValueError):
        # A name that is too long, an unreadable folder or an unknown home: no such file for us.
        return None


def read_config_text(path: Path) -> str:
    """Text of a configuration file; raises :class:`ConfigError` where it cannot be read."""
    return read_text_file(path, _MAX_BYTES, error=ConfigError, expected="a readable YAML file")
