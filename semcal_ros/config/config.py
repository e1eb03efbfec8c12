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

"""``msg_configs`` files: how one microscope's own topics, fields and units map onto the suite; and where they lie.

The classes below are the one declaration of such a file: its keys, defaults and limits. pydantic
checks a file against them, and the ``description`` of a field is what an error names as expected.
``msg_configs/generic.yaml`` and ``doc/msg_configs.md`` explain every key; tests compare them.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from functools import lru_cache, wraps
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    TypeAdapter,
    ValidationError,
)
from pydantic.dataclasses import dataclass
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError
from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLWarning
from ruamel.yaml.events import AliasEvent

from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import ConfigError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.text_files import CONSTRUCTOR_ERRORS, read_text_file

IMAGE_TYPE: Final = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE_TYPE: Final = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE_TYPE, COMPRESSED_IMAGE_TYPE)
"""Message types in which frames are accepted."""

STAGE_TYPE: Final = "sensor_msgs/msg/JointState"
"""Message type in which the positions of the stage are accepted."""

Quantity = Literal["magnification", "pixel_size", "field_width"]
StampMoment = Literal["start", "centre", "end"]

_METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12}
_MAX_SEEN = 80  # characters of a wrong value in an error, which is one line

_SUFFIXES = (".yaml", ".yml")
_MAX_BYTES = 1024 * 1024  # the commented template has 3 kB; this only keeps other files out
_MAX_REASON = 80  # a longer one would not fit on a line beside the name of the file
# A configuration is nested 3 deep. Without a limit 3000 brackets keep the parser busy for seconds.
_MAX_DEPTH = 16


def _read_whole(value: Any) -> Any:
    # JSON Schema counts 4.0 as an integer, and so do people.
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _read_auto(value: Any) -> Any:
    return None if value == "auto" else value


def _read_unit(value: Any) -> Any:
    # YAML reads the unit 1 as a number; True equals 1 too.
    return "1" if isinstance(value, (int, float)) and value == 1 and value is not True else value


def _check_rectangle(part: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    left, top, right, bottom = part
    if not (left < right and top < bottom):
        raise ValueError("not a rectangle")
    return part


def _sort_largest_first(sizes: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(sorted(sizes, reverse=True))


# `strict`: no text for a number and no bool for an integer.
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]


_Whole = BeforeValidator(_read_whole)


# 255 characters are the longest name that DDS takes.
_Name = Annotated[str, Field(strict=True, min_length=1, max_length=255)]


_Topic = Annotated[
    _Name, Field(pattern=r"^(~/|/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")
]


_Type = Annotated[_Name, Field(pattern=r"^[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*$")]


_FieldPath = Annotated[
    _Name,
    Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\[[0-9]+\])?(\.[A-Za-z_][A-Za-z0-9_]*(\[[0-9]+\])?)*$"),
]


_Frame = Annotated[_Name, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_/-]*$")]


# Upper limits of lengths and times only catch a wrong unit: nothing real comes near them.
_DisplayWidth = Annotated[_Number, Field(gt=0.0, le=100.0)]


_SquareSize = Annotated[_Number, Field(gt=0.0, le=1.0)]


# A stage that is known to no better than half a radian or ten millimetres is not known at all.
_AngleSigma = Annotated[_Number, Field(gt=0.0, le=0.5)]


_LengthSigma = Annotated[_Number, Field(gt=0.0, le=0.01)]


# Of a side of a picture.
_Part = Annotated[_Number, Field(ge=0.0, le=1.0)]


_FILE = ConfigDict(extra="forbid")


_TOPIC = "a ROS topic name such as image_raw"


_JOINT = "the name of a joint such as tilt"


Declared = TypeVar("Declared")


def _refuse_in_one_line(declared: type[Declared]) -> type[Declared]:
    """Let the constructor raise :class:`ConfigError`, as for a file, instead of pydantic's error."""
    validate = declared.__init__

    @wraps(validate)
    def construct(self: Declared, *args: Any, **kwargs: Any) -> None:
        try:
            validate(self, *args, **kwargs)
        except ValidationError as error:
            raise _explain(error, declared) from error

    declared.__init__ = construct  # type: ignore[assignment,method-assign]
    return declared


@_refuse_in_one_line
@dataclass(frozen=True, config=_FILE)
class ImageConfig:
    """The image stream.

    Parameters
    ----------
    topic, type
        Where the frames arrive, and one of :data:`IMAGE_TYPES`; a relative topic is resolved in the
        node's namespace. The topic of compressed images is given in full, such as
        ``image_raw/compressed``.
    stamp
        The moment of the acquisition that the header stamp means.
    databar_rows
        Rows at the bottom that show text instead of the specimen; None, or ``auto`` in a file, to find them.
    """

    topic: _Topic = Field(default="image_raw", description=_TOPIC)
    type: Literal["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"] = Field(
        default=IMAGE_TYPE, description=" or ".join(IMAGE_TYPES)
    )
    stamp: StampMoment = Field(
        default="start",
        description="start, centre or end, the moment of the acquisition that is stamped",
    )
    databar_rows: Annotated[
        Annotated[int, Field(strict=True, ge=0, le=100_000), _Whole] | None,
        BeforeValidator(
            _read_auto,
            json_schema_input_type=Annotated[int, Field(ge=0, le=100_000)] | Literal["auto"],
        ),
    ] = Field(default=None, description="auto, or the number of rows of the data bar, 0 to 100000")


@_refuse_in_one_line
@dataclass(frozen=True, config=_FILE)
class MagnificationConfig:
    """The topic that says how large the field of view is.

    Parameters
    ----------
    quantity
        What the number is.
    topic, type, field
        Where it is: topic, message type, and the path of the field, such as ``vector.x`` or
        ``position[0]``.
    unit
        ``1`` for a magnification, else ``m``, ``mm``, ``um``, ``nm`` or ``pm``.
    display_width_m
        Display width that the topic's magnification refers to, m; None: that of the calibration.
    image_width_px
        Image width that the topic's pixel size refers to, px; None: the width of the frames.
    """

    quantity: Quantity = Field(
        default="magnification", description="magnification, pixel_size or field_width"
    )
    topic: _Topic = Field(default="magnification", description=_TOPIC)
    type: _Type = Field(
        default="std_msgs/msg/Float64", description="a message type such as std_msgs/msg/Float64"
    )
    field: _FieldPath = Field(
        default="data", description="a path of field names such as data, vector.x or position[0]"
    )
    unit: Annotated[Literal["1", "m", "mm", "um", "nm", "pm"], BeforeValidator(_read_unit)] = Field(
        default="1", description="1 for a magnification; m, mm, um, nm or pm for a length"
    )
    display_width_m: _DisplayWidth | None = Field(
        default=None, description="a display width in m, above 0 and at most 100"
    )
    image_width_px: Annotated[int, Field(strict=True, ge=1, le=1_000_000), _Whole] | None = Field(
        default=None, description="a number of pixels from 1 to 1000000"
    )

    @property
    def si_per_unit(self) -> float:
        """Metres per unit of the number; 1 for a magnification."""
        return _METRES.get(self.unit, 1.0)


@_refuse_in_one_line
@dataclass(frozen=True, config=_FILE)
class StageSigmas:
    """How far the readings of the stage are trusted, 1-sigma, without their constant errors.

    Parameters
    ----------
    tilt, rotation
        Angles, rad: 0.2 and 0.5 degrees by default.
    z
        Height, m.
    """

    tilt: _AngleSigma = Field(default=0.0035, description="an angle in rad, above 0, at most 0.5")
    rotation: _AngleSigma = Field(
        default=0.0087, description="an angle in rad, above 0, at most 0.5"
    )
    z: _LengthSigma = Field(default=1.0e-4, description="a length in m, above 0, at most 0.01")


@_refuse_in_one_line
@dataclass(frozen=True, config=_FILE)
class StageConfig:
    """The topic that says where the stage is (SI units), and its tilt axis.

    Parameters
    ----------
    topic, type
        Where it is: ``sensor_msgs/msg/JointState``, one message before each change.
    tilt, rotation, x, y, z, scan_rotation
        Names of the joints. Messages may lack any of them.
    tilt_axis_deg
        Direction of the tilt axis in the image without scan rotation, from +x towards +y, in
        degrees. A positive tilt moves what lies at +90 degrees from it away from the pole piece.
    sigma
        How far the readings are trusted.
    """

    topic: _Topic = Field(default="stage", description="a ROS topic name such as stage")
    type: Literal["sensor_msgs/msg/JointState"] = Field(default=STAGE_TYPE, description=STAGE_TYPE)
    tilt: _Name = Field(default="tilt", description=_JOINT)
    rotation: _Name = Field(default="rotation", description=_JOINT)
    x: _Name = Field(default="x", description=_JOINT)
    y: _Name = Field(default="y", description=_JOINT)
    z: _Name = Field(default="z", description=_JOINT)
    scan_rotation: _Name = Field(default="scan_rotation", description=_JOINT)
    tilt_axis_deg: Annotated[_Number, Field(ge=-360.0, le=360.0)] = Field(
        default=0.0, description="an angle in degrees from -360 to 360"
    )
    sigma: StageSigmas = Field(
        default=StageSigmas(), description="a mapping of the sigmas of tilt, rotation and z"
    )


@dataclass(frozen=True, config=_FILE)
class _ScanKeys:
    """The keys of :class:`~semcal_ros.core.camera.scan_timing.ScanTiming` in a file."""

    frame_time_s: Annotated[_Number, Field(gt=0.0, le=1e6)] = Field(
        description="the time of one pass over the frame in s, above 0 and at most 1000000"
    )
    averages: Annotated[int, Field(strict=True, ge=1, le=1_000_000), _Whole] = Field(
        default=1, description="the number of averaged passes, 1 to 1000000"
    )
    flyback_fraction: Annotated[_Number, Field(ge=0.0, lt=1.0)] = Field(
        default=0.0, description="a number in [0, 1)"
    )
    line_averages: Annotated[int, Field(strict=True, ge=1, le=1_000_000), _Whole] = Field(
        default=1, description="the number of scans of each line, 1 to 1000000"
    )
    recursive_averages: Annotated[int, Field(strict=True, ge=1, le=1_000_000), _Whole] = Field(
        default=1, description="N of a recursive average of passes, 1 to 1000000"
    )
    bidirectional: Annotated[bool, Field(strict=True)] = Field(
        default=False, description="true where every other line is scanned backwards, or false"
    )


def _read_scan_timing(value: Any) -> ScanTiming:
    if isinstance(value, ScanTiming):
        return value
    keys = TypeAdapter(_ScanKeys).validate_python(value)
    return ScanTiming(
        keys.frame_time_s,
        keys.averages,
        keys.flyback_fraction,
        keys.line_averages,
        keys.recursive_averages,
        keys.bidirectional,
    )


@_refuse_in_one_line
@dataclass(frozen=True, config=_FILE)
class MicroscopeConfig:
    """One microscope.

    Parameters
    ----------
    name
        Name of the microscope, for reports and diagnostics.
    display_width_m
        Display width D of the calibration, m: its magnification is D / (field width). Calibrations
        and parameters are keyed by this magnification.
    image, magnification
        The two input streams.
    scan
        Raster timing, or None where it is not known: then a frame counts as taken at one instant.
    squares_m
        Square sizes of the chess grid specimen, m, largest first.
    squares_sigma
        Relative 1-sigma of the sizes of the squares that is common to all, from the certificate of
        the grid.
    grid_certificate
        What the sizes of the squares rest on, such as the number of a certificate. It is copied to
        the calibration.
    stage
        What the stage publishes; a recording without its topic is one without a stage. None leaves
        the stage out.
    frame_id
        Frame for images that the suite itself makes (virtual microscope, imported files).
    follow
        Left, top, right and bottom of a part of the pictures that shows the specimen and no tool, as parts of their
        width and height; the drift is that of what moves as it does. None where nothing is known.
    """

    name: Annotated[str, Field(strict=True, min_length=1, max_length=100)] = Field(
        description="a name of at most 100 characters"
    )
    display_width_m: _DisplayWidth = Field(
        description="a display width in m, above 0 and at most 100, such as 0.12"
    )
    image: ImageConfig = Field(default=ImageConfig(), description="a mapping of image settings")
    magnification: MagnificationConfig = Field(
        default=MagnificationConfig(), description="a mapping of magnification settings"
    )
    scan: (
        Annotated[ScanTiming, PlainValidator(_read_scan_timing, json_schema_input_type=_ScanKeys)]
        | None
    ) = Field(default=None, description="a mapping of scan settings")
    squares_m: Annotated[
        tuple[_SquareSize, ...], Field(min_length=1), AfterValidator(_sort_largest_first)
    ] = Field(
        default=(25e-6, 10e-6, 5e-6, 2e-6, 1e-6),
        description="a list of square sizes in m, each above 0 and at most 1, such as [10.0e-6]",
    )
    squares_sigma: Annotated[_Number, Field(ge=0.0, le=0.1)] = Field(
        default=0.0, description="a relative 1-sigma from 0 to 0.1, such as 0.001"
    )
    grid_certificate: Annotated[str, Field(strict=True, max_length=200)] = Field(
        default="", description="a text of at most 200 characters"
    )
    stage: StageConfig | None = Field(
        default=StageConfig(), description="a mapping of stage settings"
    )
    frame_id: _Frame = Field(default="sem_optical", description="a frame name such as sem_optical")
    follow: (
        Annotated[tuple[_Part, _Part, _Part, _Part], AfterValidator(_check_rectangle)] | None
    ) = Field(
        default=None,
        description="left, top, right and bottom of a part of the pictures, from 0 to 1, such as [0.5, 0, 1, 1]",
    )

    @property
    def start_offset_s(self) -> float:
        """Seconds, never positive, from the header stamp to the start of the acquisition.

        It is 0 without ``scan``.
        """
        if self.scan is None:
            return 0.0
        passed = {"start": 0.0, "centre": 0.5, "end": 1.0}[self.image.stamp]
        return -passed * self.scan.acquisition_time_s

    @property
    def centre_offset_s(self) -> float:
        """Seconds from the header stamp to the centre of the acquisition (0 without ``scan``)."""
        return self.start_offset_s + (self.scan.centre_offset_s if self.scan else 0.0)


_MAPPINGS: dict[str, Any] = {
    "image": ImageConfig,
    "magnification": MagnificationConfig,
    "scan": _ScanKeys,
    "stage": StageConfig,
    "stage.sigma": StageSigmas,
}


# A file has to say these although the classes have defaults: a number of another quantity looks
# much like a magnification.
_REQUIRED = {"": "magnification", "magnification": "quantity"}


_UNKNOWN = ("unexpected_keyword_argument", "invalid_key")


Location = tuple[str | int, ...]


#: What is wrong at which key: pydantic's type of error, and the value.
Problems = dict[Location, tuple[str, Any]]


@lru_cache(maxsize=1)
def _make_checker() -> TypeAdapter[MicroscopeConfig]:
    return TypeAdapter(MicroscopeConfig)


def config_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a configuration file, for editors that complete and check."""
    return _make_checker().json_schema()


def load_config(name_or_path: str | Path) -> MicroscopeConfig:
    """Read a configuration.

    Parameters
    ----------
    name_or_path
        Path of a YAML file, or the bare name of one that is shipped (``"jsm820"``; see
        :func:`~semcal_ros.config.config.config_names`).

    Raises
    ------
    ConfigError
        There is no such file, it is not valid YAML, or a key is missing, unknown or wrong; the
        message names the key.
    """
    path = find_config_file(name_or_path)
    return parse_config(read_config_text(path), source=str(path))


def parse_config(text: str, *, source: str = "configuration") -> MicroscopeConfig:
    """Configuration from YAML text.

    ``source`` is named in the errors, which are those of :func:`load_config`.
    """
    values = load_yaml(text, source)
    found: Problems = {}
    try:
        config = _make_checker().validate_python(values)
    except ValidationError as error:
        found = _list_problems(error)
    for location, kind in _find_omissions(values):
        found.setdefault(location, (kind, None))
    if found:
        raise _make_refusal(
            source, found, MicroscopeConfig, do="compare with msg_configs/generic.yaml"
        )
    _check_magnification(values["magnification"], config.magnification, source)
    return config


def _list_problems(error: ValidationError) -> Problems:
    return {
        problem["loc"]: (problem["type"], problem["input"])
        for problem in error.errors(include_url=False, include_context=False)
    }


def _explain(error: ValidationError, declared: type[Any]) -> ConfigError:
    """The error for a constructor, whose arguments may be given by their place."""
    names = list(declared.__pydantic_fields__)
    found = {
        (names[at[0]], *at[1:])
        if at and isinstance(at[0], int) and at[0] < len(names)
        else at: problem
        for at, problem in _list_problems(error).items()
    }
    return _make_refusal(declared.__name__, found, declared)


def _find_omissions(values: Any) -> Iterator[tuple[Location, str]]:
    """Keys that only a file must have, and keys without a value."""
    if not isinstance(values, dict):
        return
    for parent in ("", *_MAPPINGS):
        above = tuple(parent.split(".")) if parent else ()
        mapping: Any = values
        for key in above:
            mapping = mapping.get(key) if isinstance(mapping, dict) else None
        if not isinstance(mapping, dict):
            continue
        if _REQUIRED.get(parent, parent) not in {parent, *mapping}:
            yield (*above, _REQUIRED[parent]), "missing"
        yield from (((*above, key), "none") for key, value in mapping.items() if value is None)


def _make_refusal(source: str, found: Problems, declared: type[Any], do: str = "") -> ConfigError:
    """What is wrong with the value of one key, in one line."""
    # A misspelt key causes a missing one as well: name the misspelt one.
    location = min(found, key=lambda at: (found[at][0] not in _UNKNOWN, _format_path(at)))
    kind, value = found[location]
    depth, mapping = _innermost(location, declared)
    fields = mapping.__pydantic_fields__
    path = _format_path(location)
    if kind in _UNKNOWN:
        return ConfigError(
            f"{source}: unknown key {_shorten(path)}",
            expected="one of " + ", ".join(fields),
            do=did_you_mean(str(location[depth])[:_MAX_SEEN], fields) or do,
        )
    key = location[depth] if location else ""
    expected = fields[key].description if location else "a mapping of settings"
    if kind == "missing":
        return ConfigError(f"{source}: key {path} is missing", expected=expected, do=do)
    where = f"key {path}" if path else "the whole file"
    return ConfigError(f"{source}: {where} is {_format_value(value)}", expected=expected, do=do)


def _innermost(location: Location, declared: type[Any]) -> tuple[int, Any]:
    """The innermost mapping around a key: how many keys lead to it, and its declaration."""
    above = [path for path, kind in _MAPPINGS.items() if kind is declared]
    for depth in range(len(location) - 1, 0, -1):
        path = ".".join([*above, *map(str, location[:depth])])
        if path in _MAPPINGS:
            return depth, _MAPPINGS[path]
    return 0, declared


def _format_path(location: Location) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return "".join(parts).lstrip(".")


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_SEEN else text[:_MAX_SEEN] + "..."


def _format_value(value: Any) -> str:
    try:
        return _shorten(repr(value))
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "an enormous number"


def _check_magnification(given: dict[str, Any], read: MagnificationConfig, source: str) -> None:
    """Refuse a unit or a key that does not belong to the quantity."""
    is_length = read.quantity != "magnification"
    if is_length != (read.unit in _METRES):
        raise ConfigError(
            f"{source}: key magnification.unit is {given.get('unit', 'missing')!r} for the quantity "
            f"{read.quantity}",
            expected="m, mm, um, nm or pm" if is_length else "1",
            do="state the unit of the number in the topic",
        )
    for key, quantity in (("display_width_m", "magnification"), ("image_width_px", "pixel_size")):
        if key in given and read.quantity != quantity:
            raise ConfigError(
                f"{source}: key magnification.{key} with the quantity {read.quantity}",
                expected=f"this key only with the quantity {quantity}",
                do="remove the key or correct the quantity",
            )


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
