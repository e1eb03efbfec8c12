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

"""The workflows as a notebook calls them: images in memory, results as values."""

from __future__ import annotations

import csv
from dataclasses import FrozenInstanceError, replace

import cv2
import numpy as np
import pytest
import tifffile

import semcal_ros
from semcal_ros import calibrate, measure_cantilever, reconstruct, rectify, stack, track_drift
from semcal_ros.bridge.projection import stamped_projection_from_message
from semcal_ros.config.config import load_config
from semcal_ros.core.camera.records import FitRecord
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.bags.reader import open_bag
from semcal_ros.files.recordings import RecordedFiles, open_recording
from semcal_ros.synthetic import Drift, drift_plan, preset
from semcal_ros.synthetic.specimens.cantilever import cantilever_plan
from semcal_ros.workflows.evaluate import evaluate
from semcal_ros.workflows.inputs import resolve_config
from tests.helpers.node_scenes import make_calibration, texture

G, SIZE, COUNT = 20000.0, 96, 5
PLAN = drift_plan(
    preset("ideal").with_image_size(SIZE, SIZE),
    magnification=G,
    frames=COUNT,
    interval_s=1.0,
    drift=Drift(velocity_m_s=(20e-9, -10e-9)),
)


@pytest.fixture(scope="module")
def frames() -> list[tuple[np.ndarray, float, float]]:
    return [(PLAN.render(k), G, float(k)) for k in range(COUNT)]


def test_every_agreed_name_is_there():
    names = ("calibrate", "measure_cantilever", "reconstruct", "rectify", "stack", "track_drift")
    for name in names:
        assert callable(getattr(semcal_ros, name))
        assert name in semcal_ros.__all__ and name in dir(semcal_ros)
        assert "Examples\n" in getattr(semcal_ros, name).__doc__
    with pytest.raises(AttributeError):
        semcal_ros.measure_everything  # noqa: B018


def test_from_which_frame_drift_is_counted_is_a_note(frames):
    blank = np.zeros_like(frames[0][0])
    images = [blank, *(f[0] for f in frames[1:])]
    times = [0.0, 1.0, 2.0, 1.5, 3.0]
    noted = [
        "drift is counted from frame 2: frame 1 could not be used (blank (all pixels at 0))",
        "time runs backwards at frame 4: from there on, drift is counted from that frame",
    ]
    recording = [(image, G, t) for image, t in zip(images, times, strict=True)]
    track = track_drift(recording, config="virtual_sem")
    assert list(track.notes) == noted
    assert track.path.trusted.tolist() == [False, True, True, False, False]


def test_drift_of_images_in_memory(frames, tmp_path):
    seen = []
    track = track_drift(frames, config="virtual_sem", on_progress=lambda *a: seen.append(a))
    assert seen[0] == ("drift", 0, COUNT) and ("drift", COUNT, COUNT) in seen
    assert track.stamps_ns == tuple(k * 10**9 for k in range(COUNT))
    assert track.states == {"tracked": COUNT - 1, "keyframe": 1}
    assert track.notes == ()
    velocity = np.array([20e-9, -10e-9])
    error = track.path.drift_m - velocity * np.arange(COUNT)[:, None]
    pixel_m = 0.12 / G / SIZE
    # Frames of 96 px without much structure: some hundredths of a px.
    assert np.abs(error).max() < 0.1 * pixel_m
    assert track.forecast(2.0).drift_m == pytest.approx(
        velocity * (COUNT + 1.0), abs=4e-9 + 4 * np.sqrt(track.forecast(2.0).covariance[0, 0])
    )
    track.save(tmp_path / "d.csv")
    with (tmp_path / "d.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["dx_m"]) for r in rows] == track.path.drift_m[:, 0].tolist()
    assert [int(r["stamp_ns"]) for r in rows] == list(track.stamps_ns)
    with pytest.raises(FrozenInstanceError):
        track.notes = ("no",)


def test_a_rotation_is_in_the_table_and_in_the_notes(tmp_path):
    # 0.3 degrees a frame about the middle of each: 0.25 px at the edge.
    coarse = cv2.resize(np.random.default_rng(0).normal(120, 50, (48, 48)), (144, 144))
    frames = []
    for k in range(7):
        matrix = cv2.getRotationMatrix2D((71.5, 71.5), -0.3 * k, 1.0)
        picture = cv2.warpAffine(coarse, matrix, (144, 144), flags=cv2.INTER_LANCZOS4)
        noise = np.random.default_rng(k + 1).normal(0.0, 2.0, (SIZE, SIZE))
        grey = np.clip(picture[24:-24, 24:-24] + noise, 0, 255).astype(np.uint8)
        frames.append((grey, G, float(k)))
    track = track_drift(frames, config="virtual_sem")
    assert all(track.path.accepted)
    track.save(tmp_path / "drift.csv")
    rows = list(csv.DictReader((tmp_path / "drift.csv").read_text().splitlines()))
    found, sigma = (float(rows[-1][name]) for name in ("rotation_rad", "sigma_rotation_rad"))
    assert abs(found - np.deg2rad(1.8)) < 4.0 * sigma < 0.01
    assert abs(float(rows[-1]["log_scale"])) < 4.0 * float(rows[-1]["sigma_log_scale"])
    assert f"the image turned by {np.rad2deg(found):.4f} +- " in track.notes[-1]


def test_live_drift_is_without_hindsight(frames):
    live = track_drift(frames, config="virtual_sem", live=True).path
    smooth = track_drift(frames, config="virtual_sem").path
    assert np.all(smooth.sigma_m[1:-1] <= live.sigma_m[1:-1])
    assert not np.array_equal(smooth.drift_m, live.drift_m)


def test_an_average_says_what_is_in_it(frames, tmp_path):
    blank = (np.full((SIZE, SIZE), 9, np.uint8), G, 2.5)
    other = (frames[0][0][:50], G, 2.6)
    result = stack(
        [*frames[:3], blank, other, *frames[3:]],
        config="virtual_sem",
        output=tmp_path / "m.png",
        sigma=tmp_path / "s.tif",
    )
    assert result.used.tolist() == [True, True, True, False, True, True]
    assert len(result.stamps_ns) == COUNT + 1 and result.other_kind == 1
    assert result.image.frames == COUNT
    assert result.dtype == np.uint8 and result.lost == 0 and result.warnings == ()
    assert result.typical_error == pytest.approx(np.nanmedian(result.image.standard_error))
    result.save(tmp_path / "m.tif")
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "m.tif"), result.image.mean)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "s.tif"), result.image.standard_error)
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")


def test_a_video_shows_what_the_average_leaves_out(frames, tmp_path):
    blank = (np.full((SIZE, SIZE), 9, np.uint8), G, 2.5)
    mixed = [*frames[:3], blank, *frames[3:]]
    without = stack(mixed, config="virtual_sem")
    result = stack(mixed, config="virtual_sem", video=tmp_path / "v.avi")
    assert result.image.frames == COUNT
    np.testing.assert_array_equal(result.image.mean, without.image.mean)
    assert (tmp_path / "v.avi").stat().st_size > 1000


def test_magnifications_refer_to_the_display_of_the_calibration():
    wide = replace(load_config("generic"), display_width_m=0.24)
    calibration = make_calibration()
    assert resolve_config(wide, calibration).display_width_m == calibration.display_width_m
    assert resolve_config(wide).display_width_m == 0.24
    # Squares that the configuration does not have are the calibration's, as it was made with --squares.
    assert resolve_config(wide, calibration).squares_m == wide.squares_m
    fine = replace(calibration, record=FitRecord(1e-5, squares_m=(0.7e-6,)))
    assert resolve_config(wide, fine).squares_m == (0.7e-6,)
    assert resolve_config(wide, frame_time_s=0.5).scan.frame_time_s == 0.5
    with pytest.raises(InvalidValueError):
        resolve_config(wide, frame_time_s=-1.0)


def test_an_average_without_drift_is_the_mean(frames):
    result = stack(frames, drift=False)
    assert result.path is None and result.states == {}
    np.testing.assert_allclose(
        result.image.mean[1:-1, 1:-1],
        np.mean([image for image, *_ in frames], axis=0)[1:-1, 1:-1],
        atol=1e-3,
    )


def test_of_several_magnifications_one_is_chosen(frames):
    both = [*frames[:2], (texture(), 5000.0, 2.0)]
    with pytest.raises(BagError, match="2 magnifications: 5000, 20000"):
        stack(both, drift=False)
    assert stack(both, drift=False, at=5000.0).image.frames == 1
    with pytest.raises(BagError, match="one of 5000, 20000"):
        stack(both, drift=False, at=7.0)
    with pytest.raises(BagError, match="order of time"):
        stack(frames[::-1], drift=False)


def test_outputs_are_refused_before_any_work(frames, tmp_path):
    floats = [(image.astype(np.float32), g, t) for image, g, t in frames]
    stages = []
    with pytest.raises(InvalidValueError, match="32FC1"):
        stack(floats, output=tmp_path / "m.png", on_progress=lambda *a: stages.append(a))
    assert stages[-1][1] <= 1 and not list(tmp_path.iterdir())


def test_the_drift_within_the_first_frame_is_said_to_be_left_in():
    timing = ScanTiming(2.0, 1, 0.1)
    scope = preset("ideal").with_image_size(SIZE, SIZE).with_timing(timing)

    def notes(speed_m_s: float) -> str:
        plan = drift_plan(
            scope,
            magnification=G,
            frames=4,
            interval_s=2.5,
            drift=Drift(velocity_m_s=(speed_m_s, 0.0)),
        )
        seen = [(plan.render(k), G, 2.5 * k) for k in range(4)]
        done = rectify(seen, calibration=make_calibration(), config="virtual_sem", frame_time_s=2.0)
        return " ".join(done.notes)

    assert "the drift within the first frame is left in" in notes(40e-9)
    assert "first frame" not in notes(1e-9)


def test_rectified_frames_in_memory_are_those_of_the_bag(frames, tmp_path):
    calibration = make_calibration()
    done = rectify(frames, calibration=calibration, config="virtual_sem")
    assert done.output is None and done.frame_count == COUNT
    assert done.extrapolated == COUNT  # 20 000x, calibrated up to 8000x
    assert [f.stamp_ns for f in done.frames] == [k * 10**9 for k in range(COUNT)]
    assert all(f.drift is not None for f in done.frames)
    assert sum(done.states.values()) == COUNT
    written = rectify(
        frames, tmp_path / "bag", calibration=calibration, config="virtual_sem", namespace="/a/"
    )
    assert written.frames == () and written.output == tmp_path / "bag"
    with open_recording(tmp_path / "bag") as bag:
        assert {topic.name for topic in bag.topics} >= {"/a/image_rect", "/a/camera_info"}
        images = [frame.image for frame in bag.frames()]
    np.testing.assert_array_equal(images, done.images)


def test_what_makes_a_result_doubtful_is_said_in_python_too(frames):
    calibration = make_calibration()
    done = rectify(frames, calibration=calibration, config="virtual_sem")
    assert done.warnings == (f"{COUNT} frames are outside the calibrated range",)
    result = stack(frames, calibration=calibration, drift=False)
    assert result.warnings == ("the frames are outside the calibrated range",)
    # Frames that have nothing in common with each other.
    noise = np.random.default_rng(0).integers(0, 255, (5, SIZE, SIZE), dtype=np.uint8)
    others = [(image, 2000.0, 1.0 * k) for k, image in enumerate(noise)]
    (warning,) = rectify(others, calibration=calibration).warnings
    assert warning == "none of 5 frames was tracked: the drift is not known, and was left in"
    inside = [(image, 2000.0, time) for image, _, time in frames]
    (warning,) = stack([*inside[:2], *((i, g, 9.0 + t) for i, g, t in others)]).warnings
    assert (
        warning
        == "5 of 7 frames left out: 5 frames: no shift stands out: featureless, or another place"
    )
    assert rectify(inside, calibration=calibration).warnings == ()
    assert stack(inside, calibration=calibration, drift=False).warnings == ()


def test_each_rectified_frame_in_a_bag_has_its_projection(frames, tmp_path):
    calibration = make_calibration()
    folder = tmp_path / "bag"
    rectify(frames, folder, calibration=calibration, config="virtual_sem", drift=False)
    flat = rectify(frames, calibration=calibration, config="virtual_sem", drift=False).frames
    seen = {"image_rect": [], "camera_info": [], "projection_stamped": []}
    with open_bag(folder) as bag:
        for message in bag.messages([f"/sem/{name}" for name in seen]):
            seen[message.topic.rpartition("/")[2]].append(message.message)
    for image, info, matrix, frame in zip(*seen.values(), flat, strict=True):
        assert matrix.header == image.header == info.header
        p_g = stamped_projection_from_message(matrix)
        np.testing.assert_allclose(p_g, frame.camera.P_affine, rtol=1e-12)
        np.testing.assert_allclose(p_g[:, :3], frame.camera.rho * info.k.reshape(3, 3))
        assert frame.camera.pixel_size_m[0] == frame.camera.pixel_size_m[1]


def test_without_drift_only_distortion_is_undone(frames):
    calibration = make_calibration()
    done = rectify(frames[:2], calibration=calibration, drift=False)
    assert done.states == {} and done.frames[0].drift is None
    for (image, g, _), flat in zip(frames, done.images, strict=False):
        np.testing.assert_array_equal(flat, calibration.rectify(image, g))


def test_the_pixel_size_is_that_of_the_calibration(frames, tmp_path):
    calibration = make_calibration()
    calibration.save(tmp_path / "cal.yaml")
    for given in (calibration, tmp_path / "cal.yaml", str(tmp_path / "cal.yaml")):
        result = stack(frames, calibration=given, drift=False)
        assert result.camera.pixel_size_m == calibration.at(G).rectified.pixel_size_m


def _recorded(tmp_path, size, **stated) -> RecordedFiles:
    """Files of five pictures of a size (width, height) with the scale of 20000x."""
    width, height = size
    pictures = np.stack([texture(k, 128)[:height, :width] for k in range(COUNT)])
    tifffile.imwrite(tmp_path / "s.tif", pictures, photometric="minisblack")
    return RecordedFiles(tmp_path / "s.tif", 0.12 / G / 128, **stated)


def test_a_region_is_refused_with_a_calibration_of_whole_images(tmp_path):
    """A camera of 96 x 96 px does not know where in the raster another region lies: it would be in its middle."""
    calibration = make_calibration()
    region = _recorded(tmp_path, (128, 128), roi=(10, 30, 64, 80))
    for workflow in (rectify, stack, track_drift):
        with pytest.raises(BagError, match=r"region of 64 x 80 px, with a .* 96 x 96 px; .*--mask"):
            workflow(region, calibration=calibration)
    # A calibration of such a region was made of the same one.
    same = _recorded(tmp_path, (128, 128), roi=(10, 30, 96, 96))
    assert len(rectify(same, calibration=calibration, drift=False).frames) == COUNT


def test_images_of_another_shape_than_the_calibrated_ones_are_noted(tmp_path):
    note = "a calibration of images of 96 x 96 px: their middles are taken for the same place"
    calibration = make_calibration()
    cut = rectify(
        _recorded(tmp_path, (128, 128), databar_rows=20), calibration=calibration, drift=False
    )
    assert any(note in line for line in cut.notes)
    whole = rectify(_recorded(tmp_path, (128, 128)), calibration=calibration, drift=False)
    assert not any("middles" in line for line in whole.notes)


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        ((texture(),), "magnification"),
        ((texture(), 0.0), "greater than 0"),
        ((np.zeros((4, 4), bool), 1.0), "bool"),
        ((np.zeros((4, 4, 3), np.uint16), 1.0), "uint16"),
        ((np.zeros((0, 4), np.uint8), 1.0), "shape"),
        ((texture(), 1.0, float("nan")), "finite time"),
        ((texture(), 1.0, "noon"), "time in s"),
        ((texture(), "high"), "magnification high"),
        (([[1, 2], [3]], 1.0), "array of grey levels"),
    ],
)
def test_images_that_cannot_be_used_are_named(entry, reason):
    with pytest.raises(InvalidValueError, match=reason):
        track_drift([entry])


@pytest.mark.parametrize(
    ("workflow", "arguments", "reason"),
    [
        (calibrate, {"display_width_m": -1}, "display_width_m -1"),
        (calibrate, {"display_width_m": "wide"}, "display_width_m wide"),
        (calibrate, {"display_width_m": 120.0}, "at most 100"),
        (calibrate, {"squares_m": []}, "squares_m"),
        (calibrate, {"squares_m": 5e-6}, "squares_m"),
        (calibrate, {"squares_m": [5e-6, float("nan")]}, "squares_m"),
        (calibrate, {"breakpoints": 500.0}, "breakpoints"),
        (calibrate, {"method": "best"}, "method"),
        (calibrate, {"config": 3}, "configuration of type int"),
        (track_drift, {"frame_time_s": "1"}, "frame time 1 s"),
        (track_drift, {"calibration": 3}, "calibration of type int"),
        (stack, {"at": "all"}, "at = all"),
        (stack, {"video": "film.mkv"}, "mp4 or .avi"),
        (stack, {"video": "film.avi", "fps": 1e9}, "0.1 to 240"),
        (stack, {"output": "mean.jpg"}, "mean.jpg"),
        (stack, {"sigma": "sigma.png"}, "sigma.png"),
        (rectify, {"calibration": None}, "calibration of type NoneType"),
        (rectify, {"calibration": make_calibration(), "namespace": "my sem"}, "namespace"),
        (rectify, {"calibration": make_calibration(), "interpolation": "no"}, "interpolation"),
        (measure_cantilever, {"calibration": make_calibration(), "length_m": None}, "length_m"),
        (
            measure_cantilever,
            {"calibration": make_calibration(), "length_m": 35e-6, "poses": 1.5},
            "1.5 poses",
        ),
        (
            measure_cantilever,
            {"calibration": make_calibration(), "length_m": 35e-6, "bases": [1], "tips": [2]},
            "x and y",
        ),
        (reconstruct, {"calibration": make_calibration(), "spacing_px": -1.0}, "spacing_px"),
        (reconstruct, {"calibration": make_calibration(), "keyframes": 0}, "keyframes"),
        (reconstruct, {"calibration": make_calibration(), "height_sigma_m": -1}, "height_sigma_m"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(workflow, arguments, reason):
    with pytest.raises(semcal_ros.SemcalError, match=reason) as refused:
        workflow([(texture(), 1000.0), (texture(), 1000.0)], **arguments)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("workflow", [calibrate, stack, track_drift])
@pytest.mark.parametrize("source", [None, 5])
def test_a_source_that_is_none_is_refused(workflow, source):
    with pytest.raises(InvalidValueError, match="source of type"):
        workflow(source)


def test_grey_levels_of_any_type_and_colours_are_taken():
    grey = texture()
    for image in (grey.astype(float), grey.astype(np.int32), np.dstack([grey] * 3)):
        mean = stack([(image, 1000.0)], drift=False).image.mean
        np.testing.assert_allclose(mean[1:-1, 1:-1], grey[1:-1, 1:-1], atol=1e-3)
    with pytest.raises(BagError, match="usable"):
        stack([], drift=False)
    with pytest.raises(InvalidValueError, match="one beside each"):
        stack([(grey, 1000.0)], magnification=1000.0)


SCOPE = preset("ideal").with_image_size(256, 256)


def test_bending_of_a_cantilever_in_memory(tmp_path):
    plan = cantilever_plan(
        SCOPE,
        pushes=(0.0, 1.0),
        magnifications=(6450.0,),
        view="end",
        drift=Drift(velocity_m_s=(8e-9, -5e-9)),
        seed=7,
    )
    images = [
        (plan.render(k), f.magnification, 1e-9 * f.stamp_ns if hasattr(f, "stamp_ns") else float(k))
        for k, f in enumerate(plan.frames)
    ]
    calibration = _ideal_calibration()
    done = measure_cantilever(
        images, calibration=calibration, length_m=35e-6, config="virtual_sem", poses=2
    )
    (one,) = done.series
    assert one.poses == (1, 2) and one.recording == "memory"
    deflection = one.measured.frames[1]
    assert abs(deflection.deflection_m - 250e-9) < 4.0 * deflection.sigma_m
    assert done.repeatability.deflection_m.shape == (1, 2)
    done.save(tmp_path / "d.csv")
    with (tmp_path / "d.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[1]["deflection_m"]) == deflection.deflection_m
    with pytest.raises(InvalidValueError, match="1 bases and 0 tips"):
        measure_cantilever(images, calibration=calibration, length_m=35e-6, bases=[(1.0, 2.0)])
    with pytest.raises(InvalidValueError, match="one or the other"):
        measure_cantilever(["a", images[0]], calibration=calibration, length_m=35e-6)


def _ideal_calibration():
    from semcal_ros import Calibration
    from semcal_ros.core.camera.continuous_function import ContinuousFunction

    camera = SCOPE.camera_at(7000.0)
    values = {name: getattr(camera, name) for name in ("aspect", "skew", "px", "py", "rho")}
    values |= {"scale": 1.0, "xi_r": 0.0, "xi_t": 0.0, "ex": camera.ex, "ey": camera.ey}
    return Calibration(
        functions={
            name: ContinuousFunction("chebyshev_log", np.array([value]), (1000.0, 10000.0))
            for name, value in values.items()
        },
        covariance=1e-6 * np.eye(len(values)),
        image_width=256,
        image_height=256,
        display_width_m=SCOPE.display_width_m,
        magnifications=(1000.0, 10000.0),
        method="joint",
    )


def test_an_evaluation_needs_a_grid(frames):
    with pytest.raises(semcal_ros.SemcalError, match="no usable view"):
        evaluate(make_calibration(), frames)
