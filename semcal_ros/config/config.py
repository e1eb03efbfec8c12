"""``msg_configs`` files: how one microscope's own topics, fields and units map onto the suite.

``msg_configs/generic.yaml`` documents every key.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from semcal_ros.config.files import config_names, find_config_file, read_config_text
from semcal_ros.config.parse import parse_mapping
from semcal_ros.config.schema import COMPRESSED_IMAGE_TYPE, IMAGE_TYPE, IMAGE_TYPES
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import ConfigError

__all__ = [
    "COMPRESSED_IMAGE_TYPE",
    "IMAGE_TYPE",
    "IMAGE_TYPES",
    "ImageConfig",
    "MagnificationConfig",
    "MicroscopeConfig",
    "config_names",
    "load_config",
    "parse_config",
]

StampMoment = Literal["start", "centre", "end"]
Quantity = Literal["magnification", "pixel_size", "field_width"]

_METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12}


@dataclass(frozen=True)
class ImageConfig:
    """The image stream.

    Parameters
    ----------
    topic, type
        Where the frames arrive, and one of :data:`IMAGE_TYPES`; a relative topic is resolved in the node's namespace.
        The topic of compressed images is given in full, such as ``image_raw/compressed``.
    stamp
        The moment of the acquisition that the header stamp means.
    databar_rows
        Rows at the bottom that show text instead of the specimen.
    """

    topic: str = "image_raw"
    type: str = IMAGE_TYPE
    stamp: StampMoment = "start"
    databar_rows: int = 0


@dataclass(frozen=True)
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

    quantity: Quantity = "magnification"
    topic: str = "magnification"
    type: str = "std_msgs/msg/Float64"
    field: str = "data"
    unit: str = "1"
    display_width_m: float | None = None
    image_width_px: int | None = None

    @property
    def si_per_unit(self) -> float:
        """Metres per unit of the number; 1 for a magnification."""
        return _METRES.get(self.unit, 1.0)


@dataclass(frozen=True)
class MicroscopeConfig:
    """One microscope.

    Parameters
    ----------
    name
        Name of the microscope, for reports and diagnostics.
    display_width_m
        Display width D of the calibration, m: its magnification is D / (field width). It is the one
        by which everything is keyed.
    image, magnification
        The two input streams.
    scan
        Raster timing, or None where it is not known: then a frame counts as taken at one instant.
    squares_m
        Square sizes of the chess grid specimen, m, largest first.
    frame_id
        Frame for images that the suite itself makes (virtual microscope, imported files).
    """

    name: str
    display_width_m: float
    image: ImageConfig = ImageConfig()
    magnification: MagnificationConfig = MagnificationConfig()
    scan: ScanTiming | None = None
    squares_m: tuple[float, ...] = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
    frame_id: str = "sem_optical"

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


def load_config(name_or_path: str | Path) -> MicroscopeConfig:
    """Read a configuration.

    Parameters
    ----------
    name_or_path
        Path of a YAML file, or the bare name of one that is shipped (``"jsm820"``; see
        :func:`config_names`).

    Raises
    ------
    ConfigError
        There is no such file, it is no YAML, or a key is missing, unknown or wrong; the message
        names the key.
    """
    path = find_config_file(name_or_path)
    return parse_config(read_config_text(path), source=str(path))


def parse_config(text: str, *, source: str = "configuration") -> MicroscopeConfig:
    """Configuration from YAML text.

    ``source`` is named in the errors, which are those of :func:`load_config`.
    """
    values = parse_mapping(text, source)
    scan = values.get("scan")
    return MicroscopeConfig(
        name=values["name"],
        display_width_m=float(values["display_width_m"]),
        image=_image(values.get("image", {})),
        magnification=_magnification(values["magnification"], source),
        scan=None if scan is None else _scan(scan),
        **_optional(values),
    )


def _optional(values: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if "squares_m" in values:
        sizes = (float(size) for size in values["squares_m"])
        found["squares_m"] = tuple(sorted(sizes, reverse=True))
    if "frame_id" in values:
        found["frame_id"] = values["frame_id"]
    return found


def _scan(values: dict[str, Any]) -> ScanTiming:
    return ScanTiming(
        frame_time_s=float(values["frame_time_s"]),
        averages=int(values.get("averages", 1)),
        flyback_fraction=float(values.get("flyback_fraction", 0.0)),
    )


def _image(values: dict[str, Any]) -> ImageConfig:
    return ImageConfig(**{**values, "databar_rows": int(values.get("databar_rows", 0))})


def _magnification(values: dict[str, Any], source: str) -> MagnificationConfig:
    is_length = values["quantity"] != "magnification"
    given = values.get("unit", "" if is_length else "1")
    unit = given if isinstance(given, str) else "1"
    if is_length != (unit in _METRES):
        raise ConfigError(
            f"{source}: key magnification.unit is {unit!r} for the quantity {values['quantity']}",
            expected="m, mm, um, nm or pm" if is_length else "1",
            do="state the unit of the number in the topic",
        )
    _refuse_unused(values, "display_width_m", "magnification", source)
    _refuse_unused(values, "image_width_px", "pixel_size", source)
    converted: dict[str, Any] = {"unit": unit}
    for key, convert in (("display_width_m", float), ("image_width_px", int)):
        if key in values:
            converted[key] = convert(values[key])
    return MagnificationConfig(**{**values, **converted})


def _refuse_unused(values: dict[str, Any], key: str, quantity: str, source: str) -> None:
    if key in values and values["quantity"] != quantity:
        raise ConfigError(
            f"{source}: key magnification.{key} with the quantity {values['quantity']}",
            expected=f"it only with the quantity {quantity}",
            do="remove the key or correct the quantity",
        )
