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

"""The process beside a node that measures the drift."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.nodes.workers.child_process import ChildProcessEnded
from semcal_ros.nodes.workers.drift_worker import DriftProcess
from semcal_ros.synthetic import preset


def test_a_frame_that_is_at_work_when_the_node_ends_breaks_nothing() -> None:
    """The node has closed the process, and the thread with a frame comes to it afterwards."""
    process = DriftProcess()
    process.close()
    assert not process.is_ready()
    camera = preset("jsm820").camera_at(1000.0)
    measured = process.measure(None, np.zeros((8, 8)), camera, 0.0, None)
    for future in (process.fetch(), measured):
        with pytest.raises(ChildProcessEnded):
            future.result(timeout=10.0)
