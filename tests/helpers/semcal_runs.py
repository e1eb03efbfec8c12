"""Running the command line in this process."""

from __future__ import annotations

import pytest

from semcal_ros.cli import main

__all__ = ["refused", "run"]


def run(*arguments: object) -> int:
    """Exit status of ``semcal`` with these arguments."""
    return main([str(a) for a in arguments])


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line that a refused command prints."""
    capsys.readouterr()
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, lines
    assert captured.out == ""
    return lines[0]
