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

"""The node ``microscope``, alone or in the suite, with a source of your own."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.drivers.source import FrameSource
from semcal_ros.nodes.common.run import run_node, run_parts
from semcal_ros.nodes.microscope import Microscope
from semcal_ros.nodes.suite import Suite


def run_source(
    make: Callable[[MicroscopeConfig], FrameSource], args: Sequence[str] | None = None
) -> int:
    """Run the node ``microscope`` with this source, until SIGINT or SIGTERM.

    Parameters
    ----------
    make
        Makes the source from the configuration, such as its class.
    args
        Command line; the process's own by default. The parameter ``source`` has no effect.

    Returns
    -------
    Exit status.
    """
    return run_node(lambda: Microscope(make), args)


def run_suite(
    make: Callable[[MicroscopeConfig], FrameSource], args: Sequence[str] | None = None
) -> int:
    """Run the executable ``suite`` with this source; parameters and result are those of :func:`run_source`."""
    return run_parts(lambda: Suite.with_parts(make), args)
