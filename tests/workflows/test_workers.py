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

"""Work shared with a Dask cluster: the same bits, workers that die, clusters that do not fit.

Recordings are small, and so are the parts into which their work is divided: each command sends several.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import semcal_ros
from semcal_ros import calibrate, reconstruct, rectify, stack
from semcal_ros.applications.reconstruction import patches as patches_module
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.synthetic import Drift, calibration_plan, drift_plan, preset
from semcal_ros.workflows import stack as stack_module
from semcal_ros.workflows import workers as module
from semcal_ros.workflows.evaluate import evaluate
from semcal_ros.workflows.find_grid import find_views
from semcal_ros.workflows.workers import Workers, count_bytes, open_workers
from tests.helpers.grids import Board
from tests.helpers.node_scenes import make_calibration
from tests.helpers.semcal_runs import run
from tests.helpers.turning_ball import turning_ball

G, SIZE, COUNT = 20000.0, 96, 6
PLAN = drift_plan(
    preset("ideal").with_image_size(SIZE, SIZE),
    magnification=G,
    frames=COUNT,
    interval_s=1.0,
    drift=Drift(velocity_m_s=(20e-9, -10e-9)),
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as made:
        yield made.scheduler_address


@pytest.fixture(scope="module")
def frames() -> list[tuple[np.ndarray, float, float]]:
    return [(PLAN.render(k), G, float(k)) for k in range(COUNT)]


def add(a: int, b: int) -> int:
    return a + b


def refuse(value: int) -> int:
    raise InvalidValueError(f"no {value}", expected="another")


def tell_process(_: int) -> int:
    return os.getpid()


@pytest.mark.long
def test_results_come_in_the_order_of_the_items_from_other_processes(cluster):
    with open_workers(cluster) as workers:
        assert workers.elsewhere
        assert list(workers.starmap(add, ((k, 1) for k in range(40)))) == list(range(1, 41))
        seen = set(workers.starmap(tell_process, ((k,) for k in range(40))))
    assert len(seen) == 2 and os.getpid() not in seen


@pytest.mark.long
def test_items_are_taken_a_few_at_a_time(cluster):
    taken: list[int] = []

    def items() -> Iterator[tuple[Any, int]]:
        for k in range(30):
            taken.append(k)
            yield np.zeros(8 << 20, np.uint8), k

    with open_workers(cluster) as workers:
        results = workers.starmap(tell_process_of_array, items())
        next(results)
        # Two cores: at most eight items under way, and the one that did not fit any more.
        assert len(taken) <= 9
        assert len(list(results)) == 29


def tell_process_of_array(array: Any, _: int) -> int:
    return int(array.nbytes)


@pytest.mark.long
def test_large_items_are_limited_by_their_size(cluster, monkeypatch):
    monkeypatch.setattr(module, "_BYTES_UNDER_WAY", 2 << 20)
    taken = []

    def items() -> Iterator[tuple[Any, int]]:
        for k in range(6):
            taken.append(k)
            yield np.zeros(1 << 20, np.uint8), k

    with open_workers(cluster) as workers:
        results = workers.starmap(tell_process_of_array, items())
        next(results)
        assert len(taken) <= 3


def test_arrays_are_counted_wherever_they_are():
    array = np.zeros((3, 4))
    assert count_bytes([array, ("x", [array]), 5]) == 2 * array.nbytes


@pytest.mark.long
def test_an_error_of_the_work_is_raised_here(cluster):
    with open_workers(cluster) as workers, pytest.raises(InvalidValueError, match="no 7"):
        list(workers.starmap(refuse, [(7,)]))


@pytest.mark.long
def test_a_stack_is_the_same_to_the_last_bit(cluster, frames, monkeypatch):
    monkeypatch.setattr(stack_module, "_FRAMES_PER_PART", 2)
    here = stack(frames, config="virtual_sem")
    there = stack(frames, config="virtual_sem", dask=cluster)
    assert here.image.frames == there.image.frames == COUNT
    np.testing.assert_array_equal(here.image.mean, there.image.mean)
    np.testing.assert_array_equal(here.image.standard_error, there.image.standard_error)


@pytest.mark.long
def test_rectified_frames_are_the_same_to_the_last_bit(cluster, frames):
    calibration = make_calibration()
    here = rectify(frames, calibration=calibration, config="virtual_sem")
    there = rectify(frames, calibration=calibration, config="virtual_sem", dask=cluster)
    assert here.states == there.states
    for a, b in zip(here.frames, there.frames, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.image, b.image)


def kill_once(mark: Path, number: int, function: Any, *item: Any) -> Any:
    """What a worker does, but the first one that comes to the third item dies over it."""
    if number == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return function(*item)


@pytest.mark.long
def test_a_command_whose_worker_is_killed_gives_the_same_pictures(
    cluster, frames, tmp_path, monkeypatch
):
    mark, calibration = tmp_path / "killed", tmp_path / "cal.yaml"
    write_simulated(tmp_path / "bag", PLAN.frames, [image for image, _, _ in frames], {})
    make_calibration().save(calibration)
    command = ("rectify", tmp_path / "bag", "--calibration", calibration, "--config", "virtual_sem")
    assert run(*command, "-o", tmp_path / "here.tif") == 0

    def with_a_death(self: Workers, function: Any, items: Any) -> Iterator[Any]:
        numbered = ((mark, k, function, *item) for k, item in enumerate(items))
        return share(self, kill_once, numbered)

    share = Workers.starmap
    monkeypatch.setattr(Workers, "starmap", with_a_death)
    assert run(*command, "-o", tmp_path / "there.tif", "--dask", cluster) == 0
    assert mark.exists()
    here, there = (tifffile.imread(tmp_path / name) for name in ("here.tif", "there.tif"))
    assert here.shape == (COUNT, SIZE, SIZE)
    np.testing.assert_array_equal(here, there)


@pytest.mark.long
def test_a_calibration_and_its_judgement_are_the_same_to_the_last_bit(cluster):
    plan = calibration_plan(
        preset("jsm820").with_image_size(192, 192), magnifications=(400.0, 2500.0), views=3
    )
    views = [(plan.render(k), frame.magnification) for k, frame in enumerate(plan.frames)]
    here, there = (calibrate(views, method="discrete", dask=address) for address in (None, cluster))
    assert (
        replace(here, provenance=Provenance()).dumps()
        == replace(there, provenance=Provenance()).dumps()
    )
    assert evaluate(here, views) == evaluate(here, views, dask=cluster)


@pytest.mark.long
def test_a_ball_is_the_same_to_the_last_bit(cluster, monkeypatch):
    monkeypatch.setattr(patches_module, "POINTS_AT_ONCE", 16)
    images, calibration = turning_ball()
    here, there = (
        reconstruct(images, calibration=calibration, spacing_px=10.0, dask=address)
        for address in (None, cluster)
    )
    assert here.structure.passes > 1
    np.testing.assert_array_equal(here.structure.points_m, there.structure.points_m)
    assert here.summary() == there.summary()


@pytest.mark.long
def test_corners_are_the_same_to_the_last_bit(cluster):
    rng = np.random.default_rng(1)
    boards = [Board(24.0, turn_deg=8.0, width=128, height=128), Board(20.0, width=128, height=128)]
    images = [*(board.render(rng) for board in boards), np.full((128, 128), 90, np.uint8)]
    named = [(f"v{k}", image, 1000.0) for k, image in enumerate(images)]
    here, refused = find_views(named, processes=1)
    with open_workers(cluster) as workers:
        there, refused_there = find_views(named, workers=workers, keep_images=False)
    assert [r.name for r in refused] == [r.name for r in refused_there] == ["v2"]
    assert len(here) == 2
    for a, b in zip(here, there, strict=True):
        assert a.name == b.name and b.image is None
        np.testing.assert_array_equal(a.detection.xy, b.detection.xy)
        np.testing.assert_array_equal(a.detection.covariance_px2, b.detection.covariance_px2)


@pytest.mark.long
def test_a_worker_of_another_version_is_refused(cluster, monkeypatch):
    monkeypatch.setattr(semcal_ros, "__version__", "0.0.1")
    with (
        pytest.raises(InvalidValueError, match=r"worker tcp.*\(here 0\.0\.1\)"),
        open_workers(cluster),
    ):
        pass


def test_a_cluster_that_is_not_there_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(module, "_SCHEDULER_TIMEOUT_S", 0.5)
    with (
        pytest.raises(InvalidValueError, match="no Dask scheduler at tcp"),
        open_workers("tcp://127.0.0.1:9"),
    ):
        pass


@pytest.mark.parametrize("address", ["here", "tcp://host", "a b:1", ""])
def test_an_address_that_is_none_is_refused(address):
    with (
        pytest.raises(InvalidValueError, match="address of a Dask scheduler"),
        open_workers(address),
    ):
        pass


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(SemcalError, match=r"semcal_ros\[dask\]"),
        open_workers("tcp://127.0.0.1:8786"),
    ):
        pass
