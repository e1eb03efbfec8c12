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

"""XML in the tag that Thermo Fisher's microscopes and Phenom's share."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff.values import first_date, plain_number, quantity

# Private TIFF tag of FEI, FEI_TITAN.
TAG = 34683
_MAX_CHARS = 1_000_000  # real ones have some 10 kB


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
            f"{path.name}: tag {TAG} holds XML with declarations, or too much of it",
            expected="the plain XML of Thermo Fisher or Phenom",
            do="copy the file again from the microscope",
        )
    # An encoding in the declaration is wrong once the text is decoded.
    body = re.sub(r"^<\?xml[^>]*\?>", "", text)
    try:
        return ElementTree.fromstring(body)
    except ElementTree.ParseError as error:
        raise TiffError(
            f"{path.name}: tag {TAG} is not XML: {error}",
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
