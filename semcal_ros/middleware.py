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

"""DDS below the nodes and the doctor, without an import of ROS: transport, security, message classes, the ament index.

A message that fits into the shared memory of its sender goes over at once. A larger one waits for
room again and again, and meanwhile best-effort messages are lost. ``doc/nodes.md``, "Large images",
has the measurements.

Of the shared memory, the default is judged, and a profile that states the size of its segment, as the shipped one
does. The rules for everything else (built-in transports by name, socket buffers) differ between versions of Fast DDS
and are left to its documentation:
https://fast-dds.docs.eprosima.com (shared memory transport, XML profiles, environment variables).
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from semcal_ros.core.errors import ConfigError
from semcal_ros.text_files import read_text_file

MALLOC_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")
"""What glibc reads at the start of a process (mallopt(3))."""

# From here on the page faults of new buffers cost as much as all the rest of the way (the table of
# doc/nodes.md: at 1 MiB the profile alone takes 2.1 times as long as with malloc set, at 512 KiB 1.4).
_MALLOC_MATTERS_BYTES = 1024 * 1024
_LARGE_IMAGES_REMEDY = (
    "set the environment of `Large images` (doc/nodes.md) for every process with images"
)
_OTHER_MALLOC = re.compile("jemalloc|tcmalloc|mimalloc")
DEFAULT_SEGMENT_BYTES = 512 * 1024
"""Shared memory of a Fast DDS participant that nobody has configured."""

PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""What names the profile: Fast DDS 2 reads the first alone; Fast DDS 3 reads the second where the first is not set."""

_MAX_PROFILE_BYTES = 1024 * 1024  # the shipped one has 2 kB; this only keeps other files out
# Folder of each version below an ament prefix, and the profile that it reads in the working directory.
_VERSIONS = {
    2: ("fastrtps", "DEFAULT_FASTRTPS_PROFILES.xml"),
    3: ("fastdds", "DEFAULT_FASTDDS_PROFILES.xml"),
}

_PREFIX_VARIABLE = "AMENT_PREFIX_PATH"
_SUITE_MARKER = Path("share", "ament_index", "resource_index", "packages", "semcal_ros")


_added_prefixes: list[str] = []


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
    return "; ".join([*found, _LARGE_IMAGES_REMEDY]) if found else ""


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
        f"images of {_format_mib(image_bytes)} do not fit into the shared memory of Fast DDS,"
        f" {_format_mib(memory.segment_bytes)} ({memory.source})"
    )


def _malloc_advice(image_bytes: int, environment: Mapping[str, str]) -> str:
    tuned = "glibc.malloc" in environment.get("GLIBC_TUNABLES", "")
    other = _OTHER_MALLOC.search(environment.get("LD_PRELOAD", ""))
    if image_bytes < _MALLOC_MATTERS_BYTES or tuned or other or not _has_glibc():
        return ""
    small = [name for name in MALLOC_VARIABLES if _read_number(environment.get(name)) < image_bytes]
    if not small:
        return ""
    return (
        f"images of {_format_mib(image_bytes)} get new memory from the kernel each time"
        f" ({' and '.join(small)} not set so high)"
    )


def _has_glibc() -> bool:
    try:
        return bool(os.confstr("CS_GNU_LIBC_VERSION"))
    except (AttributeError, ValueError, OSError):
        return False


def _read_number(text: str | None) -> int:
    return int(text) if text is not None and text.isdecimal() else 0


def _format_mib(count: int) -> str:
    return f"{count / 1024**2:.1f} MiB"


@dataclass(frozen=True)
class SharedMemory:
    """What a Fast DDS participant uses between processes of one machine.

    Attributes
    ----------
    segment_bytes
        Size of its segment; None where the environment does not state it.
    source
        What says so, for people.
    """

    segment_bytes: int | None
    source: str


def profile_file(environment: Mapping[str, str]) -> tuple[str, Path] | None:
    """What names the profile that Fast DDS reads, and the file; None without one.

    Only what the installed version reads counts, where the ament prefixes tell which version that
    is. Without a variable, a profile of the fixed name in the working directory counts.
    """
    installed = _installed_version(environment)
    for name in PROFILE_VARIABLES[:1] if installed == 2 else PROFILE_VARIABLES:
        if environment.get(name):
            return name, Path(environment[name])
    if environment.get("SKIP_DEFAULT_XML_FILE", "") != "1":
        for version, (_, file) in _VERSIONS.items():
            if installed in (None, version) and Path(file).is_file():
                return "the working directory", Path(file)
    return None


def _installed_version(environment: Mapping[str, str]) -> int | None:
    """Major version of the installed Fast DDS, or None where it is not known."""
    for prefix in filter(None, environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        for version, (folder, _) in _VERSIONS.items():
            if (Path(prefix) / "share" / folder).is_dir():
                return version
    return None


def shared_memory(environment: Mapping[str, str]) -> SharedMemory:
    """The shared memory of a Fast DDS participant started in this environment.

    Raises
    ------
    ConfigError
        The profile cannot be read; Fast DDS goes on without it then.
    """
    profile = profile_file(environment)
    builtin = environment.get("FASTDDS_BUILTIN_TRANSPORTS", "")
    if profile is not None:
        return SharedMemory(_largest_segment(profile[1]), str(profile[1]))
    if builtin:
        return SharedMemory(None, f"FASTDDS_BUILTIN_TRANSPORTS is {builtin}")
    ignored = [name for name in PROFILE_VARIABLES if environment.get(name)]
    source = f"{ignored[0]} is not read by this Fast DDS" if ignored else "no profile is set"
    return SharedMemory(DEFAULT_SEGMENT_BYTES, source)


def local_only(environment: Mapping[str, str]) -> bool:
    """Whether only nodes on this host are found."""
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return reach == "LOCALHOST" or environment.get("ROS_LOCALHOST_ONLY") == "1"


def _largest_segment(path: Path) -> int | None:
    """The largest ``segment_size`` of a profile, bytes; of several segments Fast DDS uses that one."""
    expected = "the XML of a Fast DDS profile"
    text = read_text_file(path, _MAX_PROFILE_BYTES, error=ConfigError, expected=expected)
    # Entities could grow without limit, and a profile has no use for any.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError(f"{path}: a document type", expected=expected)
    try:
        elements = ElementTree.fromstring(text).iter()
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path}: {error}", expected=expected) from error
    sizes = [
        (element.text or "").strip()
        for element in elements
        if element.tag.rpartition("}")[2] == "segment_size"
    ]
    return max((int(size) for size in sizes if size.isdecimal()), default=None)


def check_security(environment: Mapping[str, str] = os.environ) -> None:
    """Refuse settings that ROS would take as no security at all, without a word.

    Raises
    ------
    ConfigError
        ``ROS_SECURITY_ENABLE`` or ``ROS_SECURITY_STRATEGY`` is misspelt, or there is no keystore.
    """
    enabled = _read_choice(environment, "ROS_SECURITY_ENABLE", "true", "false")
    strategy = _read_choice(environment, "ROS_SECURITY_STRATEGY", "Enforce", "Permissive")
    if (enabled, strategy) == ("true", "Enforce") and not environment.get("ROS_SECURITY_KEYSTORE"):
        raise ConfigError(
            "ROS_SECURITY_KEYSTORE is not set",
            expected="the folder of a keystore, because security is enforced",
            do="see doc/security.md",
        )


def _read_choice(environment: Mapping[str, str], name: str, *accepted: str) -> str:
    value = environment.get(name, "")
    if value and value not in accepted:
        raise ConfigError(
            f"{name} is {value!r}",
            expected=" or ".join(accepted),
            do="ROS would run this node without security",
        )
    return value


def message_class(type_name: str) -> Any:
    """Class of a type such as ``"std_msgs/msg/Float64"``.

    Raises
    ------
    ConfigError
        The name is malformed or the package is not installed.
    """
    parts = type_name.split("/")
    if len(parts) == 3 and parts[1] == "msg" and all(part.isidentifier() for part in parts):
        try:
            return getattr(import_module(f"{parts[0]}.msg"), parts[2])
        except (ImportError, AttributeError):
            pass
    raise ConfigError(
        f"message type {type_name!r}",
        expected="an installed type such as std_msgs/msg/Float64",
        do="correct its spelling or install the package it comes from",
    )


def add_environment_prefix() -> None:
    """Put the prefix of this Python environment in front of ``AMENT_PREFIX_PATH``, if the suite is installed there.

    The setup script of a ROS installation or of a workspace sets the variable for what it holds. An environment that
    pip made has no such script, so the suite's executables and commands call this first. Child processes inherit it.
    """
    prefixes = [p for p in os.environ.get(_PREFIX_VARIABLE, "").split(os.pathsep) if p]
    if sys.prefix not in prefixes and (Path(sys.prefix) / _SUITE_MARKER).is_file():
        os.environ[_PREFIX_VARIABLE] = os.pathsep.join([sys.prefix, *prefixes])
        _added_prefixes.append(sys.prefix)


def prefixes_of_user() -> list[str]:
    """Return the prefixes of ``AMENT_PREFIX_PATH`` that :func:`add_environment_prefix` did not put there."""
    return [
        p
        for p in os.environ.get(_PREFIX_VARIABLE, "").split(os.pathsep)
        if p and p not in _added_prefixes
    ]
