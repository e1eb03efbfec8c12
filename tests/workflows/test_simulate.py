"""Recordings of the virtual SEM."""

from __future__ import annotations

import pytest

from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.synthetic import preset
from semcal_ros.workflows.describe_recording import describe_recording
from semcal_ros.workflows.simulate import plan_recording, simulate

SCOPE = preset("ideal").with_image_size(64, 64)


def test_a_simulated_recording_contains_what_was_asked_for(tmp_path):
    seen = []
    count = simulate(
        tmp_path / "zoom",
        "zoom",
        microscope="ideal",
        magnifications=(500.0, 2000.0),
        frames=3,
        size=64,
        bits=16,
        on_progress=lambda *a: seen.append(a),
    )
    assert count == 3
    assert seen[0] == ("simulating", 0, 3) and seen[-1] == ("simulating", 3, 3)
    found = describe_recording(tmp_path / "zoom")
    assert found.frame_count == 3
    assert found.kinds == {"64 x 64 mono16": 3}
    assert found.magnifications == pytest.approx((500.0, 1000.0, 2000.0))
    assert {topic.name for topic in found.topics} == {"/sem/image_raw", "/sem/magnification"}
    with pytest.raises(BagError, match="exists"):
        simulate(tmp_path / "zoom", "zoom", frames=2, size=64)


@pytest.mark.parametrize(
    ("kind", "frames"), [("grid", 2 * 21), ("drift", 48), ("steps", 3 * 12), ("zoom", 36)]
)
def test_every_plan_has_its_defaults(kind, frames):
    assert len(plan_recording(kind, SCOPE, views=2)) == frames


@pytest.mark.parametrize(
    ("kind", "arguments", "reason"),
    [
        ("film", {}, "one of grid, drift"),
        ("drift", {"magnifications": (1.0, 2.0)}, "plan drift with magnifications 1, 2"),
        ("zoom", {"magnifications": (1.0,)}, "expected 2 of them, or none"),
        ("steps", {"magnifications": (-1.0,)}, "magnifications: -1"),
        ("steps", {"specimen": "cat"}, "specimen 'cat'"),
        ("zoom", {"drift": "no"}, "drift preset 'no'"),
    ],
)
def test_plans_that_cannot_be_made_are_refused(kind, arguments, reason):
    with pytest.raises(InvalidValueError, match=reason):
        plan_recording(kind, SCOPE, **arguments)
