"""``semcal measure``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.cantilever import (
    SHAPES,
    Repeatability,
    Series,
    SeriesSettings,
    frames_of_poses,
    measure_series,
    repeatability,
)
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import (
    config_option,
    configured,
    echo_table,
    magnification_option,
    progress,
    require_folder,
    require_suffix,
)
from semcal_ros.cli.drift_common import frame_time_option
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.recordings import open_recording
from semcal_ros.files.tables import write_csv
from semcal_ros.files.video import VIDEO_CODECS, open_video
from semcal_ros.workflows.follow_drift import (
    GIVE_FRAME_TIME,
    camera_of,
    start_time_s,
    with_frame_time,
)

__all__ = ["command"]

_COLUMNS = (
    "recording",
    "stamp_ns",
    "magnification",
    "pose",
    "deflection_m",
    "sigma_m",
    "deflection_by_length_m",
    "sigma_by_length_m",
    "tip_x_px",
    "tip_y_px",
    "rms_m",
    "edges_used",
    "drift_status",
)
_PLOTS = (".png", ".svg", ".pdf")
_BLACK_WHITE = (0.001, 0.999)


class _PixelType(click.ParamType):
    """Two numbers: column and row."""

    name = "X,Y"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is no pair of pixel coordinates such as 120.5,300", param, ctx)
        if not (np.isfinite(x) and np.isfinite(y)):
            self.fail(f"{value!r} is not finite", param, ctx)
        return x, y


@dataclass
class _Shots:
    """Frames of one magnification in one recording."""

    recording: Path
    magnification: float
    camera: ScanCamera
    images: list[NDArray[Any]] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)


@click.group("measure", context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Measure in nanometres, with uncertainty.

    \b
    Example:
      semcal measure cantilever bending --calibration cal.yaml --length 35e-6 -o bending.csv
    """


@command.command("cantilever")
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--calibration", required=True, type=click.Path(path_type=Path))
@click.option(
    "--length",
    required=True,
    type=click.FloatRange(0.0, min_open=True),
    metavar="M",
    help="Length of the cantilever in m.",
)
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="CSV file.")
@click.option(
    "--plot", type=click.Path(path_type=Path), help="Deflection of each pose: png, svg, pdf."
)
@click.option("--strip", type=click.Path(path_type=Path), help="Annotated frames: png, svg or pdf.")
@click.option("--video", type=click.Path(path_type=Path), help="Annotated frames: .mp4 or .avi.")
@click.option("--fps", type=click.FloatRange(0.1, 240.0), default=4.0, show_default=True)
@click.option(
    "--poses",
    type=click.IntRange(1),
    metavar="N",
    help="Each magnification has N poses with equally many frames, one after the other; "
    "without, each frame is a pose.",
)
@click.option(
    "--shape",
    type=click.Choice(SHAPES),
    default="free",
    show_default=True,
    help="Of the bent beam: second and third order; a beam loaded at its end; second order.",
)
@click.option(
    "--base",
    "bases",
    type=_PixelType(),
    multiple=True,
    help="Base of the cantilever in the first frame, if it is not found by itself; "
    "once, or once for each magnification in the order of the recording.",
)
@click.option("--tip", "tips", type=_PixelType(), multiple=True, help="Its free end, likewise.")
@config_option
@frame_time_option
@magnification_option
def cantilever(
    recordings: tuple[Path, ...],
    calibration: Path,
    length: float,
    output: Path,
    plot: Path | None,
    strip: Path | None,
    video: Path | None,
    fps: float,
    poses: int | None,
    shape: str,
    bases: tuple[tuple[float, float], ...],
    tips: tuple[tuple[float, float], ...],
    config: str,
    frame_time: float | None,
    magnification: float | None,
) -> None:
    """Bending of a cantilever in RECORDINGS: deflection of its free end in each frame.

    The first pose is the reference: there, nothing touches the cantilever. All magnifications may
    be in one recording or each in its own; their k-th poses are compared. Deflections are positive
    to the right as seen from the base.

    \b
    Example:
      semcal measure cantilever bending --calibration cal.yaml --length 35e-6 --poses 11 \\
          --config jsm820 -o bending.csv --plot bending.png --strip frames.png
    """
    _check_outputs(output, plot, strip, video)
    model = Calibration.load(calibration)
    microscope = with_frame_time(configured(config, model), frame_time)
    shots, notes = _read(recordings, model, microscope, magnification)
    ends = _ends(bases, tips, len(shots))
    series = []
    total = 2 * sum(len(s.images) for s in shots)
    with progress(total, "bending") as bar:
        for one, (base, tip) in zip(shots, ends, strict=True):
            settings = SeriesSettings(length, shape, base, tip)
            first = frames_of_poses(len(one.images), poses)[0]
            series.append(
                measure_series(
                    one.images,
                    one.times_s,
                    one.camera,
                    microscope.scan,
                    settings,
                    reference=first,
                    on_frame=lambda: bar.update(1),
                )
            )
    agreed = repeatability(series, poses)
    write_csv(output, _COLUMNS, _rows(shots, series, poses))
    _draw(agreed, shots, series, poses, plot, strip)
    _film(video, shots, series, poses, fps)
    if microscope.scan is None:
        notes.append(f"the configuration has no scan: frames are instants; {GIVE_FRAME_TIME}")
    if not all(s.camera.in_range for s in shots):
        notes.append("frames outside of the calibrated range")
    for note in notes:
        click.echo(f"note: {note}", err=True)
    _report(agreed, series)
    for name, path in (("deflections", output), ("plot", plot), ("strip", strip), ("video", video)):
        if path is not None:
            click.echo(f"{name}: {path}")


# -- input ----------------------------------------------------------------------------------------


def _check_outputs(output: Path, plot: Path | None, strip: Path | None, video: Path | None) -> None:
    wanted = (
        (output, (".csv",), "-o"),
        (plot, _PLOTS, "--plot"),
        (strip, _PLOTS, "--strip"),
        (video, tuple(VIDEO_CODECS), "--video"),
    )
    seen: set[Path] = set()
    for path, suffixes, option in wanted:
        if path is None:
            continue
        require_suffix(path, suffixes, option)
        require_folder(path)
        if path.resolve() in seen:
            raise InvalidValueError(f"{path} for two outputs", expected="a file for each")
        seen.add(path.resolve())


def _read(
    recordings: tuple[Path, ...],
    model: Calibration,
    microscope: MicroscopeConfig,
    magnification: float | None,
) -> tuple[list[_Shots], list[str]]:
    """Frames by recording and magnification, in the order in which these first appear."""
    found: dict[tuple[Path, str], _Shots] = {}
    notes: list[str] = []
    for path in recordings:
        with open_recording(path, microscope, magnification=magnification) as opened:
            for frame in opened.frames():
                key = path, f"{frame.magnification:.6g}"
                camera = camera_of(frame, model, microscope)
                shots = found.setdefault(key, _Shots(path, frame.magnification, camera))
                if shots.images and shots.images[0].shape != frame.image.shape[:2]:
                    raise BagError(
                        f"{path}: frames of {shots.images[0].shape} and {frame.image.shape} px "
                        f"at {key[1]}x",
                        expected="one size for each magnification",
                    )
                first_ns = shots.stamps_ns[0] if shots.stamps_ns else frame.stamp_ns
                shots.images.append(np.array(to_gray(frame.image, frame.encoding)))
                shots.stamps_ns.append(frame.stamp_ns)
                shots.times_s.append(start_time_s(frame, first_ns, microscope))
                if len(shots.times_s) > 1 and shots.times_s[-1] < shots.times_s[-2]:
                    raise BagError(
                        f"{path}: time runs backwards at {key[1]}x",
                        expected="frames in the order of time",
                    )
            notes += [f"{path}: {note}" for note in opened.notes]
    return list(found.values()), notes


def _ends(
    bases: tuple[tuple[float, float], ...], tips: tuple[tuple[float, float], ...], count: int
) -> list[tuple[tuple[float, float] | None, tuple[float, float] | None]]:
    if len(bases) != len(tips) or len(bases) not in (0, 1, count):
        raise click.BadParameter(
            f"--base is given {len(bases)} and --tip {len(tips)} times; give neither, both once, "
            f"or both for each of the {count} magnifications"
        )
    if not bases:
        return [(None, None)] * count
    pairs = list(zip(bases, tips, strict=True))
    return [*pairs] * (count if len(pairs) == 1 else 1)


# -- output ---------------------------------------------------------------------------------------


def _pose_of(frames: int, poses: int | None) -> dict[int, int]:
    """Number of the pose, from 1, of each frame."""
    groups = frames_of_poses(frames, poses)
    return {k: number for number, group in enumerate(groups, 1) for k in group}


def _rows(shots: list[_Shots], series: list[Series], poses: int | None) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for one, measured in zip(shots, series, strict=True):
        pose = _pose_of(len(one.images), poses)
        for k, frame in enumerate(measured.frames):
            rows.append(
                (
                    one.recording.name,
                    one.stamps_ns[k],
                    float(one.magnification),
                    pose[k],
                    float(frame.deflection_m),
                    float(frame.sigma_m),
                    float(frame.by_length_m),
                    float(frame.by_length_sigma_m),
                    *(float(v) for v in frame.tip_px),
                    float(frame.bending.rms_m),
                    int(np.count_nonzero(frame.bending.used)),
                    measured.drift[k].status_text,
                )
            )
    return rows


def _draw(
    agreed: Repeatability,
    shots: list[_Shots],
    series: list[Series],
    poses: int | None,
    plot: Path | None,
    strip: Path | None,
) -> None:
    if plot is None and strip is None:
        return
    # Here, so that those who want no figure do not wait for matplotlib.
    from semcal_ros.report.cantilever_figures import write_poses_figure, write_strip_figure

    if plot is not None:
        write_poses_figure(agreed, plot)
    if strip is not None:
        firsts = [group[0] for group in frames_of_poses(len(series[0].frames), poses)]
        write_strip_figure([s.images for s in shots], series, firsts, strip)


def _film(
    video: Path | None, shots: list[_Shots], series: list[Series], poses: int | None, fps: float
) -> None:
    if video is None:
        return
    shapes = {s.images[0].shape for s in shots}
    if len(shapes) > 1:
        raise BagError(f"{video} of frames of sizes {sorted(shapes)}", expected="one size")
    height, width = next(iter(shapes))
    some = np.concatenate([s.images[0][::4, ::4].ravel() for s in shots])
    low, high = (float(v) for v in np.quantile(some, _BLACK_WHITE))
    frames = sum(len(s.images) for s in shots)
    from semcal_ros.report.cantilever_figures import draw_deflection

    with open_video(video, (width, height), frames, fps, (low, high)) as film:
        assert film is not None
        for one, measured in zip(shots, series, strict=True):
            pose = _pose_of(len(one.images), poses)
            for k, frame in enumerate(measured.frames):
                picture = draw_deflection(one.images[k], frame, (low, high))
                nm, sigma = 1e9 * frame.deflection_m, 1e9 * frame.sigma_m
                film.write(
                    picture, f"{one.magnification:g}x  pose {pose[k]}  {nm:.1f} +- {sigma:.1f} nm"
                )


def _report(agreed: Repeatability, series: list[Series]) -> None:
    for one in series:
        label = f"{one.magnification:g}x"
        for note in one.notes:
            click.echo(f"note: {label}: {note}", err=True)
        rest = one.rest
        if np.isfinite(rest.length_m):
            length, sigma = 1e6 * rest.length_m, 1e6 * rest.length_sigma_m
            click.echo(f"{label}: {length:.4f} +- {sigma:.4f} um long by the calibration")
    headers = ["pose", *(f"{g:g}x nm" for g in agreed.magnifications), "spread nm"]
    rows = []
    for pose in range(agreed.deflection_m.shape[1]):
        cells = [
            f"{1e9 * v:.1f} +- {1e9 * s:.1f}"
            for v, s in zip(agreed.deflection_m[:, pose], agreed.sigma_m[:, pose], strict=True)
        ]
        rows.append([str(pose + 1), *cells, _nm(agreed.spread_m[pose])])
    echo_table(headers, rows)
    if len(series) > 1:
        click.echo(
            f"spread between magnifications (RMS, without pose 1): {_nm(agreed.rms_spread_m)} nm "
            f"calibrated, {_nm(agreed.by_length_rms_spread_m)} nm by the known length; expected "
            f"{_nm(agreed.expected_spread_m)} nm"
        )


def _nm(length_m: float) -> str:
    return f"{1e9 * length_m:.2f}" if np.isfinite(length_m) else "-"
