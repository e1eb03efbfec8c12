"""``semcal info``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.common import config_option, configured, echo_table, progress
from semcal_ros.files.recordings import RecordedFrame, open_recording

__all__ = ["command"]


@click.command("info")
@click.argument("recording", type=click.Path(path_type=Path))
@config_option
def command(recording: Path, config: str) -> None:
    """What RECORDING contains: topics, frames, sizes, magnifications.

    \b
    Example:
      semcal info recordings/grid
    """
    with open_recording(recording, configured(config)) as opened:
        frames: list[tuple[float, int, str]] = []
        with progress(opened.frame_count, "reading") as bar:
            for frame in opened.frames():
                frames.append((frame.magnification, frame.stamp_ns, _format(frame)))
                bar.update(1)
        if opened.topics:
            echo_table(
                ["topic", "type", "messages"],
                [[t.name, t.type, str(t.count)] for t in opened.topics],
            )
        notes = opened.notes
    magnifications = sorted({g for g, _, _ in frames})
    stamps = [stamp for _, stamp, _ in frames]
    click.echo(f"{len(frames)} frames over {(max(stamps) - min(stamps)) * 1e-9:.3f} s")
    for kind in sorted({k for _, _, k in frames}):
        click.echo(f"  {sum(k == kind for _, _, k in frames)} x {kind}")
    click.echo(
        f"{len(magnifications)} magnifications, {magnifications[0]:g} to {magnifications[-1]:g}"
    )
    for note in notes:
        click.echo(f"note: {note}", err=True)


def _format(frame: RecordedFrame) -> str:
    return f"{frame.image.shape[1]} x {frame.image.shape[0]} {frame.encoding}"
