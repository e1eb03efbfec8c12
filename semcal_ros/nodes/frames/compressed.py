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

"""Compressed copies of the images, on the topic and with the parameters of image_transport's `compressed`.

Names: https://github.com/ros-perception/image_transport_plugins, compressed_publisher.cpp. There, the
parameters of a node in a namespace begin with a dot (`.image_rect.compressed.format`), which newer releases correct
(pull request 188); here they do not.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage

from semcal_ros.bridge.compressed import CODECS, fill_compressed
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.latest_worker import LatestWorker
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.frames.stream import StreamFrame


def compressed_parameters(topic: str) -> tuple[ParameterDeclaration, ...]:
    """Return the parameters of the compressed images of ``topic``, for a node to declare."""
    return (
        ParameterDeclaration(
            f"{topic}.compressed.format",
            "png",
            "How to compress. png is exact; jpeg is smaller and faster, and for 8 bit only.",
            choices=tuple(CODECS),
        ),
        ParameterDeclaration(
            f"{topic}.compressed.jpeg_quality", 95, "Quality of jpeg.", low=1, high=100
        ),
        ParameterDeclaration(
            f"{topic}.compressed.png_level",
            3,
            "0 stores the pixels, which is fast; 1 to 9 compress, all alike for noisy frames.",
            low=0,
            high=9,
        ),
    )


@dataclass(frozen=True, order=True)
class _Job:
    """A copy of an image, and how to compress it; jobs are ordered by their numbers."""

    number: int
    image: NDArray[Any] = field(compare=False)
    encoding: str = field(compare=False)
    header: Any = field(compare=False)
    codec: str = field(compare=False)
    options: dict[str, int] = field(compare=False)


class _Done(NamedTuple):
    number: int
    error: Exception | None = None


class CompressedOutput:
    """Publishes ``<topic>/compressed`` while it has subscribers.

    A separate thread compresses, so that the images themselves do not wait; it takes the newest image and skips those
    that came in between. Of the node, the thread uses only the publisher, which any thread may use; counts and errors
    are passed back to the executor.

    Parameters
    ----------
    context
        Of the node; among its parameters are :func:`compressed_parameters` of the topic.
    topic
        Topic of the uncompressed images.

    Notes
    -----
    :meth:`close` must be called before the node is destroyed.
    """

    def __init__(self, context: NodeContext, topic: str) -> None:
        endpoints = context.endpoints
        self._parameters = context.parameters
        self._reporter = context.reporter
        self._topic = f"{topic}/compressed"
        self._prefix = f"{topic}.compressed"
        name = endpoints.below(topic, "compressed")
        self._publisher = endpoints.stream_publisher(CompressedImage, self._topic, name)
        self._in_hand = threading.Lock()
        self._ended = False
        self._submitted = 0
        self._done = 0
        self._work = LatestWorker[_Job, _Done](endpoints.guard, self._compress, self._report)

    def publish(self, image: NDArray[Any], frame: StreamFrame) -> None:
        """Compress, beside the stream, an image made from ``frame``; its memory may be reused after the call."""
        if not self._publisher.is_awaited:
            return
        self._submitted += 1
        codec = self._parameter("format")
        options = {name: self._parameter(name) for name in ("jpeg_quality", "png_level")}
        self._work.submit(
            _Job(self._submitted, image.copy(), frame.encoding, frame.header, codec, options)
        )

    def _parameter(self, name: str) -> Any:
        return self._parameters[f"{self._prefix}.{name}"]

    def close(self) -> None:
        """Wait for the image that is being compressed; no image is published after it."""
        with self._in_hand:
            self._ended = True

    def _compress(self, job: _Job) -> _Done:
        with self._in_hand:
            if self._ended:
                return _Done(job.number)
            try:
                message = CompressedImage()
                fill_compressed(
                    message, job.image, job.encoding, job.header, job.codec, **job.options
                )
                self._publisher.publish(message)
            except Exception as error:
                return _Done(job.number, error)
        return _Done(job.number)

    def _report(self, done: _Done) -> None:
        self._done += 1
        self._reporter.note(f"compressed.{self._topic}", self._done)
        self._reporter.note(f"skipped.{self._topic}", done.number - self._done)
        if done.error is None:
            return
        if not isinstance(done.error, NODE_ERRORS):
            raise done.error
        self._reporter.reject(done.error)
