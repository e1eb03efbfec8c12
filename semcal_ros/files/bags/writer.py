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

"""Write a ROS 2 recording completely or not at all.

The bags of this package: corrected frames, one message of each kind per frame; simulated frames, with their ground
truth beside them; and pictures of the grid as they are taken, which `semcal calibrate` reads.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from semcal_ros.bridge.calibration import fill_calibration_text
from semcal_ros.bridge.conditions import CONDITIONS_TYPE, Conditions, fill_conditions
from semcal_ros.bridge.drift import fill_drift, fill_drift_velocity, rotation_of, rotation_rate_of
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.bridge.projection import fill_camera_info, fill_projection, fill_stamped_projection
from semcal_ros.config.config import IMAGE_TYPE, STAGE_TYPE, MicroscopeConfig
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.held_values import CONDITIONS_TOPIC
from semcal_ros.files.bags.messages import (
    blank_message,
    check_recordable,
    conditions_message,
    jazzy_types,
    magnification_message,
    message_type_name,
    microscope_topic,
    serialize_message,
    stage_message,
)
from semcal_ros.files.bags.reader import LIBRARY_ERRORS, one_line
from semcal_ros.files.recordings import RecordedFrame

if TYPE_CHECKING:
    from typing_extensions import Self


_METADATA_VERSION: Final = 9  # what Jazzy and Kilted write
_NO_LIMIT = QosTime(9223372036, 854775807)  # how DDS spells an infinite duration
_BAG_SUFFIXES = {".mcap", ".db3", ".zstd", ".yaml", ".json", ".csv"}

_TOPICS = {
    "image_rect": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "magnification": "std_msgs/msg/Float64",
    "drift": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "drift_velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "projection": "std_msgs/msg/Float64MultiArray",
    "projection_stamped": "sensor_msgs/msg/Image",
    "calibration": "std_msgs/msg/String",
}
_LATCHED = ("projection", "calibration")

SIMULATED_START_NS = 1_700_000_000_000_000_000
"""Stamp of time zero, ns: arbitrary but fixed, which keeps recordings of one seed identical."""

# 1 ms: magnification and stage are recorded just before the scan of the first frame they belong to.
_LEAD_NS = 1_000_000
_FRAME_ID = "sem_optical"


def _qos(latched: bool, depth: int) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_NO_LIMIT,
        lifespan=_NO_LIMIT,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_NO_LIMIT,
        avoid_ros_namespace_conventions=False,
    )


def check_replaceable(path: Path, overwrite: bool) -> None:
    """Refuse to write to a path that exists, or that is not a recording and must not be deleted.

    Raises
    ------
    BagError
        ``path`` exists and ``overwrite`` is false, or it is something other than a recording.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise BagError(
            f"{path} exists", expected="a new path", do="choose another name, or --overwrite"
        )
    if path.is_dir() and not path.is_symlink():
        names = list(path.iterdir())
        foreign = [p.name for p in names if p.is_dir() or p.suffix not in _BAG_SUFFIXES]
        if not names or ((path / "metadata.yaml").exists() and not foreign):
            return
    raise BagError(
        f"{path} is not a recording, so it is not replaced",
        expected="a new path or an existing rosbag2 folder",
        do="choose another name or remove it yourself",
    )


class BagWriter:
    """Context manager that writes a rosbag2 folder (mcap), readable by ``ros2 bag``.

    Everything goes to a temporary folder beside the target, which is renamed only when the block ends
    without an error; otherwise nothing remains and an existing recording stays as it was.

    Parameters
    ----------
    path
        Folder to make.
    overwrite
        Replace an existing recording, at the very end.
    compress
        Compress chunks with zstd inside the mcap file.

    Raises
    ------
    BagError
        The path exists (see :func:`check_replaceable`), cannot be written to, or the disk is full.
    """

    def __init__(
        self, path: str | Path, *, overwrite: bool = False, compress: bool = False
    ) -> None:
        self.path = Path(os.path.abspath(path))
        self._overwrite = overwrite
        self._compress = compress
        self._connections: dict[str, Connection] = {}
        self._scratch: Path | None = None
        self._writer: Writer | None = None

    def __enter__(self) -> Self:
        check_replaceable(self.path, self._overwrite)
        with self._writing():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Path(
                tempfile.mkdtemp(prefix=f".{self.path.name}.", suffix=".tmp", dir=self.path.parent)
            )
            # The library names the storage file after its folder, so this has its final name.
            writer = Writer(
                self._scratch / self.path.name,
                version=_METADATA_VERSION,
                storage_plugin=StoragePlugin.MCAP,
            )
            if self._compress:
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            writer.open()
        self._writer = writer
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        writer, self._writer = self._writer, None
        scratch, self._scratch = self._scratch, None
        if writer is None or scratch is None:
            return
        try:
            if kind is not None:
                with contextlib.suppress(*LIBRARY_ERRORS):
                    writer.abort()
                return
            with self._writing():
                writer.close()
                check_replaceable(self.path, self._overwrite)
                _move_into_place(scratch / self.path.name, self.path, scratch)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except BagError:
            raise
        except LIBRARY_ERRORS as error:
            if self._writer is None and self._scratch is not None:
                shutil.rmtree(self._scratch, ignore_errors=True)
            raise BagError(
                f"cannot write {self.path}: {one_line(error)}",
                expected="a writable folder with enough space",
                do="free space or choose another place",
            ) from error

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise BagError(
                f"the writer of {self.path} is not open", do="use it in a with statement"
            )
        return self._writer

    def add_topic(
        self, name: str, typename: str, *, latched: bool = False, depth: int = 10
    ) -> None:
        """Declare a topic; repeating it with the same type does nothing.

        Parameters
        ----------
        name
            Absolute topic name.
        typename
            Message type such as ``std_msgs/msg/Float64``.
        latched
            Offer transient-local durability, so that late subscribers of a replay get the last
            message.
        depth
            History depth that is offered.

        Raises
        ------
        BagError
            The topic exists with another type, or the type is unknown.
        """
        writer = self._open_writer()
        if name in self._connections:
            have = self._connections[name].msgtype
            if have != typename:
                raise BagError(f"topic {name} has type {have}", expected=typename)
            return
        if typename not in jazzy_types().fielddefs:
            raise BagError(f"message type {typename!r}", expected="a common ROS 2 message type")
        with self._writing():
            self._connections[name] = writer.add_connection(
                name,
                typename,
                typestore=jazzy_types(),
                offered_qos_profiles=[_qos(latched, depth)],
            )

    def write(self, topic: str, log_time_ns: int, message: Any) -> None:
        """Append a message; an undeclared topic is declared by the message's type, not latched.

        Raises
        ------
        BagError
            A value does not fit its field, the topic has another type, or the disk is full.
        """
        typename = message_type_name(message)
        self.add_topic(topic, typename)
        try:
            data = serialize_message(message)
        except LIBRARY_ERRORS as error:
            raise BagError(
                f"a {typename} for {topic} cannot be stored: {one_line(error)}",
                expected="values that fit its fields",
            ) from error
        self.write_raw(topic, log_time_ns, data)

    def write_raw(self, topic: str, log_time_ns: int, data: bytes | memoryview) -> None:
        """Append CDR bytes to a topic that :meth:`add_topic` declared."""
        writer = self._open_writer()
        if topic not in self._connections:
            raise BagError(f"topic {topic} is not declared", do="call add_topic first")
        if not 0 <= log_time_ns < 2**63:
            raise BagError(
                f"time {log_time_ns} ns on {topic}", expected="0 to 2^63 - 1 nanoseconds"
            )
        with self._writing():
            writer.write(self._connections[topic], int(log_time_ns), data)

    def write_text(self, name: str, text: str) -> None:
        """Put a text file, such as ``truth.json``, beside the storage file in the folder."""
        self._open_writer()
        if (
            self._scratch is None
            or Path(name).name != name
            or Path(name).suffix not in (".json", ".csv")
        ):
            raise BagError(
                f"sidecar {name!r}", expected="a plain file name that ends in .json or .csv"
            )
        with self._writing():
            (self._scratch / self.path.name / name).write_text(text, encoding="utf-8")


def _move_into_place(new: Path, target: Path, scratch: Path) -> None:
    """Rename ``new``; an existing recording is moved aside, and back on failure."""
    if not target.exists():
        os.rename(new, target)
        return
    aside = scratch / "replaced"
    os.rename(target, aside)
    try:
        os.rename(new, target)
    except OSError:
        os.rename(aside, target)
        raise


class CorrectedBagWriter:
    """Writes what ``stream_corrector`` and ``parameter_server`` would publish.

    Parameters
    ----------
    writer
        An open bag.
    namespace
        Namespace of the topics, without a trailing slash.
    calibration_text
        Text of the calibration file, for the topic ``calibration``.
    """

    def __init__(self, writer: BagWriter, namespace: str, calibration_text: str) -> None:
        self._writer = writer
        self._namespace = namespace
        self._calibration_text = calibration_text
        self._magnification: float | None = None

    def write(
        self, frame: RecordedFrame, image: AnyImage, camera: ScanCamera, update: DriftUpdate | None
    ) -> None:
        """Write one frame.

        Parameters
        ----------
        frame
            The frame as recorded.
        image
            The corrected image.
        camera
            Its camera.
        update
            Its drift; None if the drift was not removed.
        """
        header = blank_message("std_msgs/msg/Header")
        fill_header(header, frame.stamp_ns, frame.frame_id)
        when = frame.log_time_ns
        if frame.magnification != self._magnification:
            self._write_magnification(frame, camera)
        rectified = blank_message(_TOPICS["image_rect"])
        fill_image(rectified, image, frame.encoding, header)
        self._write("image_rect", when, rectified)
        info = blank_message(_TOPICS["camera_info"])
        fill_camera_info(info, camera, header, image.shape[1], image.shape[0])
        self._write("camera_info", when, info)
        matrix = blank_message(_TOPICS["projection_stamped"])
        fill_stamped_projection(matrix, camera, header, image.shape[1], image.shape[0])
        self._write("projection_stamped", when, matrix)
        if update is not None:
            drift = blank_message(_TOPICS["drift"])
            fill_drift(drift, update.drift_m, update.covariance, header, rotation_of(update))
            self._write("drift", when, drift)
            velocity = blank_message(_TOPICS["drift_velocity"])
            fill_drift_velocity(
                velocity, update.velocity_m_s, update.covariance, header, rotation_rate_of(update)
            )
            self._write("drift_velocity", when, velocity)

    def _write_magnification(self, frame: RecordedFrame, camera: ScanCamera) -> None:
        if self._magnification is None:
            text = blank_message(_TOPICS["calibration"])
            fill_calibration_text(text, self._calibration_text)
            self._write("calibration", frame.log_time_ns, text)
        self._magnification = frame.magnification
        magnification = blank_message(_TOPICS["magnification"])
        magnification.data = frame.magnification
        self._write("magnification", frame.log_time_ns, magnification)
        projection = blank_message(_TOPICS["projection"])
        fill_projection(projection, camera)
        self._write("projection", frame.log_time_ns, projection)

    def _write(self, topic: str, log_time_ns: int, message: Any) -> None:
        name = f"{self._namespace}/{topic}"
        latched = topic in _LATCHED
        self._writer.add_topic(name, _TOPICS[topic], latched=latched, depth=1 if latched else 10)
        self._writer.write(name, log_time_ns, message)


class SimulatedFrame(Protocol):
    """What is known of a frame before it is drawn."""

    @property
    def start_time_s(self) -> float:
        """When the scan of the frame begins."""

    @property
    def magnification(self) -> float:
        """Magnification at which it is scanned."""


@runtime_checkable
class StagedFrame(Protocol):
    """A frame of a stage that says where it is."""

    @property
    def joints(self) -> Mapping[str, float] | None:
        """Positions of its joints by name, rad and m; None for a stage that says nothing."""


def write_simulated(
    folder: Path,
    frames: Iterable[SimulatedFrame],
    images: Iterable[NDArray[Any]],
    truth: Any,
    *,
    conditions: Mapping[str, float | str] | None = None,
    delay_s: float = 0.0,
    overwrite: bool = False,
) -> None:
    """Write frames to a bag with the topics of ``virtual_sem``, and ``truth.json``.

    Parameters
    ----------
    folder
        The bag.
    frames, images
        The same number of both; images of 8 or 16 bit, rendered while they are written. Frames that are
        :class:`StagedFrame` say where the stage is.
    truth
        Plain data in SI units.
    conditions
        How all frames are taken, by the keys of :mod:`semcal_ros.bridge.conditions`; None for a bag that says nothing.
    delay_s
        Delay from the stamp of a frame to its publication.
    overwrite
        Whether an existing bag may be replaced.

    Raises
    ------
    BagError
        The folder exists and ``overwrite`` is not set, or it cannot be written; then no part of it remains.
    """
    magnification, joints = None, None
    with BagWriter(folder, overwrite=overwrite) as writer:
        writer.add_topic("/sem/magnification", "std_msgs/msg/Float64", latched=True, depth=1)
        for frame, pixels in zip(frames, images, strict=True):
            stamp_ns = SIMULATED_START_NS + round(frame.start_time_s * 1e9)
            if conditions and magnification is None:
                message = blank_message(CONDITIONS_TYPE)
                fill_conditions(message, conditions, "virtual SEM")
                writer.add_topic("/sem/conditions", CONDITIONS_TYPE, latched=True, depth=1)
                writer.write("/sem/conditions", stamp_ns - _LEAD_NS, message)
            if frame.magnification != magnification:
                magnification = frame.magnification
                value = blank_message("std_msgs/msg/Float64")
                value.data = magnification
                writer.write("/sem/magnification", stamp_ns - _LEAD_NS, value)
            said = frame.joints if isinstance(frame, StagedFrame) else None
            if said is not None and said != joints:
                joints = said
                writer.add_topic("/sem/stage", STAGE_TYPE, latched=True, depth=1)
                writer.write("/sem/stage", stamp_ns - _LEAD_NS, _stage_message(said, stamp_ns))
            header = blank_message("std_msgs/msg/Header")
            fill_header(header, stamp_ns, _FRAME_ID)
            image = blank_message("sensor_msgs/msg/Image")
            fill_image(image, pixels, "mono8" if pixels.dtype.itemsize == 1 else "mono16", header)
            writer.write("/sem/image_raw", stamp_ns + round(delay_s * 1e9), image)
        writer.write_text("truth.json", json.dumps(truth, indent=1))


def _stage_message(joints: Mapping[str, float], stamp_ns: int) -> Any:
    message = blank_message(STAGE_TYPE)
    fill_header(message.header, stamp_ns - _LEAD_NS, "")
    message.name = list(joints)
    message.position = np.array(list(joints.values()), dtype=np.float64)
    return message


class ViewRecorder:
    """Context manager; the bag appears when the block ends without an error, as that of :class:`BagWriter`.

    Parameters
    ----------
    path
        Folder to make; it must not exist.
    config
        Topics and types of the recording.

    Raises
    ------
    BagError
        The path exists or cannot be written to, or the configuration has messages that cannot be made.
    """

    def __init__(self, path: Path, config: MicroscopeConfig) -> None:
        check_recordable(config)
        self._config = config
        self._writer = BagWriter(path)
        self._written: dict[str, dict[str, float | str] | StageReading | float] = {}
        self._last_ns = -1

    @property
    def path(self) -> Path:
        """The folder that is made."""
        return self._writer.path

    def __enter__(self) -> Self:
        self._writer.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def write(
        self,
        image: AnyImage,
        encoding: str,
        stamp_ns: int,
        magnification: float,
        stage: StageReading | None,
        conditions: Conditions,
    ) -> None:
        """Append a picture, and what has changed since the one before.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) without data bar; the recording has a black one where the configuration states one.
        encoding
            As in sensor_msgs/Image.
        stamp_ns
            Stamp of the image; must rise.
        magnification, stage, conditions
            Under which it was taken.
        """
        if stamp_ns <= self._last_ns:
            raise BagError(
                f"a picture of {stamp_ns} ns after one of {self._last_ns} ns",
                expected="stamps that rise",
            )
        config = self._config
        changed_ns = max(self._last_ns + 1, stamp_ns - 1)
        self._last_ns = stamp_ns
        if self._is_news("magnification", magnification):
            number = magnification_message(config, magnification, image.shape[1])
            self._write(config.magnification.topic, changed_ns, number, config.magnification.type)
        if config.stage is not None and self._is_news("stage", stage):
            joints = stage_message(config.stage, stage, changed_ns)
            self._write(config.stage.topic, changed_ns, joints, config.stage.type)
        if self._is_news("conditions", conditions.topic_values()):
            stated = conditions_message(conditions, config.name)
            self._write(CONDITIONS_TOPIC, changed_ns, stated, CONDITIONS_TYPE)
        message, header = blank_message(IMAGE_TYPE), blank_message("std_msgs/msg/Header")
        fill_header(header, stamp_ns, config.frame_id)
        fill_image(message, self._with_databar(image), encoding, header)
        self._writer.write(microscope_topic(config.image.topic), stamp_ns, message)

    def _with_databar(self, image: AnyImage) -> AnyImage:
        rows = self._config.image.databar_rows or 0
        blank = np.zeros((rows, *image.shape[1:]), dtype=image.dtype)
        return np.concatenate([image, blank]) if rows else image

    def _is_news(self, key: str, value: Any) -> bool:
        news = bool(self._written.get(key) != value)
        self._written[key] = value
        return news

    def _write(self, topic: str, time_ns: int, message: Any, kind: str) -> None:
        name = microscope_topic(topic)
        self._writer.add_topic(name, kind, latched=True, depth=1)
        self._writer.write(name, time_ns, message)
