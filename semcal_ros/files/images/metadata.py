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

"""Metadata as text: numbers with units, dates, XML, and the files next to an image in which some makers keep them.

The XML stands in a tag that the microscopes of Thermo Fisher and Phenom share.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

from semcal_ros.core.errors import TiffError

# A tenth of a picometre lies far below the size of an atom, a millimetre above any field of an SEM
# divided by its columns: what lies outside has lost its unit.
PIXEL_SIZE_RANGE_M = (1e-13, 1e-3)
# Relative difference of the sizes of a pixel beyond which a note says that it is not square.
_SQUARE_TOLERANCE = 1e-3
_YEARS = (1971, 2037)  # what the 32-bit seconds of a ROS stamp hold

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_COMMA_NUMBER = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?\s*[a-zA-Z\u00b5\u03bc]{0,3}")
_DURATIONS_S = {"sec": 1.0, "secs": 1.0, "min": 60.0, "mins": 60.0, "hour": 3600.0, "hours": 3600.0}
_PREFIX = {"": 1.0, "f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3}
_MAX_BYTES = 1_000_000  # the text files have a few kB

# Private TIFF tag of FEI, FEI_TITAN.
XML_TAG = 34683
_MAX_CHARS = 1_000_000  # real ones have some 10 kB


def _split(text: object) -> tuple[float, str] | None:
    stripped = str(text).replace("\x00", " ").strip()
    match = _NUMBER.match(stripped)
    if match is None:
        return None
    value = float(match.group())
    return (value, stripped[match.end() :].lstrip()) if math.isfinite(value) else None


def _unit_scale(unit: str, base: str) -> float | None:
    """Return the factor to SI of a unit such as ``nm``; None if unknown. A micro sign may have lost its encoding."""
    if not unit.endswith(base):
        return None
    prefix = unit[: len(unit) - len(base)].strip()
    prefix = prefix.replace("\u00c2", "").replace("\u00ce\u00bc", "u")
    if len(prefix) == 1 and ord(prefix) > 127:
        prefix = "u"
    return _PREFIX.get(prefix)


def quantity(text: object, base: str, *, default_unit: str = "") -> float | None:
    """Value in SI of a text such as ``593.3 nm``; None if it has no number or another unit.

    Parameters
    ----------
    text
        Number and unit.
    base
        Unit without prefix: ``m``, ``s``.
    default_unit
        Unit of a bare number; without it a bare number is not understood.
    """
    parts = _split(text)
    if parts is None:
        return None
    value, unit = parts
    scale = _unit_scale(unit or default_unit, base)
    if scale is None or not math.isfinite(value * scale):
        return None
    return value * scale


def duration(text: object) -> float | None:
    """Time in s of a text such as ``752.76 ms``, ``40.5 Secs`` or ``1.9 Mins``; None if it is none."""
    parts = _split(text)
    scale = None if parts is None else _DURATIONS_S.get(parts[1].strip().lower())
    return quantity(text, "s") if parts is None or scale is None else parts[0] * scale


def rounding(text: object) -> float | None:
    """Half a unit of the last digit of a text's number, relative to the number; None without one or for zero."""
    match = _NUMBER.match(str(text).strip())
    if match is None or not float(match.group()):
        return None
    digits = re.split(r"[eE]", match.group().lstrip("+-"))[0]
    decimals = len(digits.partition(".")[2])
    return 0.5 * 10.0**-decimals / float(digits)


def plain_number(text: object) -> float | None:
    """Parse a bare finite number; return ``None`` for any other text."""
    parts = _split(text)
    return parts[0] if parts is not None and not parts[1] else None


def angle_in_degrees(text: object) -> float | None:
    """Angle in rad of a text such as ``2.0 deg``, or with the sign for degrees; else None.

    The sign may have lost its encoding.
    """
    parts = _split(text)
    if parts is None:
        return None
    unit = parts[1].replace("\u00c2", "").strip().lower()
    return math.radians(parts[0]) if unit in ("\u00b0", "\u00ba", "\ufffd", "deg") else None


def positive(value: float | None) -> float | None:
    """Return ``value`` if it is a number above zero."""
    return value if value is not None and math.isfinite(value) and value > 0 else None


def check_pixel_size(path: Path, value: float | None, key: str, seen: object) -> float:
    """Return the pixel size if an SEM can have it.

    Raises
    ------
    TiffError
        It is missing, not a number, without a known unit, or absurd.
    """
    low, high = PIXEL_SIZE_RANGE_M
    if value is None or not low <= value <= high:
        shown = "nothing" if seen is None else repr(str(seen)[:60])
        raise TiffError(
            f"{path.name}: {key} is {shown}",
            expected=f"a pixel size of {low * 1e9:g} nm to {high * 1e3:g} mm with its unit",
            do="export the image again with its metadata",
        )
    return value


def refuse_decimal_commas(path: Path, values: Mapping[str, object]) -> None:
    """Refuse numbers that were written with a comma, such as ``0,349``: which of them are decimal is not for a reader
    to guess, and one that is left out would be missed in silence.

    Raises
    ------
    TiffError
        One of the values, by their keys, is such a number.
    """
    for key, value in values.items():
        text = str(value).strip()
        if _COMMA_NUMBER.fullmatch(text):
            raise TiffError(
                f"{path.name}: {key} is {text[:60]!r}",
                expected="numbers with a decimal point",
                do="set the computer of the microscope to decimal points, and export the image again",
            )


def is_credible_year(year: int) -> bool:
    """Whether the 32-bit seconds of a ROS stamp can hold it."""
    return _YEARS[0] <= year <= _YEARS[1]


def first_date(candidates: list[tuple[str, str]]) -> datetime | None:
    """Return the first credible date that one of the (text, format) pairs gives, or None.

    Years that the 32-bit seconds of a ROS stamp cannot hold are not credible.
    """
    for text, pattern in candidates:
        try:
            found = datetime.strptime(" ".join(text.split()), pattern)
        except ValueError:
            continue
        if is_credible_year(found.year):
            return found
    return None


def aspect_notes(pixel_m: float, pixel_y_m: float) -> list[str]:
    """Return a remark if pixels are not square; both sizes are used unchanged in any case."""
    if abs(pixel_y_m / pixel_m - 1.0) <= _SQUARE_TOLERANCE:
        return []
    return [f"pixels are not square: {pixel_m:g} m wide, {pixel_y_m:g} m high"]


def tilt_correction_note(angle_rad: float | None) -> str:
    """Remark on an image whose rows the microscope stretched for a tilted surface."""
    angle = "" if angle_rad is None else f" for {math.degrees(angle_rad):g} degrees"
    return (
        f"tilt correction was on{angle}: the rows are spaced for a surface tilted so, and a surface at another "
        "angle is stretched along y"
    )


def decode_text(data: bytes) -> str:
    """Decode UTF-16 with its mark, UTF-8, or else Latin-1, in which the micro sign of older programs is."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def find_side_file(image: Path, endings: tuple[str, ...]) -> Path | None:
    """The file beside ``image`` whose name is its stem and one of the endings, in either case."""
    names = [image.stem + form for ending in endings for form in (ending, ending.upper())]
    return next((image.parent / name for name in names if (image.parent / name).is_file()), None)


def read_side_file(path: Path) -> bytes:
    """The contents of a text file, cut off far beyond the size that makers' files have."""
    with path.open("rb") as file:
        return file.read(_MAX_BYTES)


def parse_xml(path: Path, document: str | bytes) -> ElementTree.Element:
    """Return the root of the document.

    Raises
    ------
    TiffError
        It is not XML, is too long, or declares entities, which could expand without bound.
    """
    text = document.decode("utf-8", errors="replace") if isinstance(document, bytes) else document
    text = text.replace("\x00", "").strip()
    if len(text) > _MAX_CHARS or "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise TiffError(
            f"{path.name}: tag {XML_TAG} holds XML with declarations, or too much of it",
            expected="the plain XML of Thermo Fisher or Phenom",
            do="copy the file again from the microscope",
        )
    # An encoding in the declaration is wrong once the text is decoded.
    body = re.sub(r"^<\?xml[^>]*\?>", "", text)
    try:
        return ElementTree.fromstring(body)
    except ElementTree.ParseError as error:
        raise TiffError(
            f"{path.name}: tag {XML_TAG} is not XML: {error}",
            expected="the XML of Thermo Fisher or Phenom",
            do="copy the file again from the microscope",
        ) from error


def text_of(root: ElementTree.Element, place: str) -> str:
    """Return the text at ``place``, empty if there is none."""
    return (root.findtext(place) or "").strip()


def number_of(root: ElementTree.Element, place: str) -> float | None:
    """Return the bare number at ``place``."""
    return plain_number(text_of(root, place))


def quantity_of(root: ElementTree.Element, place: str, base: str) -> float | None:
    """Return the SI value at ``place`` whose unit is in the attribute ``unit``; None without a unit."""
    element = root.find(place)
    if element is None:
        return None
    return quantity(f"{element.text} {element.get('unit', '')}", base)


def date_of(root: ElementTree.Element, place: str) -> datetime | None:
    """Return the date at ``place``; parts of a second and a zone are dropped, as the time is a local one."""
    match = re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d", text_of(root, place))
    return None if match is None else first_date([(match.group(), "%Y-%m-%dT%H:%M:%S")])
