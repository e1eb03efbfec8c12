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

"""Configurations of the repository load; wrong ones are refused by the name of the key."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from semcal_ros.config.config import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    IMAGE_TYPES,
    ImageConfig,
    MagnificationConfig,
    MicroscopeConfig,
    StageConfig,
    StageSigmas,
    config_names,
    config_schema,
    load_config,
    load_yaml,
    parse_config,
)
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import ConfigError

CONFIGS = Path(__file__).resolve().parents[2] / "msg_configs"

GOOD = """
name: test
display_width_m: 0.2
image: {topic: camera/image, stamp: end, databar_rows: 60}
magnification:
  {topic: /sem/pixel, type: geometry_msgs/msg/Vector3Stamped, field: vector.x, quantity: pixel_size,
   unit: nm, image_width_px: 1024}
scan: {frame_time_s: 0.5, averages: 4, flyback_fraction: 0.25}
squares_m: [1e-6, 25e-6]
squares_sigma: 1e-3
grid_certificate: PTB 4711
stage: {topic: /sem/axes, tilt: T, tilt_axis_deg: 90, sigma: {tilt: 0.01}}
frame_id: sem
follow: [0.5, 0, 1, 1]
"""


def edited(path: str, value: object) -> str:
    """GOOD with the value at a dotted path replaced."""
    values = yaml.safe_load(GOOD)
    holder = values
    *parents, last = path.split(".")
    for parent in parents:
        holder = holder.setdefault(parent, {})
    holder[last] = value
    return yaml.safe_dump(values)


def without(path: str) -> str:
    values = yaml.safe_load(GOOD)
    holder = values
    *parents, last = path.split(".")
    for parent in parents:
        holder = holder[parent]
    del holder[last]
    return yaml.safe_dump(values)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_configurations_of_the_repository_load(path: Path) -> None:
    config = load_config(path)
    assert config == load_config(path.stem)
    assert config.display_width_m == 0.12
    assert not config.image.topic.startswith("/")
    assert not config.magnification.topic.startswith("/")
    assert config.squares_m == (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)


def test_names_of_the_repository_are_found() -> None:
    assert {"generic", "jsm820", "virtual_sem", "pixel_size_nm"} <= set(config_names())


def _declared_keys() -> dict[str, dict[str, Any]]:
    """Dotted keys of the JSON schema, with what it says of each."""
    schema = config_schema()

    def walk(mapping: dict[str, Any], above: str) -> Iterator[tuple[str, dict[str, Any]]]:
        for name, key in mapping["properties"].items():
            yield above + name, {**key, "required": name in mapping.get("required", [])}
            inner = [key, *key.get("anyOf", [])]
            for reference in (part["$ref"] for part in inner if "$ref" in part):
                yield from walk(schema["$defs"][reference.rpartition("/")[2]], f"{above}{name}.")

    return dict(walk(schema, ""))


def test_generic_shows_every_key() -> None:
    text = (CONFIGS / "generic.yaml").read_text(encoding="utf-8")
    for key in _declared_keys():
        assert f"{key.rpartition('.')[2]}:" in text, key


def test_the_manual_lists_the_declared_keys_with_their_defaults_and_units() -> None:
    manual = (CONFIGS.parent / "doc" / "msg_configs.md").read_text(encoding="utf-8")
    rows = [re.split(r"(?<!\\)\|", line) for line in manual.splitlines() if line.startswith("| `")]
    table = {
        row[1].strip(" `"): (row[2].strip(" `"), row[3].strip()) for row in rows if len(row) == 6
    }
    declared = _declared_keys()
    mappings = {key.rpartition(".")[0] for key in declared if "." in key}
    assert set(table) == set(declared) - {"image", "magnification"}
    units = {"m": "m", "s": "s", "px": "px", "rows": "px", "deg": "deg"}
    units |= {"stage.sigma.tilt": "rad", "stage.sigma.rotation": "rad", "stage.sigma.z": "m"}
    for key, (default, unit) in table.items():
        said = declared[key]
        if key not in mappings:
            assert unit == units.get(key, units.get(key.rpartition("_")[2], "")), key
        if said["required"] or key == "magnification.quantity":
            assert default.startswith("required"), key
        elif key in mappings:
            assert default.startswith("none"), key
        elif said.get("default") is None:
            assert default.startswith(("none", "width of the frames", "auto")), key
        else:
            assert load_yaml(default, key) == load_yaml(str(said["default"]) or '""', key), key


def test_generic_states_the_defaults() -> None:
    generic = load_config("generic")
    bare = parse_config(
        "{name: generic, display_width_m: 0.12, magnification: {quantity: magnification}}"
    )
    assert generic == bare
    assert bare.image == ImageConfig()
    assert bare.magnification == MagnificationConfig()
    assert bare.scan is None
    assert bare.stage == StageConfig()
    assert (bare.squares_sigma, bare.grid_certificate) == (0.0, "")


def test_all_keys_are_read() -> None:
    config = parse_config(GOOD)
    assert config.name == "test"
    assert config.display_width_m == 0.2
    assert config.image == ImageConfig("camera/image", "sensor_msgs/msg/Image", "end", 60)
    assert config.magnification == MagnificationConfig(
        quantity="pixel_size",
        topic="/sem/pixel",
        type="geometry_msgs/msg/Vector3Stamped",
        field="vector.x",
        unit="nm",
        image_width_px=1024,
    )
    assert config.scan == ScanTiming(0.5, 4, 0.25)
    assert config.squares_m == (25e-6, 1e-6)
    assert (config.squares_sigma, config.grid_certificate) == (1e-3, "PTB 4711")
    assert config.stage == StageConfig(
        topic="/sem/axes", tilt="T", tilt_axis_deg=90.0, sigma=StageSigmas(tilt=0.01)
    )
    assert config.stage is not None and config.stage.rotation == "rotation"
    assert config.frame_id == "sem"
    assert config.follow == (0.5, 0.0, 1.0, 1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.name = "other"  # type: ignore[misc]


def test_images_may_be_compressed() -> None:
    config = parse_config(edited("image.type", "sensor_msgs/msg/CompressedImage"))
    assert config.image.type == COMPRESSED_IMAGE_TYPE
    assert set(IMAGE_TYPES) == {IMAGE_TYPE, COMPRESSED_IMAGE_TYPE}
    assert ImageConfig().type == IMAGE_TYPE


@pytest.mark.parametrize(
    ("moment", "start_s", "centre_s"),
    [("start", 0.0, 1.0), ("centre", -1.0, 0.0), ("end", -2.0, -1.0)],
)
def test_stamp_moments(moment: str, start_s: float, centre_s: float) -> None:
    config = parse_config(edited("image.stamp", moment))  # 4 passes of 0.5 s take 2 s
    assert config.start_offset_s == start_s
    assert config.centre_offset_s == centre_s


def test_without_scan_a_frame_is_an_instant() -> None:
    config = parse_config(without("scan"))
    assert config.start_offset_s == config.centre_offset_s == 0.0


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("name", ""),
        ("name", 3),
        ("display_width_m", 0),
        ("display_width_m", -0.1),
        ("display_width_m", float("nan")),
        ("display_width_m", float("inf")),
        ("display_width_m", "12 cm"),
        ("display_width_m", True),
        ("display_width_m", 10**400),
        ("image", "image_raw"),
        ("image.topic", "image raw"),
        ("image.topic", "image_raw\n"),
        ("image.topic", "a//b"),
        ("image.topic", 5),
        ("image.type", "sensor_msgs/msg/PointCloud2"),
        ("image.type", "sensor_msgs/CompressedImage"),
        ("image.stamp", "middle"),
        ("image.databar_rows", -1),
        ("image.databar_rows", 1.5),
        ("magnification.type", "Float64"),
        ("magnification.type", "std_msgs/Float64"),
        ("magnification.field", "vector..x"),
        ("magnification.field", "vector.x; import os"),
        ("magnification.field", "a[-1]"),
        ("magnification.quantity", "zoom"),
        ("magnification.unit", "inch"),
        ("magnification.unit", "1"),
        ("magnification.unit", True),
        ("magnification.image_width_px", 0),
        ("magnification.display_width_m", 0.3),
        ("scan.frame_time_s", 0),
        ("scan.frame_time_s", float("nan")),
        ("scan.averages", 0),
        ("scan.line_averages", 0),
        ("scan.recursive_averages", 1.5),
        ("scan.flyback_fraction", 1),
        ("scan.flyback_fraction", float("nan")),
        ("scan.bidirectional", 1),
        ("follow", [0.5, 0.0, 0.5, 1.0]),
        ("squares_m", []),
        ("squares_m", 1e-6),
        ("frame_id", ""),
        ("nmae", "typo"),
        ("image.databar", 3),
        ("magnification.filed", "data"),
        ("squares_sigma", -1e-3),
        ("squares_sigma", 0.5),
        ("squares_sigma", "0.1 %"),
        ("grid_certificate", 4711),
        ("stage", "stage"),
        ("stage.topic", "a stage"),
        ("stage.type", "geometry_msgs/msg/Twist"),
        ("stage.tilt", ""),
        ("stage.tilt", 1),
        ("stage.tilts", "tilt"),
        ("stage.tilt_axis_deg", 400.0),
        ("stage.tilt_axis_deg", float("nan")),
        ("stage.sigma", 0.01),
        ("stage.sigma.tilt", 0.0),
        ("stage.sigma.rotation", 5.0),
        ("stage.sigma.z", float("inf")),
        ("stage.sigma.x", 1e-6),
    ],
)
def test_a_wrong_key_is_named(path: str, value: object) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(edited(path, value), source="mine.yaml")
    line = str(caught.value)
    assert line.startswith("mine.yaml: ")
    assert f"key {path} " in line or f"key {path};" in line
    assert caught.value.expected
    assert "\n" not in line
    assert len(line) < 400


@pytest.mark.parametrize(
    "path",
    [
        "name",
        "image",
        "magnification.unit",
        "magnification.image_width_px",
        "scan",
        "squares_m",
        "stage",
        "stage.tilt",
        "stage.sigma",
        "stage.sigma.z",
    ],
)
def test_a_key_without_a_value_is_named(path: str) -> None:
    with pytest.raises(ConfigError, match=rf"key {path} is None"):
        parse_config(edited(path, None))


def test_a_misspelt_key_is_named_before_the_one_that_is_missing() -> None:
    with pytest.raises(ConfigError, match="unknown key nmae"):
        parse_config(GOOD.replace("name:", "nmae:"))


def test_the_unit_is_not_a_truth_value() -> None:
    text = "{name: a, display_width_m: 1, magnification: {quantity: magnification, unit: true}}"
    with pytest.raises(ConfigError, match=r"key magnification.unit is True"):
        parse_config(text)


@pytest.mark.parametrize("index", [0, 1])
def test_a_wrong_list_element_is_named(index: int) -> None:
    squares: list[object] = [25e-6, 1e-6]
    squares[index] = -1e-6
    with pytest.raises(ConfigError, match=rf"squares_m\[{index}\]"):
        parse_config(edited("squares_m", squares))


@pytest.mark.parametrize(
    "path",
    [
        "name",
        "display_width_m",
        "magnification",
        "magnification.quantity",
        "magnification.unit",
        "scan.frame_time_s",
    ],
)
def test_a_missing_key_is_named(path: str) -> None:
    with pytest.raises(ConfigError, match=rf"key {path} is"):
        parse_config(without(path))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "None"),
        ("- 1", "list|\\[1\\]"),
        ("name: [", "line"),
        ("name: a\nname: b\n", "duplicate key .* in line 2"),
        ("name: !!python/object/apply:os.getcwd []", "line 1"),
        ("{" * 3000, "YAML"),
        ("a: !!float x", "ValueError"),
        ("a: !!map x", "map|YAML"),
        ("? [1]\n: 2", "YAML|hash|unknown"),
        ("name: \x00", "YAML"),
    ],
)
def test_what_is_no_configuration(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        parse_config(text, source="mine.yaml")
    assert "\n" not in str(caught.value)


def test_numbers_with_exponent_but_no_point() -> None:
    # YAML 1.1 calls 12e-2 a string; people write it all the same.
    assert parse_config(GOOD.replace("0.2", "12e-2")).display_width_m == 0.12


@pytest.mark.parametrize("unit", ["1", "'1'", "1.0"])
def test_unit_one_in_any_spelling(unit: str) -> None:
    text = (
        f"{{name: a, display_width_m: 1, magnification: {{quantity: magnification, unit: {unit}}}}}"
    )
    assert parse_config(text).magnification.unit == "1"


@pytest.mark.parametrize(
    "name", ["", "nonexistent", "../generic", "a" * 5000, "~nobody_here/x", "\0"]
)
def test_unknown_configurations_list_the_known_ones(name: str) -> None:
    with pytest.raises(ConfigError, match=r"generic.*jsm820"):
        load_config(name)


def test_unreadable_files(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_config(binary)
    huge = tmp_path / "huge.yaml"
    huge.write_bytes(b"#" * (1024 * 1024 + 1))
    with pytest.raises(ConfigError, match="bytes"):
        load_config(huge)


def test_ament_prefix_and_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share = tmp_path / "prefix" / "share" / "semcal_ros" / "msg_configs"
    share.mkdir(parents=True)
    (share / "from_share.yaml").write_text(GOOD, encoding="utf-8")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "prefix"))
    assert load_config("from_share").name == "test"
    assert load_config("from_share.yaml").name == "test"
    assert "from_share" in config_names()
    # A file in the working directory comes before a shipped one of the same name.
    (tmp_path / "generic.yaml").write_text(GOOD, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_config("generic.yaml").name == "test"
    assert load_config("generic").name == "generic"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"display_width_m": -1}, "display_width_m is -1; expected a display width in m"),
        ({"name": ""}, "name is ''"),
        ({"squares_m": ()}, "squares_m is"),
        ({"scan": {"frame_time_s": 0.0}}, "scan.frame_time_s is 0.0"),
        ({"image": {"topic": ""}}, "image.topic is ''"),
        ({"widht": 1}, "unknown key widht"),
        ({"stage": {"sigma": {"z": -1.0}}}, "stage.sigma.z is -1.0; expected a length in m"),
    ],
)
def test_constructors_refuse_like_files(arguments, reason):
    with pytest.raises(ConfigError, match=f"MicroscopeConfig: .*{reason}"):
        dataclasses.replace(load_config("generic"), **arguments)
    with pytest.raises(ConfigError, match=f"MicroscopeConfig: .*{reason}"):
        MicroscopeConfig(**{"name": "a", "display_width_m": 0.1, **arguments})


def test_arguments_given_by_place_are_named():
    with pytest.raises(ConfigError, match="MicroscopeConfig: key display_width_m is 0"):
        MicroscopeConfig("a", 0)
    with pytest.raises(ConfigError, match="ImageConfig: key databar_rows is -1"):
        ImageConfig(databar_rows=-1)


@pytest.mark.parametrize("value", [[0.5, 0.0, 1.0], [0, 0, 512, 512]])
def test_a_part_to_follow_is_in_parts_of_the_picture(value: list[float]) -> None:
    with pytest.raises(ConfigError, match=r"mine.yaml: key follow\[.\] is .* from 0 to 1"):
        parse_config(edited("follow", value), source="mine.yaml")
