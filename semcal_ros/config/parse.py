"""YAML text to a mapping that satisfies the schema."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator
from typing import Any, cast

import jsonschema
import yaml

from semcal_ros.config.schema import CONFIG_SCHEMA
from semcal_ros.core.errors import ConfigError

__all__ = ["parse_mapping"]

_MAX_SEEN = 80
_MAX_KEY = 100
# A value that its tag does not fit, such as ``!!bool maybe``, surfaces as any of these.
_YAML_ERRORS = (
    yaml.YAMLError,
    ValueError,
    LookupError,
    AttributeError,
    OverflowError,
    RecursionError,
)
# Above every limit of the schema; integers of YAML may have any length, which NumPy and printing do not take.
_MAX_NUMBER = 1e15


class _Loader(yaml.SafeLoader):
    """Safe loader that reads ``25e-6`` as a number, as YAML 1.2 does, and refuses repeated keys.

    Aliases are refused too: with them, a short text stands for exponentially much.
    """

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = cast("Any", self).peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, "an alias is used", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        # A tag such as ``!!set`` may stand before a list; the base class refuses it.
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        for key_node, _ in pairs:
            key = str(key_node.value)
            if len(key) > _MAX_KEY:
                raise yaml.constructor.ConstructorError(
                    None, None, f"a key has {len(key)} characters", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


def parse_mapping(text: str, source: str) -> dict[str, Any]:
    """Values of a configuration, checked against the schema.

    Raises
    ------
    ConfigError
        The text is no YAML or breaks the schema. The message names ``source``, the path of the key,
        what was seen there and what was expected.
    """
    values = _load_yaml(text, source)
    for path, number in _numbers(values):
        if not -_MAX_NUMBER <= number <= _MAX_NUMBER:
            raise ConfigError(
                f"{source}: a number at key {path} that is infinite, none or enormous",
                expected=f"a number below {_MAX_NUMBER:g}",
            )
    validator = jsonschema.Draft202012Validator(CONFIG_SCHEMA)
    problems = sorted(validator.iter_errors(values), key=_problem_order)
    if problems:
        raise _config_error(problems[0], source)
    checked: dict[str, Any] = values
    return checked


def _load_yaml(text: str, source: str) -> Any:
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f" in line {mark.line + 1}" if mark is not None else ""
        seen = f"{source}: {(error.problem or 'no YAML')[:_MAX_SEEN]}{line}"
    except _YAML_ERRORS as error:
        seen = f"{source}: {type(error).__name__} while reading YAML"
    raise ConfigError(seen, expected="a YAML file", do="compare with msg_configs/generic.yaml")


def _problem_order(error: jsonschema.ValidationError) -> tuple[int, str]:
    # A misspelt key causes a missing one as well; name the misspelt one.
    return (0 if error.validator == "additionalProperties" else 1, _key_path(error))


def _key_path(error: jsonschema.ValidationError) -> str:
    return _join(error.absolute_path)


def _join(parts: Any) -> str:
    path = ""
    for part in parts:
        path += f"[{part}]" if isinstance(part, int) else f".{part}"
    return path.lstrip(".")


def _config_error(error: jsonschema.ValidationError, source: str) -> ConfigError:
    path = _key_path(error)
    schema = cast("dict[str, Any]", error.schema)
    do = "compare with msg_configs/generic.yaml"
    if error.validator == "additionalProperties":
        known = list(schema["properties"])
        unknown = next(key for key in cast("dict[Any, Any]", error.instance) if key not in known)
        full = f"{path}.{unknown}" if path else str(unknown)
        return ConfigError(
            f"{source}: unknown key {full}", expected="one of " + ", ".join(known), do=do
        )
    if error.validator == "required":
        present = cast("dict[Any, Any]", error.instance)
        missing = next(key for key in schema["required"] if key not in present)
        full = f"{path}.{missing}" if path else missing
        what = schema["properties"][missing]["description"]
        return ConfigError(f"{source}: key {full} is missing", expected=what, do=do)
    seen = repr(error.instance)
    if len(seen) > _MAX_SEEN:
        seen = seen[:_MAX_SEEN] + "..."
    where = f"key {path}" if path else "the whole file"
    return ConfigError(f"{source}: {where} is {seen}", expected=schema["description"], do=do)


def _numbers(values: Any, path: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _numbers(value, f"{path}.{key}".lstrip("."))
    elif isinstance(values, list):
        for index, value in enumerate(values):
            yield from _numbers(value, f"{path}[{index}]")
    elif isinstance(values, (int, float)):
        yield path, values
