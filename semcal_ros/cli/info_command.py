"""``semcal info``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import config_option, recording_argument
from semcal_ros.cli.output import echo_notes, echo_table, show_progress
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.workflows.inputs import count_frames, open_source, resolve_config

__all__ = ["command"]


@click.command("info")
@recording_argument
@config_option
def command(recording: Path, config: str) -> None:
    """What RECORDING contains: topics, frames, sizes, magnifications.

    \b
    Example:
      semcal info recordings/grid
    """
    with open_source(recording, resolve_config(config)) as opened:
        frames: list[tuple[float, int, str]] = []
        with show_progress() as on_progress:
            advance = count_frames(on_progress, "reading", opened.frame_count)
            for frame in opened.frames():
                frames.append((frame.magnification, frame.stamp_ns, _format(frame)))
                advance(1)
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
    echo_notes(notes)


def _format(frame: RecordedFrame) -> str:
    return f"{frame.image.shape[1]} x {frame.image.shape[0]} {frame.encoding}"
