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

"""Quality of service of the suite's topics, as ``doc/nodes.md``, "Quality of service", states it.

Users override it by ``qos_overrides`` parameters.
"""

from __future__ import annotations

from rcl_interfaces.msg import SetParametersResult
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

# Limit of the middleware, which counts in signed 32 bit integers.
_LARGEST_DEPTH = 2**31 - 1
# As many as parameter services keep: with the usual ten, requests of busy clients would be lost and never answered.
_WAITING_REQUESTS = 1000


def _profile(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


def image_input() -> QoSProfile:
    """Return the quality for images: a few wait while one is processed, so that a short delay loses none.

    Images that have waited too long are skipped by :class:`~semcal_ros.nodes.frames.stream.FrameInput`.
    """
    return _profile(10, DurabilityPolicy.VOLATILE)


def glimpse_input() -> QoSProfile:
    """Return the quality for images of which one in a while is looked at: whatever is lost, nobody waits for them."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
    )


def value_input(depth: int = 100) -> QoSProfile:
    """Return the quality for values: each one counts, including the last one before the node started."""
    return _profile(depth, DurabilityPolicy.TRANSIENT_LOCAL)


def stream_output(depth: int = 8) -> QoSProfile:
    """Return the quality for images and for the messages that go with each of them."""
    return _profile(depth, DurabilityPolicy.VOLATILE)


def camera_output(depth: int = 8) -> QoSProfile:
    """Return the quality for camera_info, the same for all its publishers: of images and of `parameter_server`.

    Transient local, as that of the latter has to be: it also suits a subscriber that asks for less.
    """
    return _profile(depth, DurabilityPolicy.TRANSIENT_LOCAL)


def latched() -> QoSProfile:
    """Return the quality for a value that is kept for late subscribers."""
    return _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)


def service_queue() -> QoSProfile:
    """Return the quality of a service that keeps all requests of busy clients."""
    return QoSProfile(depth=_WAITING_REQUESTS)


def overridable() -> QoSOverridingOptions:
    """Return options that declare ``qos_overrides.<topic>.<publisher|subscription>.<policy>`` parameters."""
    kinds = (
        QoSPolicyKind.HISTORY,
        QoSPolicyKind.DEPTH,
        QoSPolicyKind.RELIABILITY,
        QoSPolicyKind.DURABILITY,
    )
    return QoSOverridingOptions(kinds, callback=_check_depth)


def _check_depth(profile: QoSProfile) -> SetParametersResult:
    good = 0 <= profile.depth <= _LARGEST_DEPTH
    reason = "" if good else f"a depth of {profile.depth}; expected 0 to {_LARGEST_DEPTH}"
    return SetParametersResult(successful=good, reason=reason)


def relax(profile: QoSProfile, refused: QoSPolicyKind) -> QoSProfile | None:
    """Return the profile without the demand that a publisher does not meet; None if there is no such demand."""
    reliability, durability = profile.reliability, profile.durability
    if refused == QoSPolicyKind.RELIABILITY:
        reliability = ReliabilityPolicy.BEST_EFFORT
    elif refused == QoSPolicyKind.DURABILITY:
        durability = DurabilityPolicy.VOLATILE
    if (reliability, durability) == (profile.reliability, profile.durability):
        return None
    return QoSProfile(
        history=profile.history, depth=profile.depth, reliability=reliability, durability=durability
    )
