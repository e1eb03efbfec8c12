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

"""RECORDING and the options that say how to read it, as all commands have them; and outputs that spare it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click

from semcal_ros.cli.options import DURATION, LENGTH, PATH, config_option, require_folder
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.bags.reader import is_bag
from semcal_ros.files.images.image_file import is_image_file
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.inputs import resolve_config

Command = TypeVar("Command", bound=Callable[..., Any])
Output = tuple[str, Path | None, Sequence[str]]


class _Region(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # likewise
    """Part of an image: ``X,Y,WIDTH,HEIGHT`` in px."""

    name = "region"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            x, y, width, height = (int(part) for part in str(value).split(","))
        except ValueError:
            self.fail(
                f"{value!r} is not a region such as 100,50,800,600 (x, y, width, height)",
                param,
                ctx,
            )
        return x, y, width, height


class PixelSizeAt(NamedTuple):
    """A pixel size that is known at one magnification."""

    size_m: float
    magnification: float


class _PixelSize(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # likewise
    """A length, or one at a magnification: ``23.1nm@5000``."""

    name = "length"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | PixelSizeAt:
        text, at, magnification = str(value).partition("@")
        size = LENGTH.convert(text, param, ctx)
        if not at:
            return float(size)
        try:
            g = float(magnification.strip().removesuffix("x"))
        except ValueError:
            self.fail(f"{value!r} is not a pixel size such as 23.1nm or 23.1nm@5000", param, ctx)
        return PixelSizeAt(float(size), g)


#: Where a command that takes a :class:`PixelSizeAt` finds it in the context of click.
PIXEL_SIZE_AT = "semcal.pixel_size_at"

# What recordings do not say about themselves, described once for all commands.
_READING_OPTIONS = (
    config_option,
    click.option(
        "--pixel-size",
        type=_PixelSize(),
        metavar="LENGTH",
        help="Pixel size of all images, such as 43.9nm, instead of what files say.",
    ),
    click.option(
        "--magnification",
        type=float,
        metavar="G",
        help="Magnification of all images, where the files do not contain it.",
    ),
    click.option(
        "--display-width",
        type=LENGTH,
        metavar="LENGTH",
        help="Display width that magnifications refer to, such as 127mm, instead of that of the configuration.",
    ),
    click.option(
        "--frame-interval",
        type=DURATION,
        metavar="TIME",
        help="Time from one image to the next, such as 533ms, instead of what files say.",
    ),
    click.option(
        "--frame-time",
        type=DURATION,
        metavar="TIME",
        help="Time of one pass over a frame, such as 500ms, instead of what the configuration says.",
    ),
    click.option(
        "--databar-rows",
        type=click.IntRange(0),
        metavar="N",
        help="Rows at the bottom with the microscope's text, instead of what files say.",
    ),
    click.option(
        "--roi",
        type=_Region(),
        metavar="X,Y,W,H",
        help="Part of each image that is used, px.",
    ),
    click.option(
        "--mask",
        type=PATH,
        metavar="FILE",
        help="Image of the images' size, black where they do not show the specimen: nothing is measured there.",
    ),
)


def recording_input(command: Command) -> Command:
    """RECORDING and the options that say how to read it.

    The command is called with ``recording``, a :class:`.RecordedFiles`, and ``config``, the configuration with what
    the options change in it.
    """
    return _reading(command, several=False)


def recordings_input(command: Command) -> Command:
    """As :func:`recording_input`, for several: the command is called with ``recordings``, a list."""
    return _reading(command, several=True)


def optional_recording_input(command: Command) -> Command:
    """As :func:`recording_input`, where ``recording`` is None if none is given."""
    return _reading(command, several=False, required=False)


def _reading(command: Command, *, several: bool, required: bool = True) -> Command:
    @wraps(command)
    def read(
        paths: tuple[Path, ...],
        config: str,
        pixel_size: float | PixelSizeAt | None,
        magnification: float | None,
        display_width: float | None,
        frame_interval: float | None,
        frame_time: float | None,
        databar_rows: int | None,
        roi: tuple[int, int, int, int] | None,
        mask: Path | None,
        **others: Any,
    ) -> Any:
        microscope = resolve_config(config, frame_time_s=frame_time)
        if isinstance(pixel_size, PixelSizeAt):
            context = click.get_current_context()
            if not context.params.get("specimen"):
                raise InvalidValueError(
                    "a --pixel-size at one magnification",
                    expected="that of all images",
                    do="leave out @ and the magnification; only calibrate --specimen takes them",
                )
            context.meta[PIXEL_SIZE_AT] = pixel_size
            pixel_size = None
        stated: tuple[object, ...] = (pixel_size, magnification, display_width, frame_interval)
        stated += (frame_time, databar_rows, roi, mask)
        if not paths and any(value is not None for value in stated):
            raise InvalidValueError(
                "options that say how to read a recording", expected="a RECORDING with them"
            )
        given = [
            RecordedFiles(
                part[0] if len(part) == 1 else part,
                pixel_size,
                magnification,
                frame_interval,
                databar_rows,
                roi,
                display_width,
                mask,
            )
            for part in (_split(paths) if several else [paths] * bool(paths))
        ]
        if display_width is not None:
            calibration = click.get_current_context().params.get("calibration")
            if calibration is not None and any(is_bag(path) for path in paths):
                raise InvalidValueError(
                    "--display-width beside a calibration, for a bag",
                    expected="one of them: the magnifications of a bag are those of the calibration",
                    do="leave it out",
                )
            microscope = replace(microscope, display_width_m=display_width)
        recordings = (
            {"recordings": given} if several else {"recording": given[0] if given else None}
        )
        return command(config=microscope, **recordings, **others)

    name = "RECORDINGS..." if several else "RECORDING" if required else "[RECORDING]"
    decorated: Any = read
    for option in reversed(_READING_OPTIONS):
        decorated = option(decorated)
    return click.argument("paths", nargs=-1, required=required, type=PATH, metavar=name)(decorated)


def _split(paths: tuple[Path, ...]) -> list[tuple[Path, ...]]:
    """Several image files, as a shell lists those of a pattern, are one recording; anything else each its own."""
    if all(path.is_file() and is_image_file(path) for path in paths):
        return [paths]
    return [(path,) for path in paths]


def refuse_mask(recording: RecordedFiles, instead: str) -> None:
    """Refuse ``--mask`` for a command that measures nothing in the images.

    Raises
    ------
    InvalidValueError
        A mask was given.
    """
    if recording.mask is not None:
        raise InvalidValueError(
            "--mask for a command that measures nothing in the images", expected=instead
        )


def check_outputs(outputs: Sequence[Output], *, recording: RecordedFiles | None = None) -> None:
    """Refuse outputs that cannot be written, before any work is done for them.

    Parameters
    ----------
    outputs
        (option, path or None, suffixes that its kind of file may have; none for any).
    recording
        Recording that must not be written to.

    Raises
    ------
    InvalidValueError
        A suffix is not accepted, a folder does not exist, two outputs are one file, or an output
        belongs to the recording.
    """
    taken: set[Path] = set()
    for option, path, suffixes in outputs:
        if path is None:
            continue
        if suffixes and path.suffix.lower() not in suffixes:
            raise InvalidValueError(
                f"{option} {path}",
                expected="a name that ends in " + ", ".join(suffixes),
                do="choose one of these suffixes",
            )
        require_folder(path)
        target = path.resolve()
        if target in taken:
            raise InvalidValueError(
                f"{option} {path} is also another output", expected="a file of its own"
            )
        if recording is not None:
            check_spared(option, path, recording)
        taken.add(target)


def check_spared(option: str, path: Path, recording: RecordedFiles) -> None:
    """Refuse an output that would change the recording.

    Raises
    ------
    InvalidValueError
        The output belongs to the recording.
    """
    # Not Path.resolve, which raises RuntimeError where a link leads to itself.
    target = Path(os.path.realpath(path))
    if any(_belongs(target, Path(os.path.realpath(source))) for source in recording.paths):
        raise InvalidValueError(
            f"{option} {path} belongs to the recording", expected="a file or folder outside it"
        )


def _belongs(target: Path, source: Path) -> bool:
    """Whether writing ``target`` would change a recording: itself, a file of a bag, or an image of a folder."""
    if source not in target.parents:
        return target == source
    return is_bag(source) or target.exists()
