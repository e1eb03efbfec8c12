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

"""YAML that other programs may have written or damaged, read by libyaml.

Configurations are read by ruamel.yaml. A calibration file is mostly numbers, for which ruamel.yaml takes
12 times as long: 0.18 s against 0.015 s for a file of 30 kB, and 2.2 s against 0.15 s for 153 kB.
"""

from __future__ import annotations

from typing import Any

import yaml

from semcal_ros.core.errors import CalibrationFileError
from semcal_ros.text_files import CONSTRUCTOR_ERRORS

# Calibration files are nested up to 6 deep; 200 000 brackets end the process.
_MAX_DEPTH = 32
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_OPENING = (yaml.SequenceStartEvent, yaml.MappingStartEvent)
_CLOSING = (yaml.SequenceEndEvent, yaml.MappingEndEvent)


def load_plain_yaml(text: str, source: str) -> Any:
    """Load the values of a text that :func:`check_plain_yaml` accepts.

    Raises
    ------
    CalibrationFileError
        As :func:`check_plain_yaml`, or a value does not fit its tag.
    """
    check_plain_yaml(text, source)
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, *CONSTRUCTOR_ERRORS) as error:
        raise _invalid(source, error) from error


def check_plain_yaml(text: str, source: str) -> None:
    """Refuse what a calibration never has and what a safe loader does not survive.

    libyaml's composer is recursive, so that some hundred thousand brackets overrun the stack and end
    the process. Nodes that refer to each other or to themselves grow exponentially when they are
    written again.

    Raises
    ------
    CalibrationFileError
        The text is nested more than 32 deep, has anchors or aliases, or is not valid YAML.
    """
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_Loader):
            depth += isinstance(event, _OPENING) - isinstance(event, _CLOSING)
            if depth > _MAX_DEPTH:
                what = f"nested more than {_MAX_DEPTH} deep"
            elif getattr(event, "anchor", None) is not None:
                what = "an anchor or alias"
            else:
                continue
            raise CalibrationFileError(
                f"{source}: {what}{_format_line(event.start_mark)}",
                expected="a calibration written by semcal",
            )
    except (yaml.YAMLError, *CONSTRUCTOR_ERRORS) as error:
        raise _invalid(source, error) from error


def _invalid(source: str, error: Exception) -> CalibrationFileError:
    return CalibrationFileError(
        f"{source}: not valid YAML{_format_line(getattr(error, 'problem_mark', None))}",
        expected="a complete calibration file",
        do="restore the file or calibrate again",
    )


def _format_line(mark: Any) -> str:
    return "" if mark is None else f" at line {mark.line + 1}"
