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

"""Text files beside an image in which some makers keep its metadata."""

from __future__ import annotations

from pathlib import Path

_MAX_BYTES = 1_000_000  # the text files have a few kB


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
