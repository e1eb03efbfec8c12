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

"""Plain values from the YAML text of a configuration."""

from __future__ import annotations

import warnings
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLWarning
from ruamel.yaml.events import AliasEvent

from semcal_ros.core.errors import ConfigError
from semcal_ros.text_files import CONSTRUCTOR_ERRORS

__all__ = ["load_yaml"]

_MAX_REASON = 80  # a longer one would not fit on a line beside the name of the file
# A configuration is nested 3 deep. Without a limit 3000 brackets keep the parser busy for seconds.
_MAX_DEPTH = 16


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
