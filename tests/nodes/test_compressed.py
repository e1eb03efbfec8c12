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

"""The compressed stream: exact, by the names of image_transport, only for those who listen, and never in the way."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import CompressedImage, Image

from semcal_ros.bridge.compressed import fill_compressed, image_from_compressed
from semcal_ros.bridge.images import image_from_message
from semcal_ros.config.config import COMPRESSED_IMAGE_TYPE, load_config
from tests.helpers.node_scenes import image_message, stamp_of, texture
from tests.helpers.ros_process import PATIENT, RELIABLE, NodeProcess, Peer, running

NODE = "/sem/rectifier"
TOPIC = "image_rect/compressed"
WIDE = texture(1).astype(np.uint16) * 257 + 3


@dataclass
class Bench:
    """The node, what goes in, and the images that come out as they are."""

    peer: Peer
    node: NodeProcess
    input: Any
    images: list[Any]
    stamp_s: float = 0.0

    def send(self, image: Any, encoding: str = "mono8") -> float:
        """Publish an image; its stamp."""
        self.stamp_s += 1.0
        self.input.publish(image_message(image, self.stamp_s, encoding))
        return self.stamp_s

    def listen(self) -> list[Any]:
        """The compressed images from now on."""
        received = self.peer.collect(CompressedImage, TOPIC)
        self.peer.wait_heard(NODE, TOPIC)
        return received

    def state(self, key: str) -> str:
        return self.peer.state(NODE).get(key, "")

    def set(self, name: str, value: int | str) -> Any:
        kind = ParameterType.PARAMETER_STRING
        message = ParameterValue(type=kind, string_value=str(value))
        if isinstance(value, int):
            message = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
        return self.peer.set_parameter(NODE, f"image_rect.compressed.{name}", message)


def _feed(peer: Peer, message_type: Any, topic: str) -> Any:
    """A publisher to which the node is subscribed."""
    publisher = peer.node.create_publisher(message_type, topic, RELIABLE)
    peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
    return publisher


@pytest.fixture
def bench(peer: Peer) -> Iterator[Bench]:
    images = peer.collect(Image, "image_rect")
    # Without a calibration it passes images on as they are.
    with running("rectifier", PATIENT) as node:
        peer.wait_heard(NODE, "image_rect")
        yield Bench(peer, node, _feed(peer, Image, "image_raw"), images)


def test_compressed_only_for_those_who_listen_and_then_exactly(bench: Bench) -> None:
    bench.send(texture())
    bench.peer.wait_for(lambda: bench.images, "an image")
    bench.peer.wait_for(lambda: bench.state("received") == "1", "the report on it")
    assert bench.state(f"subscribers.{TOPIC}") == "0"
    assert bench.state(f"compressed.{TOPIC}") == ""

    received = bench.listen()
    for picture, encoding in ((texture(), "mono8"), (WIDE, "mono16")):
        count = len(received) + 1
        bench.send(picture, encoding)
        bench.peer.wait_for(lambda n=count: len(received) == n, f"a compressed {encoding}")
        message = received[-1]
        assert message.format == f"{encoding}; png compressed "
        assert (stamp_of(message)[0], message.header.frame_id) == (bench.stamp_s, "camera")
        found, name = image_from_compressed(message)
        assert name == encoding
        np.testing.assert_array_equal(found, picture)
    # Nothing of the first frame, which nobody wanted compressed.
    bench.peer.wait_for(lambda: bench.state(f"compressed.{TOPIC}") == "2", "the count")
    assert bench.state(f"skipped.{TOPIC}") == "0"


def test_parameters_apply_live_and_what_jpeg_does_not_carry_is_counted(bench: Bench) -> None:
    received = bench.listen()
    for name, value in (("format", "tiff"), ("jpeg_quality", 0), ("png_level", 10)):
        assert not bench.set(name, value).successful
    sizes: list[int] = []
    for count, quality in ((1, 90), (2, 20)):
        assert bench.set("format", "jpeg").successful
        assert bench.set("jpeg_quality", quality).successful
        bench.send(texture())
        bench.peer.wait_for(lambda n=count: len(received) == n, "a JPEG")
        assert received[-1].format == "mono8; jpeg compressed mono8"
        assert image_from_compressed(received[-1])[0].shape == texture().shape
        sizes.append(len(received[-1].data))
    assert sizes[1] < sizes[0]

    bench.send(WIDE, "mono16")
    bench.peer.wait_for(
        lambda: "mono16 image as jpeg" in bench.state("last_rejection"), "the reason"
    )
    bench.peer.wait_for(lambda: len(bench.images) == 3, "the image as it is, all the same")
    np.testing.assert_array_equal(image_from_message(bench.images[-1]), WIDE)
    assert bench.set("format", "png").successful
    bench.send(WIDE, "mono16")
    bench.peer.wait_for(lambda: len(received) == 3, "the next one, which PNG carries")
    np.testing.assert_array_equal(image_from_compressed(received[-1])[0], WIDE)


def test_a_burst_ends_with_its_newest_image_and_every_one_is_accounted_for(bench: Bench) -> None:
    received = bench.listen()
    burst = 12
    noise = np.random.default_rng(0).integers(0, 256, (600, 800), dtype=np.uint8)
    for _ in range(burst):
        last = bench.send(noise)

    def accounted() -> bool:
        done, left = (bench.state(f"{key}.{TOPIC}") for key in ("compressed", "skipped"))
        return bool(done) and int(done) + int(left) == burst

    bench.peer.wait_for(accounted, "the count of all images")
    bench.peer.wait_for(
        lambda: received and stamp_of(received[-1])[0] == last, "the newest, compressed"
    )
    stamps = [stamp_of(message)[0] for message in received]
    assert stamps == sorted(set(stamps))
    assert len(stamps) <= int(bench.state(f"compressed.{TOPIC}"))


def test_it_stops_cleanly_in_the_middle_of_compressing(bench: Bench) -> None:
    received = bench.listen()
    noise = np.random.default_rng(0).integers(0, 2**16, (1500, 1500), dtype=np.uint16)
    bench.send(noise, "mono16")
    bench.send(noise, "mono16")
    bench.peer.wait_for(lambda: bench.images or received, "the first image")
    assert bench.node.stop(signal.SIGINT) == 0
    assert "Traceback" not in bench.node.output
    assert "rror" not in bench.node.output


def test_what_goes_in_may_be_compressed(peer: Peer, tmp_path: Path) -> None:
    config = load_config("generic")
    config_file = tmp_path / "compressed.yaml"
    config_file.write_text(
        f"{{name: compressed, display_width_m: {config.display_width_m},"
        f" image: {{topic: image_raw/compressed, type: {COMPRESSED_IMAGE_TYPE}}},"
        " magnification: {quantity: magnification}}"
    )
    images = peer.collect(Image, "image_rect")
    with running("rectifier", {"config": config_file}):
        peer.wait_heard(NODE, "image_rect")
        publisher = _feed(peer, CompressedImage, "image_raw/compressed")

        def send(image: Any, encoding: str, stamp_s: float, keep: int | None = None) -> None:
            message = CompressedImage()
            header = image_message(texture(), stamp_s).header
            fill_compressed(message, image, encoding, header, "png")
            message.data = message.data[:keep]
            publisher.publish(message)

        send(WIDE, "mono16", 1)
        peer.wait_for(lambda: len(images) == 1, "the image")
        assert (images[0].encoding, stamp_of(images[0])[0]) == ("mono16", 1)
        np.testing.assert_array_equal(image_from_message(images[0]), WIDE)
        send(texture(), "mono8", 2, keep=-40)
        peer.wait_for(
            lambda: "truncated" in peer.state(NODE).get("last_rejection", ""), "the rejection"
        )
        send(texture(), "mono8", 3)
        peer.wait_for(lambda: len(images) == 2, "the next good image")
        np.testing.assert_array_equal(image_from_message(images[1]), texture())
