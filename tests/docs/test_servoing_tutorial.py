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


"""The nodes of the tutorial on servoing, started with the page's own arguments: the error comes back below a pixel."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from std_msgs.msg import Float64

from tests.helpers.listings import Listed, listings, run_listing
from tests.helpers.project import ROOT
from tests.helpers.ros_domain import claim_domain
from tests.helpers.ros_process import RELIABLE, Peer, running

# Five processes must get their turns within a stream's interval.
pytestmark = [pytest.mark.slow, pytest.mark.flaky(reruns=1)]

PAGE = ROOT / "doc" / "tutorials" / "servoing.md"
SERVO = "/sem/visual_servo"
CORRECTOR = "/sem/stream_corrector"


@pytest.fixture
def peer() -> Iterator[Peer]:
    domain_id, lock = claim_domain()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain_id))
        one = Peer()
        yield one
        one.close()
    os.close(lock)


def _nodes(page: list[Listed], folder: Path) -> list[tuple[str, dict[str, str]]]:
    """Executables and parameters of the page's `ros2 run` lines."""
    found = []
    for listed in page:
        words = shlex.split(listed.command)
        if words[:3] != ["ros2", "run", "semcal_ros"]:
            continue
        given = dict(word.split(":=", 1) for word in words if ":=" in word)
        if "calibration" in given:
            given["calibration"] = str(folder / given["calibration"])
        found.append((words[3], given))
    return found


@pytest.mark.long
def test_the_servo_follows_the_target_as_the_page_says(peer: Peer, tmp_path: Path) -> None:
    page = listings(PAGE)
    made = [c for c in page if c.command.startswith(("semcal simulate", "semcal calibrate"))]
    assert len(made) == 2
    for listed in made:
        run_listing(listed, tmp_path, 0.05)
    nodes = _nodes(page, tmp_path)
    assert [name for name, _ in nodes] == [
        "virtual_sem",
        "parameter_server",
        "stream_corrector",
        "visual_servo",
    ]
    knob = peer.node.create_publisher(Float64, "virtual_sem/set_magnification", RELIABLE)
    with ExitStack() as stack:
        for name, given in nodes:
            stack.enter_context(running(name, given))

        def converged(g: float) -> bool:
            state, corrector = peer.state(SERVO), peer.state(CORRECTOR)
            return (
                float(corrector.get("magnification", "nan")) == g
                and state.get("servo_state") == "converged"
                and float(state.get("servo_error_px", "nan")) < 1.0
            )

        for g in (1000.0, 4000.0):
            if g != 1000.0:
                peer.wait_for(lambda: knob.get_subscription_count() == 1, "the knob")
                knob.publish(Float64(data=g))
            try:
                peer.wait_for(lambda value=g: converged(value), f"convergence at {g:g}x", 55.0)
            except AssertionError as error:
                states = [peer.state(f"/sem/{name}") for name, _ in nodes]
                raise AssertionError([str(error), *states]) from None
