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

"""Every command with every kind of input, as a table: done, refused in one line, or a traceback.

    python -m benchmarks.inputs [--messages]

Each kind holds what its command is for: views of a grid (calibrate, check, update, evaluate), gold that drifts, a
cantilever that bends, or a tilted specimen, all of the virtual microscope. Refused is an exit status of 2 or 1 with one
line that says why; ``--messages`` prints these lines.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from benchmarks.table import show
from semcal_ros.cli import main as semcal
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.synthetic import RecordingPlan, calibration_plan, drift_plan, drift_preset, preset
from semcal_ros.synthetic.specimens.cantilever import CantileverPlan, cantilever_plan

Images = Sequence[NDArray[Any]]
SIZE = 256
DISPLAY_M = 0.12
INTERVAL_S = 2
TILT_DEG = 12.0


@dataclass(frozen=True)
class Scene:
    """What a command is for: images of one magnification, and the plan that wrote them as a bag."""

    images: Images
    pixel_m: float
    plan: RecordingPlan | CantileverPlan | None = None

    @property
    def pixel_size(self) -> list[str]:
        return ["--pixel-size", f"{1e9 * self.pixel_m:.9g}nm"]


def make_scenes() -> dict[str, Scene]:
    """Small scenes of the virtual microscope."""
    scope = preset("jsm820").with_image_size(SIZE, SIZE)
    grid = calibration_plan(scope, magnifications=[1000.0], views=6, seed=3)
    gold = drift_plan(
        scope, magnification=5000.0, frames=4, kind="gold", drift=drift_preset("slow"), seed=1
    )
    beam = cantilever_plan(scope, pushes=(0.0, 1.0), magnifications=(6450.0,), view="end", seed=7)
    relief = Scene(_relief(), 20e-9)

    def scene(plan: Any, g: float) -> Scene:
        return Scene([plan.render(k) for k in range(len(plan))], DISPLAY_M / g / SIZE, plan)

    return {
        "grid": scene(grid, 1000.0),
        "gold": scene(gold, 5000.0),
        "beam": scene(beam, 6450.0),
        "relief": relief,
    }


def _relief() -> Images:
    """A hilly specimen without and with a tilt about the columns."""
    rng = np.random.default_rng(0)
    rough = cv2.GaussianBlur(rng.normal(size=(SIZE, 2 * SIZE)), (0, 0), 1.5)
    height = cv2.GaussianBlur(rng.normal(size=rough.shape), (0, 0), 20.0)
    height *= 12.0 / np.abs(height).max()
    x = np.arange(2 * SIZE) - SIZE
    seen = np.arange(SIZE) - SIZE / 2.0
    images = []
    for tilt in (0.0, np.radians(TILT_DEG)):
        at = x * np.cos(tilt) + height * np.sin(tilt)
        image = np.array([np.interp(seen, a, r) for a, r in zip(at, rough, strict=True)])
        noisy = 128.0 + 40.0 * image / rough.std() + rng.normal(size=image.shape)
        images.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return images


def _each(suffix: str, change: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray) -> Any:
    def write(folder: Path, scene: Scene) -> Path:
        folder.mkdir()
        for k, image in enumerate(scene.images):
            path = folder / f"f{k:02d}.{suffix}"
            if suffix == "tif":
                kind = "rgb" if change(image).ndim == 3 else "minisblack"
                tifffile.imwrite(path, change(image), photometric=kind)
            else:
                cv2.imwrite(str(path), change(image))
        return folder

    return write


def _zeiss(folder: Path, scene: Scene) -> Path:
    folder.mkdir()
    for k, image in enumerate(scene.images):
        entries = [
            *("AP_IMAGE_PIXEL_SIZE", f"Image Pixel Size = {1e9 * scene.pixel_m:.6g} nm"),
            *("AP_DATE", "Date :11 Apr 2023", "AP_TIME", f"Time :08:40:{INTERVAL_S * k:02d}"),
        ]
        data = "\r\n".join(["0"] * 11 + entries).encode("cp1252") + b"\0"
        tag = (34118, 2, len(data), data, True)
        tifffile.imwrite(folder / f"z{k:02d}.tif", image, extratags=[tag])
    return folder


def _stack(suffix: str, dtype: str = "uint8", **options: Any) -> Any:
    def write(path: Path, scene: Scene) -> Path:
        file = path.with_name(f"{path.name}{suffix}")
        images = np.stack(scene.images).astype(dtype)
        tifffile.imwrite(file, images, photometric="minisblack", **options)
        return file

    return write


def _imagej(dtype: str) -> Any:
    def write(path: Path, scene: Scene) -> Path:
        per_nm = 1e-9 / scene.pixel_m
        said = {"axes": "TYX", "unit": "nm", "finterval": float(INTERVAL_S)}
        options = {"imagej": True, "resolution": (per_nm, per_nm), "metadata": said}
        return Path(_stack(".tif", dtype, **options)(path, scene))

    return write


def _video(path: Path, scene: Scene) -> Path:
    file = path.with_suffix(".mp4")
    with av.open(str(file), "w") as film:
        stream = film.add_stream("h264", rate=1)
        stream.width = stream.height = SIZE
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        for image in scene.images:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray8")))
        film.mux(stream.encode())
    return file


def _bag(path: Path, scene: Scene) -> Path:
    if scene.plan is None:
        folder = _each("png")(path.with_name(f"{path.name}_png"), scene)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert semcal(["import", *scene.pixel_size, str(folder), str(path)]) == 0
    else:
        write_simulated(path, scene.plan.frames, scene.images, {})
    return path


def _text(path: Path, _scene: Scene) -> Path:
    path.with_suffix(".txt").write_text("no image")
    return path.with_suffix(".txt")


def _empty(path: Path, _scene: Scene) -> Path:
    path.mkdir()
    return path


def _damaged(path: Path, scene: Scene) -> Path:
    whole = cv2.imencode(".png", scene.images[0])[1].tobytes()
    path.with_suffix(".png").write_bytes(whole[: len(whole) // 3])
    return path.with_suffix(".png")


def _single(path: Path, scene: Scene) -> Path:
    cv2.imwrite(str(path.with_suffix(".png")), scene.images[0])
    return path.with_suffix(".png")


def _pattern(path: Path, scene: Scene) -> Path:
    return Path(_each("png")(path, scene)) / "f*.png"


#: How each kind is written; None for what says its own pixel size.
KINDS: dict[str, tuple[Callable[[Path, Scene], Path], bool]] = {
    "PNG": (_each("png"), True),
    "JPEG": (_each("jpg"), True),
    "BMP": (_each("bmp"), True),
    "TIFF 8 bit": (_each("tif"), True),
    "TIFF 16 bit": (_each("tif", lambda i: i.astype(np.uint16) * 200), True),
    "TIFF float": (_each("tif", lambda i: i.astype(np.float32) / 255), True),
    "TIFF colour": (_each("tif", lambda i: np.dstack([i] * 3)), True),
    "Zeiss TIFF": (_zeiss, False),
    "ImageJ": (_imagej("uint16"), False),
    "ImageJ 32 bit": (_imagej("float32"), False),
    "OME-TIFF": (_stack(".ome.tif", metadata={"axes": "TYX"}), True),
    "multipage": (_stack(".tif"), True),
    "video": (_video, True),
    "pattern": (_pattern, True),
    "bag": (_bag, False),
    "single PNG": (_single, True),
    "empty folder": (_empty, True),
    "text file": (_text, True),
    "damaged PNG": (_damaged, True),
    "missing": (lambda path, _: path, True),
}

#: Scene, and arguments before and after the recording, of each command.
COMMANDS: dict[str, tuple[str, Callable[[Path], list[object]], Callable[[Path], list[object]]]] = {
    "info": ("gold", lambda _: ["info"], lambda _: []),
    "calibrate": (
        "grid",
        lambda f: ["calibrate", "-o", f / "new.yaml", "--squares", "10um"],
        lambda _: [],
    ),
    "check": ("grid", lambda f: ["check", f / "cal.yaml"], lambda _: []),
    "update": (
        "grid",
        lambda f: ["update", "-o", f / "new.yaml", f / "cal.yaml"],
        lambda _: [],
    ),
    "evaluate": ("grid", lambda f: ["evaluate", f / "cal.yaml"], lambda _: []),
    "drift": ("gold", lambda f: ["drift", "-o", f / "drift.csv"], lambda _: []),
    "rectify -o .tif": (
        "gold",
        lambda f: ["rectify", "--calibration", f / "cal.yaml", "-o", f / "flat.tif"],
        lambda _: [],
    ),
    "rectify -o folder/": (
        "gold",
        lambda f: ["rectify", "--calibration", f / "cal.yaml", "-o", f"{f}/flat/"],
        lambda _: [],
    ),
    "rectify -o bag": (
        "gold",
        lambda f: ["rectify", "--calibration", f / "cal.yaml", "-o", f / "rect"],
        lambda _: [],
    ),
    "stack": ("gold", lambda f: ["stack", "-o", f / "mean.tif"], lambda _: []),
    "measure cantilever": (
        "beam",
        lambda f: [
            *("measure", "cantilever", "--calibration", f / "cal.yaml", "--length", "35um"),
            *("-o", f / "bending.csv"),
        ],
        lambda _: [],
    ),
    "reconstruct (ball)": (
        "gold",
        lambda f: ["reconstruct", "--calibration", f / "cal.yaml", "-o", f / "ball.ply"],
        lambda _: [],
    ),
    "reconstruct --tilts": (
        "relief",
        lambda f: [
            "reconstruct",
            "--tilts",
            f"0deg,{TILT_DEG}deg",
            "--tilt-axis",
            "90deg",
            "-o",
            f / "heights.tif",
        ],
        lambda _: [],
    ),
    "import": ("gold", lambda _: ["import"], lambda f: [f / "imported"]),
    "view": ("gold", lambda _: ["view", "--port", "0"], lambda _: []),
    "play": ("gold", lambda _: ["play", "--rate", "1000"], lambda _: []),
    "doctor": ("gold", lambda _: ["doctor"], lambda _: []),
}
#: They know no pixel size; and they are run in a process of their own, which is interrupted when it is ready.
BAGS_ONLY, PROCESSES = ("play", "doctor"), {"play": "", "view": "open http"}


def run(command: list[str]) -> tuple[str, str]:
    """Run a command here; what it came to, and what it said."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
            status = semcal(command)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        return "TRACEBACK", traceback.format_exc()
    return judge(status, told.getvalue())


def run_apart(command: list[str], ready: str) -> tuple[str, str]:
    """The same in a process, which is interrupted as soon as it says ``ready``."""
    process = subprocess.Popen(
        [sys.executable, "-m", "semcal_ros", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    told = ""
    for line in process.stdout:
        told += line
        if ready and ready in line:
            process.send_signal(signal.SIGINT)
    return judge(process.wait(), told)


def judge(status: int, told: str) -> tuple[str, str]:
    """What an exit status and the words to it amount to."""
    lines = [line for line in told.splitlines() if line.startswith("semcal:")]
    if "Traceback" in told:
        return "TRACEBACK", told
    if status == 0:
        return "ok", told
    if len(lines) == 1:
        return "refused", lines[0]
    # A check that fails has a table and no such line.
    return f"status {status}", told


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--messages", action="store_true", help="print what was said, too")
    parser.add_argument("--only", nargs="*", help="only these commands")
    parser.add_argument("--kinds", nargs="*", help="only these kinds of input")
    given = parser.parse_args()
    kinds = {kind: how for kind, how in KINDS.items() if kind in (given.kinds or KINDS)}
    scenes = make_scenes()
    rows: list[list[object]] = []
    said: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        written = {
            (kind, scene): write(folder / f"{scene}_{kind.replace(' ', '_')}", scenes[scene])
            for kind, (write, _) in kinds.items()
            for scene in scenes
        }
        bag = str(_bag(folder / "grid", scenes["grid"]))
        made = run(["calibrate", bag, "-o", f"{folder}/cal.yaml", "--squares", "10um"])
        assert made[0] == "ok", made[1]
        for command, (scene, before, after) in COMMANDS.items():
            if given.only and command not in given.only:
                continue
            row: list[object] = [command]
            for kind, (_, needs_size) in kinds.items():
                out = folder / f"{len(rows)}_{len(row)}"
                out.mkdir()
                (out / "cal.yaml").write_bytes((folder / "cal.yaml").read_bytes())
                size = scenes[scene].pixel_size if needs_size and command not in BAGS_ONLY else []
                line = [*before(out), *size, written[kind, scene], *after(out)]
                words = [str(word) for word in line]
                ready = PROCESSES.get(command)
                result, text = run(words) if ready is None else run_apart(words, ready)
                row.append(result)
                said.setdefault(text.replace(str(folder), ""), []).append(f"{command}, {kind}")
            rows.append(row)
            print(f"{command}: {', '.join(f'{r}' for r in row[1:])}", flush=True)
    header = ["kind", *(str(row[0]) for row in rows)]
    turned = [[kind, *(row[k] for row in rows)] for k, kind in enumerate(kinds, 1)]
    show("every command with every kind of input", header, turned)
    if given.messages:
        for text, where in said.items():
            print(f"--- {'; '.join(where)}\n{text}")


if __name__ == "__main__":
    main()
