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

"""``semcal drift --plot`` and ``semcal stack`` on small recordings of the virtual SEM."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import av
import cv2
import numpy as np
import pytest
import tifffile

from semcal_ros.bridge.fields import fill_header, stamp_ns_from_msg
from semcal_ros.bridge.images import fill_image, image_from_message
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.reader import open_bag
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.video import VideoWriter
from semcal_ros.synthetic import Drift, drift_plan, preset
from semcal_ros.workflows.track_drift import describe_rate
from tests.files.images.test_to_bag import write_tescan
from tests.helpers.drift_scenes import make_drift_update
from tests.helpers.node_scenes import make_calibration
from tests.helpers.semcal_runs import refused, run

FRAMES, SIZE, G = 9, 160, 20000.0
Change = Callable[[int, np.ndarray, int], tuple[np.ndarray, int]]


def simulated(path: Path, *more: object) -> Path:
    command = ("simulate", path, "--plan", "drift", "--magnification", G, "--size", SIZE)
    assert run(*command, "--frames", FRAMES, "--drift", "fast", *more) == 0
    return path


def changed(source: Path, target: Path, change: Change, encoding: str = "mono8") -> Path:
    """A copy of a recording whose images and stamps went through ``change``."""
    index = 0
    with open_bag(source) as bag, BagWriter(target) as writer:
        for found in bag.messages():
            message: Any = found.message
            if found.topic == "/sem/image_raw":
                image, stamp_ns = image_from_message(message), stamp_ns_from_msg(message)
                image, stamp_ns = change(index, image, stamp_ns)
                fill_header(message.header, stamp_ns, "sem_optical")
                fill_image(message, image, encoding, message.header)
                index += 1
            writer.write(found.topic, found.log_time_ns, message)
    return target


@pytest.fixture(scope="module")
def gold(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("drift") / "gold")


@pytest.fixture(scope="module")
def blanked(gold: Path) -> Path:
    """The beam is blanked in frames 3 and 6."""
    return changed(
        gold,
        gold.parent / "blanked",
        lambda k, image, t: (np.full_like(image, 9) if k in (3, 6) else image, t),
    )


@pytest.mark.slow
def test_plot_and_table_of_the_same_drift(blanked, tmp_path, capsys):
    table, plot = tmp_path / "d.csv", tmp_path / "d.png"
    command = ("drift", blanked, "--config", "virtual_sem", "-o", table)
    assert run(*command, "--plot", plot) == 0
    out = capsys.readouterr().out
    assert "2 frames coasting: image: blank" in out
    assert f"plot: {plot}" in out
    image = cv2.imread(str(plot))
    assert image.shape[0] > 600 and image.shape[1] > 1000
    assert image.std() > 5  # something is drawn
    before = table.read_bytes()
    assert run(*command) == 0
    assert run("drift", blanked, "--config", "virtual_sem", "-o", tmp_path / "l.csv", "--live") == 0
    assert table.read_bytes() == before
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert (
        ",".join(rows[0])
        == "stamp_ns,dx_m,dy_m,sigma_x_m,sigma_y_m,dx_px,dy_px,sigma_x_px,sigma_y_px,status,"
        "correlation_m,correlation_px"
    )
    assert [r["status"].split(":")[0] for r in rows].count("coasting") == 2


def test_the_final_rate_is_that_of_the_truth(gold, tmp_path, capsys):
    capsys.readouterr()
    assert run("drift", gold, "--config", "virtual_sem", "-o", tmp_path / "d.csv") == 0
    pattern = r"^final drift rate: x (\S+) \+- (\S+), y (\S+) \+- (\S+) nm/s$"
    (found,) = re.findall(pattern, capsys.readouterr().out, re.MULTILINE)
    x, sigma_x, y, sigma_y = map(float, found)
    frames = json.loads((gold / "truth.json").read_text())["frames"]
    times = [f["start_time_s"] for f in frames]
    drift = 1e9 * np.array([f["drift_m"] for f in frames])
    rate = (drift[-1] - drift[-2]) / (times[-1] - times[-2])
    # Four deviations, and a percent because the pixel size is only nominal.
    assert x == pytest.approx(rate[0], abs=4 * sigma_x + 0.01 * abs(rate[0]))
    assert y == pytest.approx(rate[1], abs=4 * sigma_y + 0.01 * abs(rate[1]))


def test_a_forecast_holds_the_drift_to_come(gold, tmp_path, capsys):
    table = tmp_path / "d.csv"
    assert run("drift", gold, "--config", "virtual_sem", "-o", table, "--forecast", 2) == 0
    pattern = r"^drift 2 s after the last frame: x (\S+) \+- (\S+), y (\S+) \+- (\S+) nm$"
    (found,) = re.findall(pattern, capsys.readouterr().out, re.MULTILINE)
    x, sigma_x, y, sigma_y = map(float, found)
    with open(table, newline="") as file:
        last = list(csv.DictReader(file))[-1]
    # It goes on from where it was, less certain than there.
    assert sigma_x > 1e9 * float(last["sigma_x_m"])
    assert sigma_y > 1e9 * float(last["sigma_y_m"])
    assert abs(x - 1e9 * float(last["dx_m"])) < 200.0 + 4 * sigma_x
    assert abs(y - 1e9 * float(last["dy_m"])) < 200.0 + 4 * sigma_y


def test_the_rate_is_given_with_two_digits_of_its_uncertainty():
    variances = [0.0, 0.0, (0.123e-9) ** 2, (4.56e-9) ** 2]
    path = DriftPath(
        [
            make_drift_update(time_s=0.0),
            make_drift_update(
                time_s=1.0,
                velocity_m_s=np.array([1.23456e-9, -20e-9]),
                covariance=np.diag(variances),
            ),
        ]
    )
    assert describe_rate(path) == "final drift rate: x 1.23 +- 0.12, y -20.00 +- 4.56 nm/s"


def test_plots_are_refused_before_any_work(gold, tmp_path, capsys):
    table = tmp_path / "d.csv"
    assert ".png, .svg, .pdf" in refused(
        capsys, "drift", gold, "-o", table, "--plot", tmp_path / "d.jpg"
    )
    assert "folder" in refused(
        capsys, "drift", gold, "-o", table, "--plot", tmp_path / "no" / "d.png"
    )
    assert "another output" in refused(capsys, "stack", gold, "-o", "m.tif", "--sigma", "m.tif")
    suffixes = "a name that ends in .csv, .parquet, .xlsx"
    assert suffixes in refused(capsys, "drift", gold, "-o", tmp_path / "d.png")
    assert not list(tmp_path.iterdir())


def test_the_average_is_sharp_and_its_noise_is_as_stated(gold, tmp_path, capsys):
    """Nine frames at nine places against nine that are averaged where they are."""
    mean, sigma = tmp_path / "mean.tif", tmp_path / "sigma.tif"
    command = ("stack", gold, "--config", "virtual_sem")
    assert run(*command, "-o", mean, "--sigma", sigma) == 0
    out = capsys.readouterr().out
    assert f"{FRAMES} of {FRAMES} frames averaged" in out
    still = tmp_path / "still"
    size = ("--magnification", G, "--size", SIZE, "--frames", 16, "--drift", "none")
    assert run("simulate", still, "--plan", "drift", *size, "--electrons", 0) == 0
    with open_bag(still) as bag:
        found = [image_from_message(m.message) for m in bag.messages(["/sem/image_raw"])]
    frame = np.mean(found, axis=0)  # the noise of the amplifier is left at a quarter
    # The specimen has drifted a little by the centre of the first frame, whose place is kept.
    first = json.loads((gold / "truth.json").read_text())["frames"][0]
    x, y = np.divide(first["drift_m"], first["pixel_size_m"])
    moved = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
    truth = cv2.warpAffine(frame.astype(np.float32), moved, (SIZE, SIZE), flags=cv2.INTER_CUBIC)
    assert run(*command, "-o", tmp_path / "plain.tif", "--no-drift") == 0
    corrected, plain = (tifffile.imread(p) for p in (mean, tmp_path / "plain.tif"))
    stated = tifffile.imread(sigma)
    inner = (slice(24, -24), slice(24, -24))  # seen in all frames
    errors = [(m - truth)[inner] for m in (corrected, plain)]
    rms = [float(np.sqrt(np.mean(e**2))) for e in errors]
    expected = float(np.sqrt(np.mean(stated[inner] ** 2)))
    # A fifth for the noise of the truth and for sharp edges that no interpolation follows.
    assert rms[0] == pytest.approx(expected, rel=0.2)
    assert rms[1] > 2 * rms[0]


def test_the_pixel_size_is_in_the_tiff(gold, tmp_path, capsys):
    model = make_calibration()
    model.save(tmp_path / "cal.yaml")
    out = tmp_path / "mean.tiff"
    assert run("stack", gold, "--calibration", tmp_path / "cal.yaml", "-o", out) == 0
    with tifffile.TiffFile(out) as file:
        page = file.pages[0]
        # The resolution tags are what ImageJ reads, OME-XML what Bio-Formats does.
        assert page.tags["ResolutionUnit"].value == 3  # cm
        per_cm = [np.divide(*page.tags[name].value) for name in ("XResolution", "YResolution")]
        assert page.dtype == np.float32 and page.shape == (SIZE, SIZE)
        stated = float(re.search('PhysicalSizeX="([^"]+)"', file.ome_metadata)[1])
    # The 96 px of the calibration and the 160 px of the frames show the same field.
    expected = np.array(model.at(G).rectified.pixel_size_m) * 96 / SIZE
    np.testing.assert_allclose(0.01 / np.array(per_cm), expected, rtol=1e-6)
    assert stated == pytest.approx(1e6 * expected[0], rel=1e-9)


def test_frames_without_drift_are_left_out(blanked, tmp_path, capsys):
    out = tmp_path / "mean.png"
    assert run("stack", blanked, "--config", "virtual_sem", "-o", out) == 0
    told = capsys.readouterr().out
    assert f"{FRAMES - 2} of {FRAMES} frames averaged" in told
    assert "2 frames coasting: image: blank" in told
    with_blank = tmp_path / "all.png"
    assert run("stack", blanked, "--no-drift", "-o", with_blank) == 0
    mean, darker = (cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in (out, with_blank))
    assert mean.dtype == np.uint8 and mean.shape == (SIZE, SIZE)
    # Two of nine frames are black.
    assert np.median(darker / np.maximum(mean, 1)[:, :]) == pytest.approx(7 / 9, abs=0.1)


def test_png_is_as_deep_as_the_recording(gold, tmp_path, capsys):
    deep = changed(
        gold, tmp_path / "deep", lambda k, image, t: (image.astype(np.uint16) * 200, t), "mono16"
    )
    assert run("stack", deep, "-o", tmp_path / "m.png", "--video", tmp_path / "v.avi") == 0
    assert run("stack", gold, "-o", tmp_path / "m.tif") == 0
    image = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    mean = np.nan_to_num(tifffile.imread(tmp_path / "m.tif"))
    # The drifts of both differ by far less than 0.01 px; slopes are below 60 levels per px.
    np.testing.assert_allclose(image / 200, np.clip(mean, 0, None), atol=0.6)
    video = _frames(tmp_path / "v.avi")
    assert len(video) == FRAMES
    # 16 bits are stretched to what there is.
    assert np.percentile(video[0], 99) > 200
    capsys.readouterr()
    floats = changed(
        gold, tmp_path / "floats", lambda k, image, t: (image.astype(np.float32), t), "32FC1"
    )
    assert ".tif" in refused(capsys, "stack", floats, "-o", tmp_path / "f.png")
    assert run("stack", floats, "-o", tmp_path / "f.tif") == 0
    np.testing.assert_allclose(np.nan_to_num(tifffile.imread(tmp_path / "f.tif")), mean, atol=0.1)


def _frames(path: Path) -> list[np.ndarray]:
    reader = cv2.VideoCapture(str(path))
    assert reader.isOpened()
    frames = []
    while True:
        there, image = reader.read()
        if not there:
            break
        frames.append(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    reader.release()
    return frames


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_the_video_stands_still(blanked, tmp_path, suffix, capsys):
    video = tmp_path / f"v{suffix}"
    names = ("-o", tmp_path / "m.png", "--video", video, "--fps", 5)
    assert run("stack", blanked, "--config", "virtual_sem", *names) == 0
    assert f"video: {video}" in capsys.readouterr().out
    frames = _frames(video)
    assert len(frames) == FRAMES
    assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FPS) == pytest.approx(5)
    cut = (slice(16, 128), slice(16, -16))  # without the text and the moving edge
    first, last = frames[0][cut].astype(float), frames[-1][cut].astype(float)
    shift, _ = cv2.phaseCorrelate(first, last)
    # The specimen moved by several px; the codec leaves a few hundredths.
    assert np.hypot(*shift) < 0.15
    assert frames[3][cut].mean() < 0.5 * frames[2][cut].mean()  # the blanked one is shown, too
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.png", f"v{suffix}"]


def test_odd_sizes_become_even_in_the_video(tmp_path, gold):
    odd = changed(gold, tmp_path / "odd", lambda k, image, t: (image[:-11, :-7], t))
    assert run("stack", odd, "-o", tmp_path / "m.tif", "--video", tmp_path / "v.mp4") == 0
    frames = _frames(tmp_path / "v.mp4")
    assert len(frames) == FRAMES and frames[0].shape == (150, 154)
    assert tifffile.imread(tmp_path / "m.tif").shape == (149, 153)


def test_a_magnification_is_chosen(tmp_path, capsys):
    steps, out = tmp_path / "steps", tmp_path / "m.tif"
    two = ("--magnification", 3000, "--magnification", 4000, "--size", 96, "--frames", 3)
    assert run("simulate", steps, "--plan", "steps", "--specimen", "gold", *two) == 0
    line = refused(capsys, "stack", steps, "-o", out)
    assert "2 magnifications: 3000, 4000" in line and "--at" in line
    assert "one of 3000, 4000" in refused(capsys, "stack", steps, "-o", out, "--at", 3500)
    assert not out.exists()
    assert run("stack", steps, "-o", out, "--at", 4000) == 0
    assert "3 of 3 frames averaged, 312.5 x 312.5 nm per px" in capsys.readouterr().out


def test_frames_of_another_size_are_left_out(gold, tmp_path, capsys):
    mixed = changed(
        gold, tmp_path / "mixed", lambda k, image, t: (image[:120] if k == 4 else image, t)
    )
    assert run("stack", mixed, "-o", tmp_path / "m.tif") == 0
    captured = capsys.readouterr()
    assert f"{FRAMES - 1} of {FRAMES - 1} frames averaged" in captured.out
    assert "note: 1 frame of another size" in captured.err


def test_after_a_move_of_the_stage_nothing_is_averaged(tmp_path, capsys):
    """The tracker starts anew at a guess; what it follows then is another place."""
    long = tmp_path / "long"
    command = ("simulate", long, "--plan", "drift", "--magnification", G, "--size", 96)
    assert run(*command, "--frames", 16) == 0
    moved = changed(
        long,
        tmp_path / "moved",
        lambda k, image, t: (np.ascontiguousarray(image[::-1, ::-1]) if k >= 4 else image, t),
    )
    capsys.readouterr()
    assert run("stack", moved, "--config", "virtual_sem", "-o", tmp_path / "m.tif") == 0
    captured = capsys.readouterr()
    assert "4 of 16 frames averaged" in captured.out
    assert "tracking was lost" in captured.err


def test_bad_input_is_one_line_and_leaves_nothing(gold, tmp_path, capsys, monkeypatch):
    out, video = tmp_path / "m.tif", tmp_path / "v.mp4"
    assert ".png" in refused(capsys, "stack", gold, "-o", tmp_path / "m.jpg")
    assert ".tif" in refused(capsys, "stack", gold, "-o", out, "--sigma", tmp_path / "s.png")
    assert ".mp4" in refused(capsys, "stack", gold, "-o", out, "--video", tmp_path / "v.mov")
    assert "folder" in refused(capsys, "stack", gold, "-o", tmp_path / "no" / "m.tif")
    assert "another output" in refused(capsys, "stack", gold, "-o", out, "--sigma", out)
    assert "recording" in refused(capsys, "stack", gold, "-o", gold / "m.tif")
    assert "does not exist" in refused(capsys, "stack", tmp_path / "none", "-o", out)
    cal = ("--calibration", tmp_path / "no.yaml")
    assert "no.yaml" in refused(capsys, "stack", gold, *cal, "-o", out)
    assert not list(tmp_path.iterdir())
    broken = changed(gold, tmp_path / "back", lambda k, image, t: (image, t - (k == 5) * 10**10))
    assert "order of time" in refused(capsys, "stack", broken, "-o", out)
    blank = changed(gold, tmp_path / "blank", lambda k, image, t: (np.full_like(image, 9), t))
    assert "--no-drift" in refused(capsys, "stack", blank, "-o", out, "--video", video)
    monkeypatch.setattr(av, "codecs_available", {"mjpeg"})
    assert "FFmpeg" in refused(capsys, "stack", gold, "-o", out, "--video", video)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["back", "blank"]


def test_a_video_that_is_not_whole_is_not_kept(gold, tmp_path, capsys, monkeypatch):
    write, written = VideoWriter.write, iter(range(100))

    def write_some(self, *frame):
        if next(written) < 3:
            write(self, *frame)

    monkeypatch.setattr(VideoWriter, "write", write_some)
    out, video = tmp_path / "m.tif", tmp_path / "v.mp4"
    assert "3 of 9 frames" in refused(capsys, "stack", gold, "-o", out, "--video", video)
    assert not list(tmp_path.iterdir())


# -- scan timing that the configuration does not tell ---------------------------------------------

PASS_S = 0.9


def recorded(target: Path, drift: Drift, frames: int) -> Path:
    """One frame per second, of a single pass each."""
    microscope = preset("ideal").with_image_size(SIZE, SIZE).with_timing(ScanTiming(PASS_S, 1, 0.1))
    plan = drift_plan(microscope, magnification=G, frames=frames, interval_s=1.0, drift=drift)
    with BagWriter(target) as writer:
        writer.add_topic("/sem/magnification", "std_msgs/msg/Float64", latched=True, depth=1)
        value = blank_message("std_msgs/msg/Float64")
        value.data = G
        writer.write("/sem/magnification", 0, value)
        for k in range(frames):
            image = blank_message("sensor_msgs/msg/Image")
            fill_header(image.header, (k + 1) * 10**9, "sem_optical")
            fill_image(image, plan.render(k), "mono8", image.header)
            writer.write("/sem/image_raw", (k + 1) * 10**9, image)
    return target


SWAYING = Drift(wander_m=25e-9, wander_period_s=(30.0, 12.0), seed=4)


@pytest.fixture(scope="module")
def swaying(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drift whose velocity changes enough to tell how long a pass takes."""
    return recorded(tmp_path_factory.mktemp("scan") / "swaying", SWAYING, 20)


SEEN = re.compile(
    r"^note: the configuration has no scan; the frames are sheared as if one pass took "
    r"(\S+) \+- (\S+) s(.*)$",
    re.MULTILINE,
)


def rms_nm(table: Path) -> float:
    """Error of the drift at the centre of each frame against that of the first one."""
    with table.open() as file:
        rows = list(csv.DictReader(file))
    found = np.array([[float(r["dx_m"]), float(r["dy_m"])] for r in rows])
    truth = SWAYING(np.arange(len(rows)) + 0.5 * PASS_S)
    error = found - (truth - truth[0])
    return 1e9 * float(np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)))


@pytest.mark.slow
def test_the_time_of_a_pass_is_seen_and_the_shear_removed(swaying, tmp_path, capsys):
    tables = [tmp_path / f"{name}.csv" for name in ("seen", "given", "live")]
    assert run("drift", swaying, "-o", tables[0]) == 0
    captured = capsys.readouterr()
    ((time_s, sigma_s, more),) = SEEN.findall(captured.err)
    assert float(time_s) == pytest.approx(PASS_S, abs=3 * float(sigma_s))
    assert float(sigma_s) < 0.15 and more == ""
    assert run("drift", swaying, "-o", tables[1], "--frame-time", time_s) == 0
    assert "no scan" not in capsys.readouterr().err
    # The note is rounded.
    drift = [np.loadtxt(t, delimiter=",", skiprows=1, usecols=(1, 2)) for t in tables[:2]]
    np.testing.assert_allclose(*drift, atol=1e-9)
    assert rms_nm(tables[0]) < 0.05 * 1e9 * 0.12 / G / SIZE
    assert run("drift", swaying, "-o", tables[2], "--live") == 0
    ((_, _, more),) = SEEN.findall(capsys.readouterr().err)
    assert "--frame-time" in more


@pytest.mark.long
@pytest.mark.slow
def test_the_average_is_made_with_the_time_that_was_seen(swaying, tmp_path, capsys):
    out, command = tmp_path / "seen.tif", ("stack", swaying, "-o")
    assert run(*command, out) == 0
    captured = capsys.readouterr()
    ((_, _, more),) = SEEN.findall(captured.err)
    assert more == "" and "20 of 20 frames averaged" in captured.out
    images = [tifffile.imread(out)]
    for time_s in (PASS_S, 1e-6):
        assert run(*command, out, "--frame-time", time_s) == 0
        assert "no scan" not in capsys.readouterr().err
        images.append(tifffile.imread(out))
    inner = (slice(24, -24), slice(24, -24))
    seen, true, instants = (image[inner] for image in images)
    # What is right to a few percent leaves a few percent of what the shear does.
    assert np.std(seen - true) < 0.25 * np.std(instants - true)


@pytest.mark.slow
def test_rectify_tells_the_time_for_another_run(swaying, tmp_path, capsys):
    make_calibration().save(tmp_path / "cal.yaml")
    command = ("rectify", swaying, "--calibration", tmp_path / "cal.yaml")
    assert run(*command, "-o", tmp_path / "a") == 0
    err = capsys.readouterr().err
    ((_, _, more),) = SEEN.findall(err)
    assert "--frame-time" in more
    assert run(*command, "-o", tmp_path / "b", "--frame-time", 0.9) == 0
    assert run(*command, "-o", tmp_path / "c", "--no-drift") == 0
    assert "no scan" not in capsys.readouterr().err


def test_a_fast_drift_without_a_known_raster_is_told(tmp_path, capsys):
    steady = recorded(tmp_path / "steady", Drift(velocity_m_s=(60e-9, 0.0)), 8)
    capsys.readouterr()
    assert run("drift", steady, "-o", tmp_path / "d.csv") == 0
    err = capsys.readouterr().err
    assert re.search(r"no scan; drift of up to 1\.[56] px .*--frame-time", err), err
    for value in ("0", "-1", "nan", "inf"):
        command = ("drift", steady, "-o", tmp_path / "d.csv")
        assert run(*command, f"--frame-time={value}") == 2
        capsys.readouterr()


def test_a_configured_scan_is_believed(gold, tmp_path, capsys):
    capsys.readouterr()
    assert run("drift", gold, "--config", "virtual_sem", "-o", tmp_path / "d.csv") == 0
    assert "scan" not in capsys.readouterr().err


def test_help_has_an_example(capsys):
    assert run("stack", "--help") == 0
    assert "semcal stack recordings/gold" in capsys.readouterr().out
    assert run("--help") == 0
    assert "  stack " in capsys.readouterr().out


def test_the_video_of_a_drift_shows_it_and_its_correction(gold, tmp_path):
    """The right half stands still, the left one does not."""
    video = tmp_path / "d.avi"
    common = ("drift", gold, "--config", "virtual_sem", "-o", tmp_path / "d.csv")
    assert run(*common, "--video", video) == 0
    frames = np.stack(_frames(video)).astype(np.float64)
    if frames.ndim == 4:
        frames = frames[..., 0]
    assert len(frames) == FRAMES
    inner = slice(30, SIZE - 60)  # above the caption and the bar
    left, right = frames[:, inner, 30 : SIZE - 30], frames[:, inner, -SIZE + 30 : -30]
    changes = [float(np.std(half - half[0], axis=0)[...].mean()) for half in (left, right)]
    # What remains on the right is noise.
    assert changes[0] > 1.3 * changes[1]


def test_corrected_pictures_are_those_of_the_bag(gold, tmp_path, capsys):
    make_calibration().save(tmp_path / "cal.yaml")
    common = ("rectify", gold, "--calibration", tmp_path / "cal.yaml", "--config", "virtual_sem")
    assert run(*common, "-o", tmp_path / "bag") == 0
    with open_bag(tmp_path / "bag") as bag:
        messages = [m.message for m in bag.messages(["/sem/image_rect"])]
    images = [image_from_message(message) for message in messages]
    assert run(*common, "-o", tmp_path / "all.tif", "--scale-bar") == 0
    with tifffile.TiffFile(tmp_path / "all.tif") as file:
        pages, said = file.asarray(), file.ome_metadata
    assert pages.dtype == np.uint8
    # The databar stands below; the picture is what it is in the bag.
    np.testing.assert_array_equal(pages[:, :SIZE], images)
    assert pages.shape[1] > SIZE
    # As long as nothing is known about more pixels than the calibration's.
    expected_m = make_calibration().at(G).resized(SIZE, SIZE).rectified.pixel_size_m[0]
    stated = float(re.search('PhysicalSizeX="([^"]+)"', said)[1])
    assert stated == pytest.approx(1e6 * expected_m, rel=1e-9)
    times = [float(t) for t in re.findall('DeltaT="([^"]+)"', said)]
    start_ns = stamp_ns_from_msg(messages[0].header)
    expected_s = [1e-9 * (stamp_ns_from_msg(m.header) - start_ns) for m in messages]
    assert times == pytest.approx(expected_s)
    # The pictures are a recording again: the same field, without the databar.
    capsys.readouterr()
    assert run("info", tmp_path / "all.tif") == 0
    assert f"{FRAMES} x {SIZE} x {SIZE} mono8" in capsys.readouterr().out
    assert run(*common, "-o", f"{tmp_path}/pictures/") == 0
    files = sorted((tmp_path / "pictures").iterdir())
    np.testing.assert_array_equal([tifffile.imread(f) for f in files], images)


def test_a_corrected_file_says_its_own_pixel_size_and_how_it_was_taken(tmp_path):
    write_tescan(tmp_path / "t.tif", 50e-9, (96, 96), "10:00:00", angles="HV=15000.0\n")
    calibration = make_calibration()
    calibration.save(tmp_path / "cal.yaml")
    common = ("rectify", tmp_path / "t.tif", "--calibration", tmp_path / "cal.yaml")
    assert run(*common, "-o", f"{tmp_path}/out/", "--no-drift") == 0
    with tifffile.TiffFile(tmp_path / "out" / "t.tif") as file:
        text = ElementTree.fromstring(file.ome_metadata)
    said = json.loads(next(e.text for e in text.iter() if e.tag.endswith("Description")))
    g = calibration.display_width_m / (96 * 50e-9)
    assert said["pixel_size_m"] == pytest.approx(calibration.at(g).rectified.pixel_size_m[0])
    assert said["conditions"]["acceleration_voltage_v"] == 15000.0
    assert said["conditions"]["maker"] == "tescan"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("x.mcap", "expected x.tif, a folder of TIFFs x/"),
        ("x.jpg", "expected x.tif, a folder of TIFFs x/"),
        ("x.png", "x.png for 9 frames; expected one frame for a PNG"),
        ("bag", "a scale bar in the bag"),
    ],
)
def test_names_that_contradict_are_refused(gold, tmp_path, capsys, name, reason):
    make_calibration().save(tmp_path / "cal.yaml")
    more = ("-o", tmp_path / name, "--scale-bar")
    assert reason in refused(capsys, "rectify", gold, "--calibration", tmp_path / "cal.yaml", *more)
    assert not (tmp_path / name).exists()
