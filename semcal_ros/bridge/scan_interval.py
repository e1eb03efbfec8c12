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

"""When a frame was scanned, on the clock of the magnification messages."""

from __future__ import annotations

from semcal_ros.config.config import MicroscopeConfig

_NS_PER_S = 1_000_000_000  # nanoseconds per second
# Fraction of the acquisition at either end in which a change is harmless: a row or two at most.
_MARGIN = 0.01
# A magnification published at most this long before a frame was announced together with it.
_TOGETHER_NS, _TOGETHER_AT_MOST = 20_000_000, 0.25
# A frame that was published later than this after its scan has a stamp of another clock.
_LONGEST_WAY_NS = 10 * _NS_PER_S


def scan_interval_ns(
    stamp_ns: int, sent_ns: int | None, config: MicroscopeConfig
) -> tuple[int, int] | None:
    """Return the first and the last moment of a frame's scan at which a change of magnification spoils it.

    The very first and last rows do not count. Where publication times decide, neither do the last
    20 ms (at most a quarter of the scan): many drivers announce a magnification with its frame.

    Parameters
    ----------
    stamp_ns
        Header stamp of the frame.
    sent_ns
        When the frame was published, where the magnification has no stamps of its own and is known
        by when it was published; None where stamps are compared with stamps.
    config
        What the stamp means, and the raster timing.

    Returns
    -------
    (start, end), ns; None if unknown: without raster timing and publication time, or
    where stamps and publication are on different clocks, as in a replay.
    """
    start_ns = stamp_ns + round(config.start_offset_s * 1e9)
    duration_ns = 0 if config.scan is None else round(config.scan.acquisition_time_s * 1e9)
    end_ns = start_ns + duration_ns
    if sent_ns is not None:
        if not 0 <= sent_ns - start_ns <= duration_ns + _LONGEST_WAY_NS:
            return None
        if config.scan is None and config.image.stamp == "start":
            end_ns = sent_ns
        # A frame that is published while it is still being scanned holds what came before.
        end_ns = min(end_ns, sent_ns)
    long_ns = end_ns - start_ns
    margin_ns = round(_MARGIN * long_ns)
    before_ns = margin_ns
    if sent_ns is not None:
        before_ns = max(margin_ns, min(_TOGETHER_NS, round(_TOGETHER_AT_MOST * long_ns)))
    if long_ns <= margin_ns + before_ns:
        return None
    return start_ns + margin_ns, end_ns - before_ns
