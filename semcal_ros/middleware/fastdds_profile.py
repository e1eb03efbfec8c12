"""The shared memory that a Fast DDS participant has, by its environment and the profile which that names.

The rules are those of Fast DDS 2.14 and 3.2 (https://fast-dds.docs.eprosima.com: shared memory transport, XML profiles,
environment variables) and of rmw_fastrtps; the tests compare them with the segments that a node really makes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from semcal_ros.core.errors import ConfigError

__all__ = [
    "DEFAULT_SEGMENT_BYTES",
    "PROFILE_VARIABLES",
    "SharedMemory",
    "local_only",
    "profile_file",
    "shared_memory",
]

DEFAULT_SEGMENT_BYTES = 512 * 1024
"""Shared memory of a Fast DDS participant that nobody has configured."""

PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""What names the profile: Fast DDS 2 reads the first alone; with Fast DDS 3 the second counts without the first."""

_MAX_PROFILE_BYTES = 1024 * 1024
# By version of Fast DDS; its folder below an ament prefix tells which one is installed.
_FOLDERS = {2: "fastrtps", 3: "fastdds"}
_CWD_PROFILES = {2: "DEFAULT_FASTRTPS_PROFILES.xml", 3: "DEFAULT_FASTDDS_PROFILES.xml"}
# Of FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA in version 3, as its segments in /dev/shm show.
_LARGE_DATA_BYTES = 8500 * 1024


@dataclass(frozen=True)
class SharedMemory:
    """What a Fast DDS participant that starts in some environment uses between processes of one machine.

    Attributes
    ----------
    segment_bytes
        Size of its segment; None where it has no shared memory but goes over the network stack.
    source
        What says so, for people.
    """

    segment_bytes: int | None
    source: str


def profile_file(environment: Mapping[str, str]) -> tuple[str, Path] | None:
    """What names the profile that Fast DDS reads, and the file; None where there is none.

    Only what the installed version reads counts, where the ament prefixes tell which that is. Without a variable, a
    profile of the fixed name in the working directory counts.
    """
    version = _version(environment)
    for name in PROFILE_VARIABLES[:1] if version == 2 else PROFILE_VARIABLES:
        if environment.get(name):
            return name, Path(environment[name])
    if environment.get("SKIP_DEFAULT_XML_FILE", "") != "1":
        for of_version, file in _CWD_PROFILES.items():
            if version in (None, of_version) and Path(file).is_file():
                return "the working directory", Path(file)
    return None


def _version(environment: Mapping[str, str]) -> int | None:
    """Major version of the installed Fast DDS, or None where it is not known."""
    for prefix in filter(None, environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        for version, folder in _FOLDERS.items():
            if (Path(prefix) / "share" / folder).is_dir():
                return version
    return None


def shared_memory(environment: Mapping[str, str]) -> SharedMemory:
    """The shared memory of a Fast DDS participant started in this environment.

    Raises
    ------
    ConfigError
        The profile cannot be read or means nothing; Fast DDS goes on without it then.
    """
    named = profile_file(environment)
    builtin = environment.get("FASTDDS_BUILTIN_TRANSPORTS", "")
    rtps = ElementTree.Element("rtps")
    transports: dict[str, ElementTree.Element] = {}
    if named is not None:
        source = str(named[1])
        rtps, transports = _read_profile(named[1])
    elif builtin:
        source = f"FASTDDS_BUILTIN_TRANSPORTS is {builtin}"
    else:
        ignored = [name for name in PROFILE_VARIABLES if environment.get(name)]
        source = f"{ignored[0]} is not read by this Fast DDS" if ignored else "no profile is set"
    segments = _user_segments(rtps, transports, source)
    if local_only(environment):
        # rmw_fastrtps puts transports of its own in the place of the built-in ones.
        segments.append(DEFAULT_SEGMENT_BYTES)
    elif _text(rtps, "useBuiltinTransports").lower() not in ("false", "0"):
        mode = builtin or _text(rtps, "builtinTransports")
        segments += _builtin_segment(mode, rtps, _version(environment))
    # Of several the largest was found to be used.
    return SharedMemory(max(segments, default=None), source)


def local_only(environment: Mapping[str, str]) -> bool:
    """Whether only nodes on this host are found."""
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return reach == "LOCALHOST" or environment.get("ROS_LOCALHOST_ONLY") == "1"


def _builtin_segment(mode: str, rtps: ElementTree.Element, version: int | None) -> list[int]:
    """Segment of the transports that Fast DDS makes by itself: twice the socket buffers, or the default."""
    kind, _, options = mode.partition("?")
    if kind.startswith(("UDP", "NONE")):
        return []
    sockets = max(_integer(rtps, f"{side}SocketBufferSize") for side in ("send", "listen"))
    found = re.search(r"sockets_size=(\d+)([KMG]?)", options, re.IGNORECASE)
    if found:
        sockets = int(found[1]) * 1000 ** " KMG".index(found[2].upper() or " ")
    large = version == 3 and kind.startswith(("LARGE_DATA", "P2P"))
    return [2 * sockets or (_LARGE_DATA_BYTES if large else DEFAULT_SEGMENT_BYTES)]


def _user_segments(
    rtps: ElementTree.Element, transports: Mapping[str, ElementTree.Element], source: str
) -> list[int]:
    segments = []
    for used in rtps.iterfind("userTransports/transport_id"):
        name = (used.text or "").strip()
        if name not in transports:
            raise ConfigError(
                f"{source}: there is no transport {name!r}", expected="its descriptor"
            )
        if _text(transports[name], "type") == "SHM":
            size = _integer(transports[name], "segment_size") or DEFAULT_SEGMENT_BYTES
            if _integer(transports[name], "maxMessageSize") > size:
                raise ConfigError(
                    f"{source}: maxMessageSize of transport {name!r} exceeds its segment_size",
                    expected="a segment that holds a message",
                )
            segments.append(size)
    return segments


def _read_profile(path: Path) -> tuple[ElementTree.Element, dict[str, ElementTree.Element]]:
    """The element ``rtps`` of the default participant, and the transports by name."""
    root = _parsed(path)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    transports = {
        _text(element, "transport_id"): element for element in root.iter("transport_descriptor")
    }
    for element in root.iter("participant"):
        if element.get("is_default_profile", "").lower() in ("true", "1"):
            rtps = element.find("rtps")
            return ElementTree.Element("rtps") if rtps is None else rtps, transports
    raise ConfigError(
        f"{path}: no participant with is_default_profile", expected="the one that nodes take"
    )


def _parsed(path: Path) -> ElementTree.Element:
    try:
        size = path.stat().st_size
        text = path.read_text(encoding="utf-8") if size <= _MAX_PROFILE_BYTES else ""
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no UTF-8 text"
        raise ConfigError(f"{path}: {reason}", expected="a Fast DDS profile") from error
    # Entities could grow without limit, and a profile has no use for any.
    if not text or "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError(
            f"{path}: {size} bytes, or a document type", expected="the XML of a profile"
        )
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path}: {error}", expected="well-formed XML") from error


def _text(element: ElementTree.Element, name: str) -> str:
    return (element.findtext(name) or "").strip()


def _integer(element: ElementTree.Element, name: str) -> int:
    text = _text(element, name)
    return int(text) if text.isdecimal() else 0
