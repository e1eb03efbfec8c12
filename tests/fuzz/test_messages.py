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

"""Messages: whatever their fields hold, a value as promised or one clear line."""

from __future__ import annotations

import array
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semcal_ros.bridge.calibration import (
    MAX_TEXT_BYTES,
    calibration_text_from_message,
    fill_calibration_text,
)
from semcal_ros.bridge.drift import fill_drift, fill_drift_velocity
from semcal_ros.bridge.fields import optional_stamp_ns
from semcal_ros.bridge.images import (
    ENCODINGS,
    fill_image,
    image_from_message,
    to_gray,
    without_databar,
)
from semcal_ros.bridge.magnification import MAGNIFICATION_LIMITS, read_magnification
from semcal_ros.bridge.projection import (
    fill_camera_info,
    fill_projection,
    fill_stamped_projection,
    projection_from_message,
    stamped_projection_from_message,
)
from semcal_ros.config.config import MagnificationConfig, MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import SemcalError
from semcal_ros.files.bags.messages import blank_message, jazzy_types, serialize_message
from tests.helpers.fuzz_inputs import damaged, mostly, odd_leaves, odd_texts
from tests.helpers.fuzz_support import attempt, check_refusal, fuzz

_UINT32 = st.integers(0, 2**32 - 1)
_SMALL = st.integers(0, 12)
_BUFFERS = st.one_of(
    st.binary(max_size=64),
    st.binary(max_size=64).map(bytearray),
    st.binary(max_size=64).map(lambda data: array.array("B", data)),
    st.binary(max_size=64).map(lambda data: np.frombuffer(data, np.uint8)),
    st.binary(max_size=64).map(lambda data: np.frombuffer(data, np.uint8)[::2]),
    st.lists(st.floats(), max_size=4).map(np.array),
    st.lists(st.integers(0, 255), max_size=4),
    st.binary(max_size=16).map(memoryview),
)
# What a field may hold whose type a recording declares differently from ROS.
_ODD_FIELDS = st.one_of(
    # No field has more than 64 bits.
    odd_leaves.filter(lambda value: not isinstance(value, int) or abs(value) < 2**64),
    _BUFFERS,
    st.just(SimpleNamespace()),
    st.lists(st.just(SimpleNamespace()), max_size=2),
)


def _stamped(sec: Any = 1_700_000_000, nanosec: Any = 5) -> Any:
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id="sem")


@st.composite
def _images(draw: st.DrawFn) -> SimpleNamespace:
    """An image that fits, with padding and either byte order, of which up to two fields are changed."""
    encoding = draw(st.sampled_from(sorted(ENCODINGS)))
    height, width, padding = (
        draw(st.integers(1, 6)),
        draw(st.integers(1, 6)),
        draw(st.integers(0, 5)),
    )
    step = width * ENCODINGS[encoding].bytes_per_pixel + padding
    message = SimpleNamespace(
        header=_stamped(),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=draw(st.integers(0, 1)),
        step=step,
        data=draw(st.binary(min_size=step * height, max_size=step * height)),
    )
    for _ in range(draw(st.integers(0, 2))):
        name = draw(
            st.sampled_from(["height", "width", "encoding", "is_bigendian", "step", "data"])
        )
        if draw(st.booleans()):
            value = draw(_ODD_FIELDS)
        elif name == "encoding":
            value = draw(st.sampled_from([*sorted(ENCODINGS), "16UC1", "MONO8", "mono8; jpeg"]))
        elif name == "data":
            value = draw(_BUFFERS)
        else:
            value = draw(_SMALL | _UINT32)
        setattr(message, name, value)
    if draw(st.integers(0, 15)) == 0:
        delattr(message, draw(st.sampled_from(sorted(vars(message)))))
    return message


_VALID = {
    "height": 1,
    "width": 1,
    "encoding": "mono16",
    "is_bigendian": 0,
    "step": 2,
    "data": b"12",
}


@fuzz(4.0)
@given(message=_images(), rows=st.integers(-1, 7))
@example(message=SimpleNamespace(**{**_VALID, "encoding": []}), rows=0)
@example(message=SimpleNamespace(**{**_VALID, "height": ""}), rows=0)
@example(message=SimpleNamespace(**{**_VALID, "step": float("inf")}), rows=0)
@example(message=SimpleNamespace(**{**_VALID, "is_bigendian": np.zeros(2)}), rows=0)
def test_image_from_message(message: SimpleNamespace, rows: int) -> None:
    def read() -> tuple[np.ndarray, np.ndarray]:
        return image_from_message(message), without_databar(image_from_message(message), rows)

    found = attempt(read)
    if found is None:
        return
    image, cut = found
    pixel = ENCODINGS[message.encoding]
    shape = (int(message.height), int(message.width))
    assert image.shape == (shape if pixel.channels == 1 else (*shape, pixel.channels))
    assert image.dtype == pixel.dtype
    assert image.dtype.isnative
    assert not image.flags.writeable
    assert cut.shape[0] == shape[0] - rows > 0
    # The pixels one by one, as the standard defines step, byte order and channels.
    order = ">" if message.is_bigendian else "<"
    raw, size = bytes(message.data), pixel.dtype.itemsize
    for row, column, channel in [(0, 0, 0), (shape[0] - 1, shape[1] - 1, pixel.channels - 1)]:
        at = row * int(message.step) + (column * pixel.channels + channel) * size
        (value,) = np.frombuffer(raw[at : at + size], pixel.dtype.newbyteorder(order))
        got = image[row, column] if pixel.channels == 1 else image[row, column, channel]
        np.testing.assert_array_equal(got, value)
    if pixel.channels == 3:
        assert to_gray(image, message.encoding).shape == shape


@st.composite
def _arrays(draw: st.DrawFn) -> tuple[str, np.ndarray]:
    encoding = draw(st.sampled_from([*sorted(ENCODINGS), "16UC1", "MONO8", "", "bgr8 "]))
    known = ENCODINGS.get(encoding, ENCODINGS["mono8"])
    dtype = draw(
        st.sampled_from(
            [known.dtype] * 5 + [np.dtype(t) for t in (">u2", "f8", "i4", "?", "c8", "O")]
        )
    )
    shape = draw(hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=5))
    shape += (known.channels,) if known.channels > 1 else ()
    if draw(st.integers(0, 7)) == 0:
        shape = tuple(draw(st.lists(st.integers(0, 4), max_size=4)))
    count = math.prod(shape)
    values = np.arange(count).reshape(shape).astype(dtype)
    return encoding, values[::-1] if draw(st.booleans()) and values.ndim else values


@fuzz(0.5)
@given(case=_arrays(), sec=st.integers(-(2**31), 2**31 - 1), frame=st.text(max_size=5))
def test_an_image_survives_filling_and_storage(
    case: tuple[str, np.ndarray], sec: int, frame: str
) -> None:
    encoding, image = case
    message = blank_message("sensor_msgs/msg/Image")

    def store() -> np.ndarray:
        fill_image(message, image, encoding, _stamped(sec))
        stored = jazzy_types().deserialize_cdr(serialize_message(message), "sensor_msgs/msg/Image")
        assert optional_stamp_ns(stored) == sec * 10**9 + 5
        return image_from_message(stored)

    again = attempt(store)
    if again is not None:
        np.testing.assert_array_equal(again, image)
        assert again.dtype == image.dtype.newbyteorder("=")


@st.composite
def _stamp_holders(draw: st.DrawFn) -> Any:
    """A time, a header, a message with a header, or something like it."""
    number = st.integers(-(2**31), 2**31 - 1) | st.integers(0, 10**9) | _ODD_FIELDS
    stamp: Any = SimpleNamespace(sec=draw(number), nanosec=draw(number))
    if draw(st.integers(0, 9)) == 0:
        stamp = draw(_ODD_FIELDS)
    for name in ["stamp", "header"][: draw(st.integers(0, 2))]:
        stamp = SimpleNamespace(**{name: stamp})
    return stamp


@fuzz(3.0)
@given(message=_stamp_holders())
@example(message=SimpleNamespace(sec="a", nanosec=0))
@example(message=SimpleNamespace(sec=float("nan"), nanosec=0))
@example(message=SimpleNamespace(sec=2**40, nanosec=0))
def test_stamps(message: Any) -> None:
    stamp_ns = attempt(lambda: optional_stamp_ns(message))
    if stamp_ns is not None:
        assert isinstance(stamp_ns, int)
        assert -(2**31) * 10**9 <= stamp_ns < 2**31 * 10**9


@st.composite
def _magnification_configs(draw: st.DrawFn) -> MicroscopeConfig:
    """A configuration as a msg_configs file may define it."""
    quantity = draw(st.sampled_from(["magnification", "pixel_size", "field_width"]))
    width = st.none() | st.just(0.12) | st.floats(0.05, 0.6) | st.floats(1e-300, 100.0)
    source = MagnificationConfig(
        quantity=quantity,
        type="lab_msgs/msg/State",
        field=draw(
            st.just("data")
            | st.just("a.b[1].c")
            | st.sampled_from(["data", "data[0]", "data[7]", "a.b", "a.b[0]", "data.real", "a[0]"])
            | st.integers(1, 249).map(lambda digits: f"data[{'9' * digits}]")
        ),
        unit="1" if quantity == "magnification" else draw(st.sampled_from(["m", "um", "nm", "pm"])),
        display_width_m=draw(width) if quantity == "magnification" else None,
        image_width_px=draw(st.none() | st.integers(1, 10**6))
        if quantity == "pixel_size"
        else None,
    )
    return MicroscopeConfig("lab", draw(width) or 0.12, magnification=source)


_NUMBERS = mostly(
    st.floats(1.0, 1e5),
    st.floats(1e-9, 1.0),
    st.floats(),
    st.sampled_from([np.float32(500.0), np.float64(2e3), np.int64(7), np.bool_(True), np.uint8(9)]),
    _ODD_FIELDS,
    st.lists(st.floats(1e-9, 1e5), max_size=3).map(np.array),
)


@st.composite
def _states(draw: st.DrawFn) -> Any:
    inner = draw(_NUMBERS)
    message = SimpleNamespace(
        data=draw(_NUMBERS), a=SimpleNamespace(b=[inner, SimpleNamespace(c=inner)])
    )
    seconds = st.integers(0, 2**31 - 1)
    header = draw(st.integers(0, 8))
    if header < 5:
        message.header = draw(st.builds(_stamped, seconds, st.integers(0, 10**9 + 3)))
    elif header == 5:
        message.header = draw(_ODD_FIELDS | st.builds(_stamped, _UINT32, st.integers(0, 2**32 - 1)))
    return message


@fuzz(3.0)
@given(
    config=_magnification_configs(), message=_states(), width=st.none() | st.integers(-1, 70_000)
)
@example(  # an index that does not fit a machine word
    config=MicroscopeConfig(
        "a", 0.1, magnification=MagnificationConfig(field="data[99999999999999999999]")
    ),
    message=SimpleNamespace(data=np.zeros(1)),
    width=None,
)
def test_magnifications(config: MicroscopeConfig, message: Any, width: int | None) -> None:
    g = attempt(lambda: read_magnification(message, config).magnification(width))
    if g is not None:
        assert isinstance(g, float)
        assert MAGNIFICATION_LIMITS[0] <= g <= MAGNIFICATION_LIMITS[1]


@fuzz(0.5)
@given(
    text=mostly(st.text(min_size=1), odd_texts, _ODD_FIELDS),
    size=mostly(st.just(1), st.just(MAX_TEXT_BYTES)),
)
@example(text=1.5, size=1)
@example(text="\ud800", size=1)
def test_calibration_texts(text: Any, size: int) -> None:
    message = SimpleNamespace(
        data=text * size if isinstance(text, str) and len(text) == 1 else text
    )
    found = attempt(lambda: calibration_text_from_message(message))
    if found is not None:
        assert found is message.data
        assert found.strip()
        again = SimpleNamespace(data="")
        try:
            fill_calibration_text(again, found)
        except SemcalError as error:
            check_refusal(error)
        else:
            assert again.data == found


_FEW_NUMBERS = st.one_of(
    st.lists(st.floats(), max_size=5),
    st.lists(st.lists(st.floats(), min_size=2, max_size=4), max_size=4),
    hnp.arrays(np.float64, st.sampled_from([(2,), (2, 2), (4, 4), (4,), (0,), (3, 3)])),
    odd_leaves,
)
_VARIANCES = st.floats(0.0, 1e-6) | st.floats(0.0, 1e300)
_COVARIANCES = mostly(
    st.lists(_VARIANCES, min_size=4, max_size=4).map(lambda v: np.diag(v) + 0.1 * min(v)),
    st.tuples(_VARIANCES, st.floats()).map(np.diag),
    _FEW_NUMBERS,
)
_DISTANCES = st.floats(-1e-3, 1e-3)
_PAIRS = mostly(st.tuples(_DISTANCES, _DISTANCES), _FEW_NUMBERS)


@fuzz()
@given(drift=_PAIRS, covariance=_COVARIANCES, velocity=st.booleans())
@example(drift=(0.0, 0.0), covariance=[[1.0, 0.0], [0.0]], velocity=False)
@example(drift="", covariance=np.eye(2), velocity=True)
@example(drift=(0.0, 0.0), covariance=np.diag([1.0, np.inf]), velocity=False)
def test_drift(drift: Any, covariance: Any, velocity: bool) -> None:
    kind = "Twist" if velocity else "Pose"
    message = blank_message(f"geometry_msgs/msg/{kind}WithCovarianceStamped")

    def fill() -> Any:
        (fill_drift_velocity if velocity else fill_drift)(message, drift, covariance, _stamped())
        return message.twist if velocity else message.pose

    filled = attempt(fill)
    if filled is not None:
        spread = np.asarray(filled.covariance).reshape(6, 6)
        vector = filled.twist.linear if velocity else filled.pose.position
        assert math.isfinite(vector.x)
        assert math.isfinite(vector.y)
        assert np.all(np.isfinite(spread))
        assert np.all(np.diag(spread) >= 0.0)
        assert len(serialize_message(message)) > 6 * 6 * 8


@st.composite
def _cameras(draw: st.DrawFn) -> ScanCamera:
    wide = st.floats(-1e300, 1e300)
    size = st.integers(1, 10**6)
    try:
        return ScanCamera(
            draw(st.floats(1.0, 1e8)), draw(st.floats(1.0, 1e12) | wide), draw(st.floats(0.5, 2.0) | wide),
            draw(st.floats(-0.1, 0.1) | wide), draw(st.floats(0, 1e3) | wide), draw(st.floats(0, 1e3) | wide),
            draw(st.floats(0.0, 1e3) | wide), draw(st.floats(-1, 1)), draw(st.floats(-1, 1)),
            draw(st.floats(0, 1e3)), draw(st.floats(0, 1e3)), 256.0, draw(size), draw(size),
        )  # fmt: skip
    except SemcalError:
        return ScanCamera.nominal(1000.0, 512, 512, 0.12)


@fuzz()
@given(camera=st.none() | _cameras(), width=st.integers(1, 2**31), height=st.integers(1, 2**31))
@example(
    camera=ScanCamera(1e3, 1e7, 1.0, 0.0, 1.0, 1.0, 1e-307, 0.0, 0.0, 1.0, 1.0, 4.0, 8, 8),
    width=8,
    height=8,
)
def test_cameras(camera: ScanCamera | None, width: int, height: int) -> None:
    info = blank_message("sensor_msgs/msg/CameraInfo")
    projection = blank_message("std_msgs/msg/Float64MultiArray")
    stamped = blank_message("sensor_msgs/msg/Image")

    def fill() -> bool:
        fill_camera_info(info, camera, _stamped(), width, height)
        if camera is not None:
            fill_projection(projection, camera)
            expected = camera.rectified.P_affine
            np.testing.assert_array_equal(projection_from_message(projection), expected)
        fill_stamped_projection(stamped, camera, _stamped(), width, height)
        assert stamped_projection_from_message(stamped).shape == (3, 4)
        return True

    if attempt(fill):
        assert (info.width, info.height, len(info.d)) == (width, height, 5)
        assert np.all(np.isfinite(info.k))
        assert np.all(np.isfinite(info.p))
        assert info.k[8] in (0.0, 1.0)
        assert len(serialize_message(info)) > 300


@fuzz()
@given(
    data=mostly(
        st.lists(st.floats(-1e3, 1e3), min_size=12, max_size=13),
        st.lists(st.floats(), max_size=16),
        _ODD_FIELDS,
    ),
    offset=mostly(st.integers(0, 1), st.integers(-2, 3), _ODD_FIELDS),
)
@example(data=[1.0] * 10, offset=-2)
@example(data=[1.0] * 12, offset="")
@example(data=[[1.0, 2.0], [3.0]], offset=0)
def test_projections(data: Any, offset: Any) -> None:
    message = SimpleNamespace(data=data, layout=SimpleNamespace(data_offset=offset, dim=[]))
    matrix = attempt(lambda: projection_from_message(message))
    if matrix is not None:
        assert matrix.shape == (3, 4)
        assert np.all(np.isfinite(matrix))


def _stored(name: str) -> bytes:
    message = blank_message(name)
    if name == "sensor_msgs/msg/Image":
        image = np.arange(24, dtype=np.uint8).reshape(4, 6)
        fill_image(message, image, "mono8", _stamped())
    elif name == "std_msgs/msg/String":
        message.data = "format: semcal-calibration"
    elif name == "std_msgs/msg/Float64MultiArray":
        fill_projection(message, ScanCamera.nominal(1000.0, 512, 512, 0.12))
    return bytes(serialize_message(message))


_TYPES = [
    "sensor_msgs/msg/Image",
    "std_msgs/msg/String",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Float64MultiArray",
    "sensor_msgs/msg/CameraInfo",
]


@fuzz(2.0)
@given(
    case=st.sampled_from(_TYPES).flatmap(
        lambda name: st.tuples(st.just(name), damaged([_stored(name)]))
    )
)
def test_what_a_damaged_message_holds(case: tuple[str, bytes]) -> None:
    """Serialised bytes with something wrong: those that the decoder takes have odd fields."""
    name, data = case
    try:
        message = jazzy_types().deserialize_cdr(data, name)
    except Exception:  # the reader of recordings has a property of its own
        message = blank_message(name)
    config = MicroscopeConfig("lab", 0.12)

    def read() -> bool:
        optional_stamp_ns(message)
        if name == "sensor_msgs/msg/Image":
            image_from_message(message)
        elif name == "std_msgs/msg/String":
            calibration_text_from_message(message)
        elif name == "std_msgs/msg/Float64MultiArray":
            projection_from_message(message)
        else:
            read_magnification(message, config)
        return True

    attempt(read)


def _stored_projection() -> bytes:
    message = blank_message("sensor_msgs/msg/Image")
    camera = ScanCamera.nominal(1000.0, 512, 512, 0.12)
    fill_stamped_projection(message, camera, _stamped(), 512, 512)
    return bytes(serialize_message(message))


@fuzz()
@given(data=damaged([_stored_projection()]))
def test_a_damaged_stamped_projection(data: bytes) -> None:
    try:
        message = jazzy_types().deserialize_cdr(data, "sensor_msgs/msg/Image")
    except Exception:  # as above
        message = blank_message("sensor_msgs/msg/Image")
    matrix = attempt(lambda: stamped_projection_from_message(message))
    if matrix is not None:
        assert matrix.shape == (3, 4)
        assert np.all(np.isfinite(matrix))
