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

"""A calibration that is cancelled, killed or left alone ends at once, and the node goes on."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.calibration_session import (
    SERVER,
    Session,
    calibration_session,
    is_alive,
    workers_of,
)


def _worker(session: Session) -> int:
    """Process id of the calibration."""
    node = session.node.process.pid
    (worker,) = session.peer.wait_for(lambda: workers_of(node), "the calibration process")
    return int(worker)


def _held_worker(session: Session) -> int:
    """Process id of the calibration, which is stopped so that it cannot end by itself."""
    worker = _worker(session)
    os.kill(worker, signal.SIGSTOP)
    return worker


def test_a_node_that_is_stopped_does_not_wait_for_its_calibration(tmp_path: Path) -> None:
    """First: no other server may answer in its place."""
    with calibration_session(tmp_path) as session:
        session.add_view(0)
        session.begin("calibrate")
        worker = _held_worker(session)
        assert session.node.stop(signal.SIGINT) == 0
        assert not is_alive(worker)
        assert "1 view collected and not calibrated; call ~/calibrate" in session.node.output


def _cancelled(session: Session) -> bool:
    """Whether the last word is that of the calibration or of the call that ended it: either may come last."""
    return bool(session.shown()["message"].startswith("cancelled"))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with calibration_session(tmp_path_factory.mktemp("allowed"), allow_writing=False) as made:
        made.add_view(0)
        yield made


def test_cancel_ends_it_and_both_calls_say_so(session: Session) -> None:
    first = session.begin("calibrate")
    worker = _held_worker(session)
    second = session.call("calibrate")
    assert not second.success
    assert "a calibration is running" in second.message
    session.peer.wait_for(lambda: session.shown().get("stage") == "start", "the progress")

    answer = session.call("cancel")
    assert answer.success
    assert answer.message.startswith("cancelled the joint calibration from 1 view after ")
    session.peer.wait_for(first.done, "the answer of the first call")
    assert (first.result().success, first.result().message) == (False, "cancelled")
    assert not is_alive(worker)
    session.peer.wait_for(lambda: _cancelled(session), "the final word")
    assert "stage" not in session.shown()

    again = session.call("cancel")
    assert (again.success, again.message) == (False, "no calibration is running")


def test_a_calibration_can_begin_as_soon_as_the_one_before_is_cancelled(session: Session) -> None:
    for _ in range(5):
        pending = session.begin("calibrate")
        _worker(session)
        assert session.call("cancel").success
        session.peer.wait_for(pending.done, "the answer")
        assert pending.result().message == "cancelled"
    assert session.texts == []


def test_a_calibration_that_is_only_started_can_be_followed_and_cancelled(session: Session) -> None:
    answer = session.call("calibrate_start")
    assert answer.success
    assert answer.message.startswith("calibrating from 1 view; ")
    _held_worker(session)
    assert "a calibration is running" in session.call("calibrate_start").message
    session.peer.wait_for(lambda: session.shown().get("stage") == "start", "the progress")
    assert session.call("cancel").success
    session.peer.wait_for(lambda: _cancelled(session), "the end")
    # Too few views; nobody waits for the answer.
    assert session.call("calibrate_start").success
    session.peer.wait_for(lambda: "at least 3 views" in session.shown()["message"], "the refusal")
    assert "stage" not in session.shown()


def test_a_killed_calibration_is_a_plain_failure(session: Session) -> None:
    pending = session.begin("calibrate")
    os.kill(_held_worker(session), signal.SIGKILL)
    session.peer.wait_for(pending.done, "the answer")
    assert not pending.result().success
    assert "SIGKILL" in pending.result().message
    assert "memory" in pending.result().message
    assert "no calibration is running" in session.call("cancel").message
    session.add_view(1)


def test_saving_can_be_switched_off_for_good(session: Session) -> None:
    answer = session.call("save")
    assert not answer.success
    assert "switched off" in answer.message
    # Read-only from the start on.
    (value,) = session.peer.get_parameters(SERVER, "allow_writing")
    value.bool_value = True
    assert not session.peer.set_parameter(SERVER, "allow_writing", value).successful


def test_a_calibration_ends_with_its_node_even_if_that_is_killed(session: Session) -> None:
    """Last: the node is gone then."""
    session.begin("calibrate")
    worker = _worker(session)
    assert is_alive(worker)
    session.node.stop(signal.SIGKILL)
    session.peer.wait_for(lambda: not is_alive(worker), "the end of the calibration process")
    assert not is_alive(worker)
