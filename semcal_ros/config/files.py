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

"""Where ``msg_configs`` files lie, in the source tree or under ``share`` of an installation, and how they are read."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLWarning
from ruamel.yaml.events import AliasEvent

from semcal_ros.core.errors import ConfigError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.text_files import CONSTRUCTOR_ERRORS, read_text_file

_SUFFIXES = (".yaml", ".yml")
_MAX_BYTES = 1024 * 1024  # the commented template has 3 kB; this only keeps other files out
_MAX_REASON = 80  # a longer one would not fit on a line beside the name of the file
# A configuration is nested 3 deep. Without a limit 3000 brackets keep the parser busy for seconds.
_MAX_DEPTH = 16


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


class _PlainComposer(Composer):
    """Refuses aliases, with which a short text stands for exponentially much, and deep nesting."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.parser.peek_event()
        if isinstance(event, AliasEvent):
            raise ComposerError(None, None, "an alias is used", event.start_mark)
        if self._depth == _MAX_DEPTH:
            what = f"nested more than {_MAX_DEPTH} deep"
            raise ComposerError(None, None, what, event.start_mark)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


def load_yaml(text: str, source: str) -> Any:
    """Values of a YAML 1.2 text, in which ``25e-6`` is a number and a key stands once.

    Raises
    ------
    ConfigError
        The text is not valid YAML, repeats a key or has an alias. The message names ``source`` and
        the line.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _PlainComposer
    try:
        with warnings.catch_warnings():
            # A file may say `%YAML 1.1`, and then be warned about 25e-6.
            warnings.simplefilter("ignore", YAMLWarning)
            return yaml.load(text)
    except MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f" in line {error.problem_mark.line + 1}"
        reason = " ".join((error.problem or "not valid YAML").split())[:_MAX_REASON]
        seen = f"{source}: {reason}{line}"
    except (YAMLError, *CONSTRUCTOR_ERRORS) as error:
        seen = f"{source}: {type(error).__name__} while reading YAML"
    raise ConfigError(seen, expected="a YAML file", do="compare with msg_configs/generic.yaml")
