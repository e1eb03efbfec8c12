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

"""From images to views: order, reasons, and the same result however the work is shared."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcal_ros import Calibration, calibrate
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.config.config import StageConfig, StageSigmas, load_config
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.stage import StageAxis, StageReading
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.errors import CalibrationError, InvalidValueError, UnusableCalibrationError
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.images.write import PixelScale, write_image
from semcal_ros.nodes.workers.calibration_worker import CalibrationJob
from semcal_ros.synthetic import Detector, calibration_plan, preset
from semcal_ros.workflows import calibrate as workflow
from semcal_ros.workflows.calibrate import (
    CalibrateOptions,
    calibrate_found,
    calibrate_recording,
    options_for,
)
from semcal_ros.workflows.find_grid import collect_views, count_visits, find_views
from tests.helpers.grids import Board, PatternBoard

SQUARES = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)
PLAN = calibration_plan(
    preset("jsm820").with_image_size(256, 256),
    magnifications=(400.0, 1000.0, 2500.0),
    views=4,
    detector=Detector(),
    seed=3,
)


def _numbers(calibration):
    """The text of the file without its date."""
    return replace(calibration, provenance=Provenance()).dumps()


@pytest.fixture(scope="module")
def frames():
    made = [(f"{i}", PLAN.render(i), f.magnification) for i, f in enumerate(PLAN.frames)]
    blank = np.full((256, 256), 120, dtype=np.uint8)
    return [*made[:5], ("blank", blank, 1000.0), *made[5:]]


@pytest.mark.long
@pytest.mark.slow
def test_sharing_the_work_changes_nothing(frames):
    counted = []
    alone, refused_alone = find_views(frames, processes=1)
    shared, refused_shared = find_views(iter(frames), processes=2, on_progress=counted.append)
    assert len(counted) == len(frames)
    assert (
        [v.name for v in shared]
        == [v.name for v in alone]
        == [f[0] for f in frames if f[0] != "blank"]
    )
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one.detection.xy, other.detection.xy)
        np.testing.assert_array_equal(one.detection.ij, other.detection.ij)
    assert [(r.name, r.reason) for r in refused_shared] == [
        (r.name, r.reason) for r in refused_alone
    ]
    assert "blank" in refused_alone[0].reason


def test_calibrate_takes_images_in_memory(frames):
    outer = [(image, g) for name, image, g in frames if name != "blank" and g != 1000.0]
    # Each magnification for itself, which is quick.
    calibration = calibrate(outer, method="discrete")
    assert isinstance(calibration, Calibration)
    assert calibration.magnification_range == (400.0, 2500.0)
    truth = PLAN.microscope.camera_at(1600.0)
    # 8 views of 256 px: the scale is known to 0.3 % or so, since heights and scale trade off.
    assert calibration.at(1600.0).pixel_size_m == pytest.approx(truth.pixel_size_m, rel=0.01)


@pytest.mark.slow
def test_colour_images_are_read_by_their_luma(frames):
    grey = [(image, g) for name, image, g in frames if name != "blank" and g == 1000.0]
    colour = [(np.dstack([image] * 3), g) for image, g in grey]
    one, other = (calibrate(images, method="discrete") for images in (colour, grey))
    assert _numbers(one) == _numbers(other)


def test_no_grid_at_all_is_refused_with_the_commonest_reason():
    blank = np.full((128, 128), 9, dtype=np.uint8)
    with pytest.raises(
        CalibrationError, match=r"no usable view among 3 images .3 x the image is blank"
    ):
        calibrate([(blank, 1000.0)] * 3)


def test_pixel_sizes_of_files_without_a_microscopes_settings_are_stated(tmp_path):
    """An OME-TIFF says its pixel size, and no more of the microscope."""
    picture = PatternBoard(20.0, turn_deg=25.0, noise=4.0).picture(np.random.default_rng(0))
    write_image(tmp_path / "grid.tif", picture, PixelScale(500e-9))
    with pytest.raises(UnusableCalibrationError, match="two readings of the scale"):
        calibrate(tmp_path, squares_m=[12e-6], untilted="all")
    done = calibrate(tmp_path, squares_m=[10e-6], untilted="all")
    camera = done.at(done.magnification_range[0])
    assert camera.pixel_size_m[0] == pytest.approx(500e-9, rel=5e-3)


@pytest.fixture(scope="module")
def dots():
    """Frames of dots, and what is found in them."""
    rng = np.random.default_rng(0)
    turned = [
        PatternBoard(20.0, turn_deg=turn, noise=4.0).picture(rng) for turn in (5.0, 25.0, 50.0)
    ]
    frames = [(f"{i}", image, 1000.0) for i, image in enumerate(turned)]
    return frames, *find_views(frames, processes=1)


def test_what_cells_are_called_does_not_cost_a_view(dots):
    _, found, rejected = dots
    other = replace(found[1], detection=replace(found[1].detection, pattern="crosses"))
    views = [found[0], other, found[2]]
    collected = collect_views(views, rejected, display_width_m=0.12, squares_m=[1e-5])
    assert [v.name for v in collected.found] == ["0", "1", "2"]
    assert collected.rejected == ()


def test_the_pattern_of_most_views_is_that_of_the_grid(dots):
    turned, seen, _ = dots
    chess = Board(20.0, electrons=60.0, width=240, height=200).render(np.random.default_rng(1))
    frames = [*turned[:2], ("2", chess, 1000.0)]
    others, rejected = find_views(frames[2:], processes=1)
    found = [*seen[:2], *others]
    assert [v.detection.pattern for v in found] == ["dots", "dots", "chess"]
    collected = collect_views(found, rejected, display_width_m=0.12, squares_m=[8e-6])
    assert [v.name for v in collected.found] == ["0", "1"]
    assert [v.reason for v in collected.rejected] == ["a chess board, not dots as in most images"]

    found, rejected = find_views(frames, processes=1, pattern="chess")
    assert [v.name for v in found] == ["2"]
    with pytest.raises(
        CalibrationError,
        match=r"dots, not a chess board, by odds of.*set --pattern to what is seen",
    ):
        collect_views([], rejected, display_width_m=0.12, squares_m=[8e-6])


@pytest.fixture(scope="module")
def found(frames):
    return find_views(frames, processes=1)


def _collected(found, magnification_of=lambda v: v.magnification, squares_m=SQUARES):
    views = [replace(v, magnification=magnification_of(v)) for v in found[0]]
    return calibrate_found(views, found[1], display_width_m=0.12, squares_m=squares_m)


@pytest.mark.slow
def test_a_view_at_a_wrong_magnification_is_named(found):
    wrong = found[0][6]
    done = _collected(found, lambda v: 1.3 * v.magnification if v is wrong else v.magnification)
    (reason,) = [r.reason for r in done.collected.rejected if r.name == wrong.name]
    assert "wrong magnification" in reason
    assert wrong.name not in [v.name for v in done.result.views]
    assert len(done.collected.views) == len(done.collected.found) == len(found[0]) - 1


@pytest.mark.slow
def test_a_live_calibration_names_the_views_that_it_leaves_out(found):
    wrong = found[0][6]
    views = [replace(v, magnification=1.3 * v.magnification) if v is wrong else v for v in found[0]]
    job = CalibrationJob(tuple(views), 0.12, tuple(SQUARES), CalibrationOptions())
    _, summary, notes = job.compute(lambda _name, _fraction: None)
    assert f"from {len(views) - 1} views of {len(views)}, " in summary
    (left_out,) = (note for note in notes if note.startswith("left out: "))
    assert f"{wrong.name} at {1.3 * wrong.magnification:g}: " in left_out
    assert "wrong magnification" in left_out


@pytest.mark.long
def test_a_slightly_wrong_magnification_is_named_after_the_adjustment(found):
    wrong = found[0][6]
    # One view among four of the same magnification whose scale is 5 % off: 1 mm of height.
    scaled = replace(
        wrong,
        detection=replace(wrong.detection, ij=wrong.detection.ij, xy=1.05 * wrong.detection.xy),
    )
    views = [scaled if v is wrong else v for v in found[0]]
    done = calibrate_found(views, found[1], display_width_m=0.12, squares_m=SQUARES)
    (reason,) = [r.reason for r in done.collected.rejected if r.name == wrong.name]
    assert "um of height" in reason
    assert len(done.result.views) == len(done.collected.found) == len(found[0]) - 1


@pytest.mark.long
def test_a_size_that_is_named_wrongly_is_recognised(found):
    """The views of a size that squares_m has not are left out, and told what they show."""
    shown = sorted({f.square_m for f in PLAN.frames})
    assert len(shown) > 1
    # The rarest size is called half of what it is, as when side and period are confused.
    counts = {s: sum(f.square_m == s for f in PLAN.frames) for s in shown}
    rarest = min(shown, key=lambda s: (counts[s], s))
    named = [0.6 * s if s == rarest else s for s in shown]
    done = _collected(found, squares_m=named)
    reasons = [
        r.reason for r in done.collected.rejected if r.reason != "" and "squares" in r.reason
    ]
    assert len(reasons) == counts[rarest]
    told_um = [float(re.search(r"squares are ([\d.]+) um", r).group(1)) for r in reasons]
    # Spacings of single views scatter by some percent.
    assert told_um == pytest.approx([1e6 * rarest] * len(reasons), rel=0.06)


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_periods_in_place_of_sides_are_refused(found, factor):
    with pytest.raises(CalibrationError, match="not the period") as error:
        _collected(found, squares_m=[factor * s for s in SQUARES])
    # The other explanation is named too: then the display would be so wide.
    (width,) = re.findall(r"display_width_m to ([\d.]+) m", str(error.value))
    assert float(width) == pytest.approx(0.12 * factor, rel=0.06)


@pytest.mark.parametrize("wrong", [600.0, 1.0 / 600.0])
def test_units_far_off_end_the_search_for_the_grid(frames, wrong):
    """After three views, whatever the number of the others; what is told fits."""
    looked = []

    def search(width_m, squares_m):
        looked.clear()
        calibrate(
            [(image, g) for name, image, g in frames if name != "blank" and g == 1000.0],
            display_width_m=width_m,
            squares_m=squares_m,
            on_progress=lambda stage, done, _all: looked.append(done) if "corners" in stage else 0,
        )

    with pytest.raises(UnusableCalibrationError, match="--display-width") as error:
        search(0.12 * wrong, [10e-6])
    assert max(looked) < 3
    (side,) = re.findall(r"--squares ([\d.]+[mun]*m) ", str(error.value))
    number, unit = re.fullmatch(r"([\d.]+)(\w+)", side).groups()
    side_m = float(number) * {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}[unit]
    assert side_m == pytest.approx(10e-6 * wrong, rel=0.1)


def test_squares_of_no_known_size_are_refused(found):
    with pytest.raises(CalibrationError, match="none of the known sizes"):
        _collected(found, squares_m=[5e-6])


# -- visits, squares and the stage -----------------------------------------------------------------


def test_a_visit_ends_where_the_magnification_changes(frames):
    """Twice to the first magnification, with only a frame without a grid at another in between."""
    first = [frame for frame in frames if frame[2] == 400.0]
    blank = ("between", np.full((256, 256), 120, dtype=np.uint8), 1000.0)
    second = [frame for frame in frames if frame[2] == 2500.0]
    order = [*first[:2], blank, *first[2:4], *second[:1]]
    found, rejected = find_views(order, processes=1)
    assert [r.name for r in rejected] == ["between"]
    assert [v.visit for v in found] == [0, 0, 2, 2, 3]
    collected = collect_views(found, rejected, display_width_m=0.12, squares_m=SQUARES)
    assert [v.visit for v in collected.views] == [0, 0, 2, 2, 3]
    of_frame = {f"{i}": f.square_m for i, f in enumerate(PLAN.frames)}
    expected = [of_frame[view.name] for view in collected.views]
    assert [view.square_m for view in collected.views] == pytest.approx(expected, rel=1e-12, abs=0)


@pytest.mark.parametrize(
    ("magnifications", "times_s", "visits"),
    [
        ([1.0, 1.0, 2.0, 2.0, 1.0], [0, 20, 100, 120, 200], [0, 0, 1, 1, 2]),
        # Turned back at the highest: a pause as at the other changes.
        ([1.0, 1.0, 2.0, 2.0, 2.0, 2.0], [0, 20, 100, 120, 200, 220], [0, 0, 1, 1, 2, 2]),
        # Evenly spaced frames have no pauses, nor does a recording of one magnification.
        ([1.0, 1.0, 2.0, 2.0, 2.0], [0, 20, 40, 60, 80], [0, 0, 1, 1, 1]),
        ([1.0, 1.0, 1.0, 1.0], [0, 20, 1000, 1020], [0, 0, 0, 0]),
        # Longer than usual, but shorter than a change.
        ([1.0, 1.0, 2.0, 2.0, 2.0, 2.0], [0, 2, 100, 102, 112, 114], [0, 0, 1, 1, 1, 1]),
        ([1.0, 2.0], [None, None], [0, 1]),
        ([], [], []),
    ],
)
def test_visits(magnifications, times_s, visits):
    stamps_ns = [None if t is None else round(1e9 * t) for t in times_s]
    assert count_visits(magnifications, stamps_ns) == visits


def _recorded(path, stage=lambda _index: None, *, only=None, last=None):
    """The frames of the plan in a bag, up to the ``last``, with a message of the stage before each.

    With ``only`` they are those of one magnification.
    """
    with BagWriter(path) as writer:
        for index, frame in enumerate(PLAN.frames[: None if last is None else last + 1]):
            if only not in (None, frame.magnification):
                continue
            stamp_ns = (20 * index + 10) * 10**9
            number = blank_message("std_msgs/msg/Float64")
            number.data = frame.magnification
            writer.write("/sem/magnification", stamp_ns - 10**9, number)
            angles = stage(index)
            if angles is not None:
                message = blank_message("sensor_msgs/msg/JointState")
                fill_header(message.header, stamp_ns - 10**9, "sem")
                message.name, message.position = list(angles), list(angles.values())
                writer.write("/sem/stage", stamp_ns - 10**9, message)
            picture = blank_message("sensor_msgs/msg/Image")
            fill_image(picture, PLAN.render(index), "mono8", picture.header)
            fill_header(picture.header, stamp_ns, "sem")
            writer.write("/sem/image_raw", stamp_ns, picture)
    return path


def test_readings_of_a_bag_reach_the_views(tmp_path, monkeypatch):
    seen = {}

    def stop(views, **given):
        seen.update(views=views, **given)
        raise CalibrationError("far enough")

    monkeypatch.setattr(workflow, "calibrate_views", stop)
    corners = []

    def find_once(images, **given):
        corners.append(corners[0] if corners else find_views(images, **given))
        # What is known of each frame is read, too.
        deque(images, maxlen=0)
        return corners[0]

    monkeypatch.setattr(workflow, "find_views", find_once)
    path = _recorded(tmp_path / "bag", lambda i: {"tilt": 0.1 * i, "rotation": -0.2 * i}, last=7)
    config = replace(
        load_config("generic"),
        stage=StageConfig(tilt_axis_deg=90.0, sigma=StageSigmas(tilt=0.01)),
        squares_sigma=2e-3,
    )
    with pytest.raises(CalibrationError, match="far enough"):
        calibrate(path, config=config, untilted=[0, "frame 4"], height_sigma_m=3e-5)
    for view in seen["views"]:
        index = int(view.name.removeprefix("frame "))
        assert view.stage == StageReading(0.1 * index, -0.2 * index)
        assert view.visit == index // 4
    options = seen["options"]
    assert options.axis == StageAxis(np.pi / 2, 0.01, 0.0087)
    assert (options.squares_sigma, options.height_sigma_m) == (2e-3, 3e-5)
    assert options.untilted == ("frame 0", "frame 4")
    with pytest.raises(CalibrationError, match="far enough"):
        calibrate(path, config=config, squares_sigma=0.0)
    assert seen["options"].squares_sigma == 0.0
    with pytest.raises(InvalidValueError, match="untilted '99'; expected numbers or file names"):
        calibrate(path, config=config, untilted=["99"])


def test_options_win_over_the_configuration():
    config = replace(load_config("generic"), squares_sigma=1e-3)
    own = CalibrationOptions(squares_sigma=5e-3, axis=StageAxis(1.0))
    assert options_for(config, own) == own
    assert options_for(config).squares_sigma == 1e-3
    assert options_for(replace(config, stage=None)).axis == StageAxis()


@pytest.mark.long
def test_a_bad_stage_leaves_the_calibration_as_it_is_without_one(tmp_path):
    off = CalibrateOptions(residual="off")
    plain = calibrate_recording(_recorded(tmp_path / "plain", only=1000.0), off)
    wrong = _recorded(tmp_path / "wrong", lambda i: {"tilt": 10.0 * i}, only=1000.0)
    done = calibrate_recording(wrong, off)
    assert _numbers(done.calibration) == _numbers(plain.calibration)
    origin = done.calibration.provenance
    assert (origin.recording, origin.configuration) == ("wrong", "generic")
    assert origin.views == tuple(view.name for view in done.result.views)
    assert done.result.model.provenance == origin
    assert any("looks like degrees" in note for note in done.notes)
    # Small angles in degrees could be radians: only the views tell.
    tilted = _recorded(tmp_path / "small", lambda _: {"tilt": 1.0}, only=1000.0)
    small = calibrate_recording(tilted, off)
    (told,) = (w for w in small.result.warnings if "contradict the tilt of the stage" in w)
    count = sum(frame.magnification == 1000.0 for frame in PLAN.frames)
    assert told.startswith(f"scale: {count} of {count} views contradict the tilt of the stage")
    others = tuple(w for w in small.result.warnings if w != told)
    assert others == plain.result.warnings
    np.testing.assert_array_equal(small.calibration.at(1000.0).P, plain.calibration.at(1000.0).P)
    assert small.calibration.statistics["warnings"] == list(small.result.warnings)


@pytest.mark.slow
def test_files_are_untilted_by_name_and_the_certificate_is_kept(tmp_path, monkeypatch):
    folder = tmp_path / "images"
    folder.mkdir()
    for index, frame in enumerate(PLAN.frames):
        if frame.magnification == 1000.0:
            cv2.imwrite(str(folder / f"view_{index}.png"), PLAN.render(index))
    name = sorted(path.name for path in folder.iterdir())[1]
    chosen = []
    real = workflow.calibrate_views

    def look(*views, options, **given):
        chosen.append(options.untilted)
        return real(*views, options=options, **given)

    monkeypatch.setattr(workflow, "calibrate_views", look)
    done = calibrate_recording(
        folder,
        CalibrateOptions(
            config=replace(load_config("generic"), grid_certificate="PTB 4711"),
            magnification=1000.0,
            method="discrete",
            untilted=(name,),
        ),
    )
    assert chosen == [("frame 1",)]
    assert done.calibration.statistics["grid_certificate"] == "PTB 4711"


@pytest.mark.slow
@pytest.mark.long
def test_the_reference_recording_with_a_stage(reference_data, monkeypatch):
    # The first two of the four frames of each visit.
    every = workflow.named_frames
    monkeypatch.setattr(
        workflow,
        "named_frames",
        lambda *args: (f for k, f in enumerate(every(*args)) if k % 4 < 2),
    )
    off = CalibrateOptions(residual="off")
    done = calibrate_recording(reference_data / "grid_real_stage", off)
    views = done.result.views
    assert len(views) == 40
    assert all(v.stage is not None and v.stage.tilt_rad is not None for v in views)
    assert sorted({v.visit for v in views}) == list(range(20))
    assert done.notes == ()


@pytest.mark.long
def test_a_copy_of_a_picture_is_no_new_view(dots):
    frames, _, _ = dots
    again = [*frames, ("copy", frames[1][1].copy(), frames[1][2])]
    found, rejected = find_views(again, processes=1)
    collected = collect_views(found, rejected, display_width_m=0.12, squares_m=[1e-5])
    assert [v.name for v in collected.found] == ["0", "1", "2"]
    assert [(r.name, r.reason) for r in collected.rejected] == [
        ("copy", "the same image as 1, and no new view")
    ]
