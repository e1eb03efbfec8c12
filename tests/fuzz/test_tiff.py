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

"""SEM images of makers: whatever the bytes, a grey image with a credible pixel size, or one clear line."""

from __future__ import annotations

import json
import math
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from semcal_ros.core.errors import TiffError
from semcal_ros.files.bags.reader import open_bag
from semcal_ros.files.images.image_file import read_plain_image
from semcal_ros.files.images.metadata import PIXEL_SIZE_RANGE_M, plain_number, quantity
from semcal_ros.files.images.sem_image import SemImage
from semcal_ros.files.images.to_bag import METADATA_TOPIC, import_images
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.tiff.read import read_page_settings, read_sem_pages, read_sem_tiff
from tests.helpers.fuzz_inputs import changed, damaged, edited_text
from tests.helpers.fuzz_support import attempt, fuzz, run_semcal

_WIDTH, _HEIGHT = 12, 10
_PIXELS = (np.arange(_WIDTH * _HEIGHT) % 251).astype(np.uint8).reshape(_HEIGHT, _WIDTH)

_ZEISS = "\r\n".join(
    [
        *("0", "0", "0", "5.932882e-07", "188.19", "6", "5.0e+03", "2.27", "2e-10", "5.24e-03"),
        *("AP_IMAGE_PIXEL_SIZE", "Image Pixel Size = 593.3 nm", "AP_MAG", "Mag = 188 X"),
        *("AP_WD", "WD = 5.2 mm", "DP_SCAN_ROT", "Scan Rot = On"),
        *("AP_SCANROTATION", "Scan Rotation = 30.0 \u00b0", "DP_DWELL_TIME", "Dwell Time = 50 ns"),
        *("AP_FRAME_TIME", "Cycle Time = 752.76 ms", "AP_DATE", "Date :11 Apr 2023"),
        *("AP_TIME", "Time :8:40:47", "DP_DETECTOR_CHANNEL", "Signal A = InLens"),
    ]
)
_THERMO_FISHER = "\r\n".join(
    [
        *("[System]", "SystemType=Scios", "DisplayWidth=0.518", "[Beam]", "Beam=EBeam"),
        *("Scan=EScan", "[EBeam]", "WD=0.0068", "ScanRotation=0.5", "[EScan]", "Dwell=1e-06"),
        *("PixelWidth=2.69792e-07", "PixelHeight=2.69792e-07", "FrameTime=1.75", "[Image]"),
        *(f"ResolutionX={_WIDTH}", "ResolutionY=8", "MagCanvasRealWidth=0.138", "[Detectors]"),
        *("Name=ETD", "[PrivateFei]", "TimeOfCreation=10.11.2023 14:09:15", "DatabarHeight=0"),
    ]
)
_TESCAN = "\r\n".join(
    [
        *("Date=2016-05-16", "ImageStripSize=2", "Magnification=108.08", "PixelSizeX=2.5012e-6"),
        *("PixelSizeY=2.5012e-6", "Time=16:03:27", "Detector=SE", "DwellTime=3.2e-6"),
        *("ScanRotation=90.0", "WD=13.250e-3", "Device=VEGA"),
    ]
)
_JEOL = "\r\n".join(
    [
        *("$CM_FORMAT JEOL-SEM", "$CM_MAG 50", f"$CM_FULL_SIZE {_WIDTH} {_HEIGHT}", "$$SM_WD 9.07"),
        *("$$SM_SCAN_ROTATION 0.00", "$CM_DATE 2025/11/20", "$CM_TIME 13:42:14"),
        *("$$SM_MICRON_BAR 70", "$$SM_MICRON_MARKER 100um", "$CM_DETECTOR_NAME LED"),
    ]
)
_HITACHI = "\r\n".join(
    [
        *("[SemImageFile]", "InstructName=SU8230", "Date=2019/03/12", "Time=10:22:13"),
        *(f"DataSize={_WIDTH}x{_HEIGHT}", "PixelSize=9.921875", "Magnification=10000"),
        *("AcceleratingVoltage=15000 Volt", "WorkingDistance=8100 um", "StagePositionT=0"),
    ]
)
_PHENOM = "\n".join(
    [
        *('<?xml version="1.0"?>', "<FeiImage>", "<databarHeight>2</databarHeight>"),
        *('<pixelWidth unit="nm">975.8</pixelWidth>', '<pixelHeight unit="nm">975.8</pixelHeight>'),
        *("<time>2019-08-07T09:37:31</time>", '<displayWidth unit="m">0.4</displayWidth>'),
        *("<acquisition><scan>", '<dwellTime unit="ns">200</dwellTime>', "<rotation>0</rotation>"),
        *('<highVoltage unit="kV">-15</highVoltage>', "</scan></acquisition>", "</FeiImage>"),
    ]
)
_XML = "\n".join(
    [
        *("<Metadata>", "<Optics><AccelerationVoltage>2000</AccelerationVoltage></Optics>"),
        *("<ScanSettings><FrameTime>1.2</FrameTime></ScanSettings>", "<BinaryResult>"),
        *(f"<ImageSize><X>{_WIDTH}</X><Y>8</Y></ImageSize>", '<PixelSize><X unit="m">2.7E-07</X>'),
        *('<Y unit="m">2.7E-07</Y></PixelSize>', "</BinaryResult>", "</Metadata>"),
    ]
)
_IMAGEJ = "ImageJ=1.53t\nunit=micron\nyunit=\\u00B5m\nfinterval=0.5\ntunit=ms"
_PIECES = [
    *(
        "=",
        "[",
        "]",
        "\n",
        "\r\n",
        "$",
        "$$",
        " ",
        "\t",
        "\x00",
        "\u00b5m",
        " nm",
        " pm",
        "km",
        "-",
    ),
    *("1e308", "1e-308", "1e999", "nan", "inf", "0", "-1", "9" * 400, "9" * 5000, "0x10", "1,5"),
    *("[Scan]", "[EScan]", "[Beam]\r\n", "Beam=", "PixelWidth=", "PixelHeight=1e-6\r\n", "=1e-6"),
    *(
        " " * 3000 + "x",
        "1 " + " " * 3000 + "x",
        "\r\n" * 300,
        "AP_MAG\r\n",
        "DP_SCAN_ROT\r\nx\r\n",
    ),
    *("Mag = 5.00 K X", "31 Feb 2023", "99:99:99", "01.01.9999 00:00:00", "\U0001f52c", "\u0665"),
]


def _record(kind: int, payload: bytes) -> bytes:
    return struct.pack("<IH", len(payload) + 2, kind) + payload


def _tescan_tag(text: str) -> bytes:
    data = text.encode("utf-8", errors="surrogatepass")
    return _record(1, b"\xff\xd8\nPixelSizeX=1\n\xff\xd9") + _record(2, data + b"\x00")


_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8}
Entry = tuple[int, int, int, bytes]


def _tiff(entries: list[Entry], strip: bytes, *, order: str = "<") -> bytes:
    """A TIFF of one page: the header, the strip, long values, the directory.

    ``entries`` are code, type, declared count and the bytes of the value; code 273 gets the strip's place.
    """
    head = (b"II*\x00" if order == "<" else b"MM\x00*") + b"\x00" * 4
    body, places = head + strip + b"\x00" * (len(strip) % 2), []
    for code, kind, count, value in entries:
        if code == 273 and value == b"":
            value = struct.pack(order + "I", len(head))
        if len(value) > 4:
            places.append((code, kind, count, struct.pack(order + "I", len(body))))
            body += value + b"\x00" * (len(value) % 2)
        else:
            places.append((code, kind, count, value.ljust(4, b"\x00")))
    directory = struct.pack(order + "H", len(places))
    for code, kind, count, field in places:
        directory += struct.pack(order + "HHI", code, kind, count & 0xFFFFFFFF) + field
    start = struct.pack(order + "I", len(body))
    return body[:4] + start + body[8:] + directory + b"\x00" * 4


def _entries(maker: str, text: str, order: str = "<", **changes: int) -> list[Entry]:
    """The usual entries of a small grey image with the tag of a maker."""
    values = {
        256: _WIDTH, 257: _HEIGHT, 258: 8, 259: 1, 262: 1, 277: 1, 278: _HEIGHT, 279: _PIXELS.size,
    }  # fmt: skip
    values.update({int(code.removeprefix("t")): value for code, value in changes.items()})
    found: list[Entry] = [
        (code, 4, 1, struct.pack(order + "I", value)) for code, value in values.items()
    ]
    found.append((273, 4, 1, b""))
    plain = text.encode("cp1252", errors="replace") + b"\x00"
    if maker == "zeiss":
        found.append((34118, 2, len(plain), plain))
    elif maker == "thermo_fisher":
        found.append((34682, 2, len(plain), plain))
    elif maker == "tescan":
        tag = _tescan_tag(text)
        found.append((50431, 7, len(tag), tag))
    elif maker in ("phenom", "thermo_fisher_xml"):
        found.append((34683, 2, len(plain), plain))
    elif maker == "imagej":
        scale = struct.pack(order + "II", 5_928_571, 1_000_000)
        found += [(270, 2, len(plain), plain), (282, 5, 1, scale), (283, 5, 1, scale)]
    return sorted(found)


_BESIDE = {"jeol": _JEOL, "hitachi": _HITACHI}
_TEXTS = {
    "zeiss": _ZEISS,
    "thermo_fisher": _THERMO_FISHER,
    "thermo_fisher_xml": _XML,
    "phenom": _PHENOM,
    "tescan": _TESCAN,
    "imagej": _IMAGEJ,
    **_BESIDE,
}


def _valid(maker: str, text: str, order: str = "<") -> bytes:
    return _tiff(_entries(maker, text, order), _PIXELS.tobytes(), order=order)


def _packed() -> bytes:
    packed = zlib.compress(_PIXELS.tobytes())
    return _tiff(_entries("zeiss", _ZEISS, t259=8, t279=len(packed)), packed)


def _by_opencv(flag: int) -> bytes:
    """A compressed image of OpenCV's own writer, whose directory then gets a maker's tag."""
    done, data = cv2.imencode(
        ".tif", np.tile(_PIXELS, (3, 3)), [cv2.IMWRITE_TIFF_COMPRESSION, flag]
    )
    assert done
    return bytes(data)


def _of_two_images() -> bytes:
    """Two directories for the same pixels."""
    data = bytearray(_valid("zeiss", _ZEISS))
    (first,) = struct.unpack_from("<I", data, 4)
    directory = data[first:]
    struct.pack_into("<I", data, len(data) - 4, len(data))
    return bytes(data + directory)


_FILES = [
    *(_valid(maker, text) for maker, text in _TEXTS.items() if maker != "hitachi"),
    *(_valid(maker, text, ">") for maker, text in _TEXTS.items() if maker != "hitachi"),
    _packed(),
    _of_two_images(),
]


def _check(image: SemImage) -> None:
    low, high = PIXEL_SIZE_RANGE_M
    assert low <= image.pixel_size_m <= high
    assert low <= image.pixel_size_y_m <= high
    assert image.image.dtype in (np.uint8, np.uint16)
    assert image.image.ndim == 2
    assert image.image.size > 0
    columns, rows = image.full_size_px
    assert image.image.shape == (rows - image.databar_rows, columns)
    assert 0 <= image.databar_rows < rows
    plain = json.loads(json.dumps(image.metadata(), allow_nan=False))
    assert plain["maker"] == image.maker
    for value in plain.values():
        assert not isinstance(value, float) or math.isfinite(value)


def _read(path: Path) -> SemImage:
    (_, settings, size_px), *_ = read_page_settings(path)
    image = read_sem_tiff(path)
    _check(image)
    assert image.settings == settings
    assert image.full_size_px == size_px
    try:
        pages = list(read_sem_pages(path))
    except TiffError:  # the damage is in a later image
        return image
    assert pages[0].settings == settings
    for page in pages:
        _check(page)
    return image


@pytest.fixture(scope="module")
def place(folder: Path) -> Path:
    """A folder of its own: the name of a text beside an image says to which it belongs."""
    own = folder / "tiff"
    own.mkdir(exist_ok=True)
    return own


def _written(place: Path, data: bytes, text: str | None = None) -> Path:
    path = place / "image.tif"
    path.write_bytes(data)
    beside = path.with_suffix(".txt")
    if text is None:
        beside.unlink(missing_ok=True)
    else:
        beside.write_bytes(text.encode("utf-8", errors="surrogatepass"))
    return path


def test_the_valid_files_are_accepted(place: Path) -> None:
    for index, data in enumerate(_FILES):
        path = _written(place, data, _JEOL)
        image = attempt(lambda path=path: _read(path))
        assert image is not None, index
        assert len(read_page_settings(path)) == 1 + (data == _of_two_images())
        np.testing.assert_array_equal(image.image, _PIXELS[: image.image.shape[0]])


@fuzz(3.0)
@given(data=damaged(_FILES), beside=st.booleans())
@example(data=_packed().replace(b"\x78\x9c", b"\x78\x00"), beside=False)
def test_damaged_files(place: Path, data: bytes, beside: bool) -> None:
    path = _written(place, data, _JEOL if beside else None)
    attempt(lambda: _read(path))


@st.composite
def _odd_files(draw: st.DrawFn) -> bytes:
    """A directory of odd entries: types, counts, sizes, compressions, depths, double and missing ones."""
    order = draw(st.sampled_from("<>"))
    maker = draw(st.sampled_from(sorted(_TEXTS)))
    entries = _entries(maker, _TEXTS[maker], order)
    number = st.one_of(
        st.integers(0, 40),
        st.sampled_from([8, 16, 32, 255, 4096, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1]),
    )
    for _ in range(draw(st.integers(1, 4))):
        index = draw(st.integers(0, len(entries) - 1))
        code, kind, count, value = entries[index]
        how = draw(st.sampled_from(["number", "number", "kind", "count", "code", "drop", "double"]))
        if how == "number":
            entries[index] = code, 4, 1, struct.pack(order + "I", draw(number))
        elif how == "kind":
            entries[index] = code, draw(st.sampled_from([*_SIZES, 0, 14, 99])), count, value
        elif how == "count":
            wanted = draw(number)
            repeated = value * min(wanted, 20) if draw(st.booleans()) else value
            entries[index] = code, kind, wanted, repeated
        elif how == "code":
            other = draw(
                st.sampled_from([254, 258, 259, 262, 266, 274, 277, 284, 317, 320, 322, 323, 324])
                | st.sampled_from(
                    [325, 330, 338, 339, 347, 32997, 33560, 34118, 34680, 34682, 50431, 700]
                )
            )
            entries.append(
                (
                    other,
                    draw(st.sampled_from([2, 3, 4, 7])),
                    1,
                    struct.pack(order + "I", draw(number)),
                )
            )
        elif how == "drop" and len(entries) > 1:
            del entries[index]
        else:
            entries.append(entries[index])
    strip = draw(
        st.sampled_from([_PIXELS.tobytes(), zlib.compress(_PIXELS.tobytes()), b"\x00" * 7])
    )
    entries = sorted(entries) if draw(st.booleans()) else entries
    return _tiff(entries, strip, order=order)


# A small file that declares a large image, of which no part is there.
_HOLLOW = [
    _tiff(
        [
            (code, kind, count, b"\x00" * 4 if code == 273 else value)
            for code, kind, count, value in _entries("zeiss", _ZEISS, **changes)
        ],
        b"",
    )
    for changes in (
        {"t256": 20_000, "t257": 20_000, "t278": 20_000, "t279": 0},
        {"t256": 4000, "t257": 4000, "t278": 4000, "t277": 60, "t279": 0},
        {"t256": 20_000, "t257": 20_000, "t278": 20_000, "t279": 0, "t259": 8},
        {"t256": 20_000, "t257": 20_000, "t278": 20_000, "t279": 0, "t259": 5},
    )
]


# Several heights, each of which the parser of TIFF files would count strips for.
_REPEATED = _tiff(
    [
        (code, kind, 20, 20 * struct.pack("<I", 2_000_000))
        if code == 257
        else (code, kind, n, value)
        for code, kind, n, value in _entries("zeiss", _ZEISS, t278=1)
    ],
    _PIXELS.tobytes(),
)

# A field of view of 2 m, whose width times the magnification is more than a float holds.
_WIDE = _tiff(
    _entries(
        "tescan",
        "PixelSizeX=1e-3\nMagnification=1.5e308\n",
        t256=2000,
        t257=1,
        t278=1,
        t279=2000,
    ),
    bytes(2000),
)


@fuzz(3.0)
@given(data=_odd_files())
@example(data=_WIDE)
@example(data=_REPEATED)
@example(data=_HOLLOW[0])
@example(data=_HOLLOW[1])
@example(data=_HOLLOW[2])
@example(data=_HOLLOW[3])
def test_odd_directories(place: Path, data: bytes) -> None:
    path = _written(place, data, _JEOL)
    attempt(lambda: _read(path))


@st.composite
def _odd_texts(draw: st.DrawFn) -> tuple[bytes, str | None]:
    """An intact image with the edited text of a maker."""
    maker = draw(st.sampled_from(sorted(_TEXTS)))
    text = draw(edited_text([_TEXTS[maker]], _PIECES))
    return _valid(maker, text), text if maker in _BESIDE else None


@fuzz(3.0)
@given(case=_odd_texts())
@example(case=(_valid("tescan", changed(_TESCAN, "=108.08", "=1e308")), None))
@example(case=(_valid("zeiss", changed(_ZEISS, "5.2 mm", "1e308 km")), None))
@example(case=(_valid("thermo_fisher", changed(_THERMO_FISHER, "=0.138", "=1e308")), None))
def test_edited_settings(place: Path, case: tuple[bytes, str | None]) -> None:
    path = _written(place, *case)
    attempt(lambda: _read(path))


@fuzz()
@given(
    number=st.sampled_from(["1", "-2.5", "1e-9", "", ".", "1e", "+", "1e999", "9" * 300]),
    middle=st.sampled_from(["", " ", "nm", "\t", "a", "\u00b5", "1"]),
    times=st.integers(0, 60_000),
    end=st.sampled_from(["", "m", "nm", "x", " m ", "\x00"]),
)
@example(number="1", middle=" ", times=60_000, end="x")
def test_numbers_with_long_texts(number: str, middle: str, times: int, end: str) -> None:
    text = number + "a" * (end == "x") + middle * times + end
    found = attempt(lambda: (plain_number(text), quantity(text, "m")))
    assert found is not None
    for value in found:
        assert value is None or math.isfinite(value)


@fuzz(0.2)
@given(cases=st.lists(_odd_texts(), min_size=1, max_size=2), rows=st.none() | st.integers(0, 12))
def test_import(folder: Path, cases: list[tuple[bytes, str | None]], rows: int | None) -> None:
    source, bag = folder / "source", folder / "imported"
    shutil.rmtree(source, ignore_errors=True)
    source.mkdir()
    for index, (data, text) in enumerate(cases):
        (source / f"{index}.tif").write_bytes(data)
        if text is not None:
            (source / f"{index}.txt").write_bytes(text.encode("utf-8", errors="surrogatepass"))
    given = RecordedFiles(source, databar_rows=rows)
    done = attempt(lambda: import_images(given, bag, overwrite=True))
    if done is None:
        return
    assert done.imported + len(done.skipped) == len(cases)
    assert all(len(line.splitlines()) == 1 for line in done.lines())
    with open_bag(bag) as reader:
        counts = {topic.name.rpartition("/")[2]: topic.count for topic in reader.topics}
    # Damage can leave a file that tells its tilt, and the others silent.
    assert 0 <= counts.pop("stage", 0) <= done.imported
    # Told once, and again where they change.
    assert 0 <= counts.pop("conditions", 0) <= done.imported
    assert counts == dict.fromkeys(["image_raw", "magnification", METADATA_TOPIC], done.imported)


@fuzz(0.2)
@given(data=damaged([*_FILES, _by_opencv(5), _by_opencv(32773), _by_opencv(1)]) | _odd_files())
def test_the_command_line(place: Path, capfd: pytest.CaptureFixture[str], data: bytes) -> None:
    path = _written(place, data, _JEOL)
    attempt(lambda: run_semcal(capfd, "info", path))


def _picture(suffix: str) -> bytes:
    done, data = cv2.imencode(suffix, _PIXELS)
    assert done
    return bytes(data)


def _tall() -> bytes:
    """A million rows, by the header."""
    data = bytearray(_picture(".bmp"))
    data[24] = 16
    return bytes(data)


@fuzz(0.5)
@example(data=_tall(), suffix=".bmp")
@given(
    data=damaged([_picture(suffix) for suffix in (".png", ".jpg", ".bmp", ".webp")]),
    suffix=st.sampled_from([".png", ".jpg", ".bmp", ".webp", ".gif"]),
)
def test_plain_pictures(folder: Path, data: bytes, suffix: str) -> None:
    path = folder / f"plain{suffix}"
    path.write_bytes(data)
    image = attempt(lambda: read_plain_image(path))
    if image is not None:
        assert image.ndim == 2
        assert image.size > 0
        assert image.dtype in (np.uint8, np.uint16)
