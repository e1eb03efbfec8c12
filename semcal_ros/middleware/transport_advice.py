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

"""Whether this process is set up for images of a given size: the shared memory of Fast DDS, and malloc.

A message that fits into the shared memory of its sender goes over at once. A larger one waits for
room again and again, and meanwhile best-effort messages are lost. ``doc/nodes.md``, "Large images",
has the measurements.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping

from semcal_ros.core.errors import ConfigError
from semcal_ros.middleware.fastdds_profile import DEFAULT_SEGMENT_BYTES, shared_memory

__all__ = ["MALLOC_VARIABLES", "transport_advice"]

MALLOC_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")
"""What glibc reads at the start of a process (mallopt(3))."""

# From here on the page faults of new buffers cost as much as all the rest of the way (the table of
# doc/nodes.md: at 1 MiB the profile alone takes 2.1 times as long as with malloc set, at 512 KiB 1.4).
_MALLOC_MATTERS_BYTES = 1024 * 1024
_REMEDY = "set the environment of `Large images` (doc/nodes.md) for every process with images"
_OTHER_MALLOC = re.compile("jemalloc|tcmalloc|mimalloc")


def transport_advice(image_bytes: int, environment: Mapping[str, str], rmw: str) -> str:
    """Advice for a process that sends or receives images of this size; empty if all is well.

    Parameters
    ----------
    image_bytes
        Size of the pixels of one image.
    environment
        The environment that the process was started with.
    rmw
        Name of the middleware, such as ``rmw_fastrtps_cpp``; of others than Fast DDS only malloc is judged.
    """
    advice = []
    if rmw.startswith("rmw_fastrtps"):
        advice.append(_segment_advice(image_bytes, environment))
    advice.append(_malloc_advice(image_bytes, environment))
    found = [text for text in advice if text]
    return "; ".join([*found, _REMEDY]) if found else ""


def _segment_advice(image_bytes: int, environment: Mapping[str, str]) -> str:
    try:
        memory = shared_memory(environment)
    except ConfigError as error:
        # Fast DDS goes on without it.
        suffices = image_bytes <= DEFAULT_SEGMENT_BYTES
        return "" if suffices else f"the Fast DDS profile cannot be used: {error.seen}"
    if memory.segment_bytes is None or image_bytes <= memory.segment_bytes:
        return ""
    return (
        f"images of {_size(image_bytes)} do not fit into the shared memory of Fast DDS,"
        f" {_size(memory.segment_bytes)} ({memory.source})"
    )


def _malloc_advice(image_bytes: int, environment: Mapping[str, str]) -> str:
    own = "glibc.malloc" in environment.get("GLIBC_TUNABLES", "")
    other = _OTHER_MALLOC.search(environment.get("LD_PRELOAD", ""))
    if image_bytes < _MALLOC_MATTERS_BYTES or own or other or not _has_glibc():
        return ""
    small = [name for name in MALLOC_VARIABLES if _number(environment.get(name)) < image_bytes]
    if not small:
        return ""
    return (
        f"images of {_size(image_bytes)} get new memory from the kernel each time"
        f" ({' and '.join(small)} not set so high)"
    )


def _has_glibc() -> bool:
    try:
        return bool(os.confstr("CS_GNU_LIBC_VERSION"))
    except (AttributeError, ValueError, OSError):
        return False


def _number(text: str | None) -> int:
    return int(text) if text is not None and text.isdecimal() else 0


def _size(count: int) -> str:
    return f"{count / 1024**2:.1f} MiB"
