"""YAML that only looks harmless: a look at its structure before it is made into objects."""

from __future__ import annotations

from typing import Any

import yaml

from semcal_ros.core.errors import CalibrationFileError

__all__ = ["check_plain_yaml"]

_MAX_DEPTH = 32
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_OPENING = (yaml.SequenceStartEvent, yaml.MappingStartEvent)
_CLOSING = (yaml.SequenceEndEvent, yaml.MappingEndEvent)


def _where(mark: Any) -> str:
    return "" if mark is None else f" at line {mark.line + 1}"


def check_plain_yaml(text: str, source: str) -> None:
    """Refuse what a calibration never has and what a safe loader does not survive.

    libyaml's composer calls itself for every level, so that some hundred thousand brackets overrun the stack and end
    the process; and nodes that refer to each other or to themselves become exponentially many when they are written
    again.

    Raises
    ------
    CalibrationFileError
        The text is nested more than 32 deep, has anchors or aliases, or is no YAML.
    """
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, _OPENING):
                depth += 1
            elif isinstance(event, _CLOSING):
                depth -= 1
            if depth > _MAX_DEPTH or getattr(event, "anchor", None) is not None:
                what = (
                    f"nested more than {_MAX_DEPTH} deep"
                    if depth > _MAX_DEPTH
                    else "an anchor or alias"
                )
                raise CalibrationFileError(
                    f"{source}: {what}{_where(event.start_mark)}",
                    expected="a calibration written by semcal",
                )
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise CalibrationFileError(
            f"{source}: not valid YAML{_where(getattr(error, 'problem_mark', None))}",
            expected="a complete calibration file",
            do="restore the file or calibrate again",
        ) from error
