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

"""What the launch files start. `launch` is not on PyPI: the few classes they use are stood in for here."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
from ament_index_python import get_package_prefix

from semcal_ros.config.config import load_yaml

ROOT = Path(__file__).resolve().parents[2]
SUITE = ROOT / "launch" / "semcal_launch.py"
REPLAY = ROOT / "launch" / "replay_launch.py"
PROFILE = str(ROOT / "dds" / "fastdds_large_images.xml")
FILES = ("recording", "2024", "2025")
BAG = {"bag": "recording"}


# -- stand-ins: as strict as the originals where a launch file could get it wrong --------------------


class LaunchConfiguration:
    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: Context) -> str:
        return context.launch_configurations[self.name]


class IfCondition:
    def __init__(self, value: LaunchConfiguration) -> None:
        self.value = value

    def evaluate(self, context: Context) -> bool:
        return _as_bool(self.value.perform(context))


class ParameterValue:
    def __init__(self, value: Any, *, value_type: type) -> None:
        assert isinstance(value, value_type)
        self.value = value


@dataclass
class ShutdownProcess:
    process_matcher: Callable[[Any], bool]

    def __init__(self, *, process_matcher: Callable[[Any], bool]) -> None:
        self.process_matcher = process_matcher


def matches_action(action: Action) -> Callable[[Any], bool]:
    return lambda other: other is action


@dataclass
class Action:
    """Any action: its arguments are kept for :func:`_visit`."""

    given: tuple[Any, ...]
    options: dict[str, Any]

    def __init__(self, *given: Any, **options: Any) -> None:
        self.given, self.options = given, options

    def __hash__(self) -> int:
        return id(self)

    @property
    def node_executable(self) -> str:
        return self.options["executable"]


ACTIONS = {
    name: type(name, (Action,), {})
    for name in (
        "DeclareLaunchArgument",
        "EmitEvent",
        "LaunchDescription",
        "Node",
        "OnProcessExit",
        "OnProcessIO",
        "OnShutdown",
        "OpaqueFunction",
        "RegisterEventHandler",
        "SetEnvironmentVariable",
        "SetLaunchConfiguration",
        "Shutdown",
        "TimerAction",
    )
}
WARNINGS: list[str] = []


def get_logger(name: str) -> Any:
    assert name == "semcal_ros"
    return SimpleNamespace(warning=WARNINGS.append)


def load_python_launch_file_as_module(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location("launch_file_under_test", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


STAND_INS = {
    "launch": ("LaunchDescription",),
    "launch.actions": (
        "DeclareLaunchArgument",
        "EmitEvent",
        "OpaqueFunction",
        "RegisterEventHandler",
        "SetEnvironmentVariable",
        "SetLaunchConfiguration",
        "Shutdown",
        "TimerAction",
    ),
    "launch.conditions": (IfCondition,),
    "launch.event_handlers": ("OnProcessExit", "OnProcessIO", "OnShutdown"),
    "launch.events": (matches_action,),
    "launch.events.process": (ShutdownProcess,),
    "launch.launch_description_sources": (load_python_launch_file_as_module,),
    "launch.logging": (get_logger,),
    "launch.substitutions": (LaunchConfiguration,),
    "launch_ros": (),
    "launch_ros.actions": ("Node",),
    "launch_ros.parameter_descriptions": (ParameterValue,),
}


@dataclass
class Started:
    """One node as it would be started."""

    package: str
    executable: str
    name: str
    namespace: str
    fallback: dict[str, Any]
    files: list[str]
    parameters: dict[str, Any]
    ros_arguments: list[str]
    environment: dict[str, str]
    respawn: bool
    respawn_delay: float | None
    action: Action


@dataclass
class Context:
    """State of a launch, and what came of it."""

    launch_configurations: dict[str, str]
    environment: dict[str, str]
    nodes: list[Started] = field(default_factory=list)
    handlers: list[Action] = field(default_factory=list)
    is_shutdown: bool = False
    arguments: dict[str, Action] = field(default_factory=dict)

    def node(self, executable: str) -> Started:
        return next(node for node in self.nodes if node.executable == executable)


def _as_bool(text: str) -> bool:
    return {"true": True, "1": True, "false": False, "0": False}[text.lower()]


def _declare(action: Action, context: Context) -> None:
    (name,) = action.given
    context.arguments[name] = action
    default, choices = action.options.get("default_value"), action.options.get("choices")
    if name not in context.launch_configurations:
        if default is None:
            raise LookupError(f"argument {name} is required")
        context.launch_configurations[name] = default
    if choices is not None and context.launch_configurations[name] not in choices:
        raise ValueError(f"{name} is none of {choices}")


def _start(action: Action, context: Context) -> None:
    options = dict(action.options)
    assert options.pop("output") == "screen"
    options.pop("condition", None)
    # As the defaults of the original.
    options.setdefault("respawn", False)
    options.setdefault("respawn_delay", None)
    items = options.pop("parameters")
    files = [item for item in items if isinstance(item, str)]
    values = [
        item if isinstance(item, str) else {name: value.value for name, value in item.items()}
        for item in items
    ]
    # What comes later wins: a file must not win over an argument.
    *fallback, parameters = [value for value in values if isinstance(value, dict)]
    assert values == [*fallback, *files, parameters]
    started = Started(
        **options,
        fallback=fallback[0] if fallback else {},
        files=files,
        parameters=parameters,
        environment=dict(context.environment),
        action=action,
    )
    context.nodes.append(started)


def _visit(action: Action, context: Context) -> None:
    condition = action.options.get("condition")
    if condition is not None and not condition.evaluate(context):
        return
    kind = type(action).__name__
    if kind == "LaunchDescription":
        for child in action.given[0]:
            _visit(child, context)
    elif kind == "DeclareLaunchArgument":
        _declare(action, context)
    elif kind == "OpaqueFunction":
        for child in action.options["function"](context, *action.options.get("args", ())) or ():
            _visit(child, context)
    elif kind == "SetLaunchConfiguration":
        name, value = action.given
        context.launch_configurations[name] = value
    elif kind == "SetEnvironmentVariable":
        name, value = action.given
        context.environment[name] = value
    elif kind == "RegisterEventHandler":
        context.handlers.append(action.given[0])
    elif kind == "Node":
        _start(action, context)
    else:
        raise AssertionError(f"no stand-in for {kind}")


Run = Callable[..., Context]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Launch a file with arguments, in an environment and a folder with some files."""
    monkeypatch.chdir(tmp_path)
    for file in FILES:
        Path(file).touch()
    WARNINGS.clear()
    for name, members in STAND_INS.items():
        module = ModuleType(name)
        for member in members:
            value = ACTIONS[member] if isinstance(member, str) else member
            setattr(module, value.__name__, value)
        monkeypatch.setitem(sys.modules, name, module)

    def launch(
        path: Path,
        arguments: dict[str, str] | None = None,
        environment: Any = (),
        context: Context | None = None,
    ) -> Context:
        context = context or Context({}, {})
        context.launch_configurations.update(arguments or {})
        context.environment.update(environment)
        _visit(load_python_launch_file_as_module(str(path)).generate_launch_description(), context)
        return context

    return launch


# -- what the nodes accept ---------------------------------------------------------------------------


class _Declared(Exception):
    """Ends the construction of a node once its parameters are known."""


def _settings(executable: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The parameters that a node declares, by name; the node itself is not started."""
    from semcal_ros.nodes.common import base
    from semcal_ros.nodes.common.parameters import DIRECTORY

    found: dict[str, Any] = {}

    def record(_node: Any, declarations: Any) -> None:
        found.update({declaration.name: declaration for declaration in declarations})
        if any(declaration.confined for declaration in found.values()):
            found.setdefault(DIRECTORY.name, DIRECTORY)
        raise _Declared

    module = importlib.import_module(f"semcal_ros.nodes.{executable}")
    with monkeypatch.context() as patch:
        patch.setattr(base.Node, "__init__", lambda *_args, **_options: None)
        patch.setattr(base, "Parameters", record)
        runner = "run_parts" if executable == "suite" else "run_node"
        patch.setattr(module, runner, lambda factory, _args=None, threads=1: factory())
        with pytest.raises(_Declared):
            module.main([])
    return found


IN_SUITE = (
    "suite",
    "stream_corrector",
    "parameter_server",
    "microscope",
    "bag_player",
)
EVERYTHING = {
    "namespace": "/lab/sem",
    "config": "jsm820",
    "calibration": "2024",
    "calibration_server": "true",
    "output": "live.yaml",
    "directory": ".",
    "use_sim_time": "true",
    "log_level": "debug",
    "on_mismatch": "refuse",
    "monitor_period": "60",
    "viewer": "false",
    "consumers": "bead",
}
DRIVER = {"source": "folder", "folder": "."}
REPLAY_EVERYTHING = {
    **EVERYTHING,
    "bag": "2025",
    "topics": "all",
    "exclude": "calibration",
    "rate": "5",
    "loop": "true",
    "clock": "true",
    "start_paused": "true",
    "wait_for_subscribers": "3",
}
CASES = [
    (path, mode, arguments)
    for (path, few, many), mode in itertools.product(
        [(SUITE, {}, EVERYTHING), (REPLAY, BAG, REPLAY_EVERYTHING)],
        ["combined", "separate", "one_process"],
    )
    for arguments in (few, many)
]


@pytest.mark.parametrize(("path", "mode", "arguments"), CASES)
def test_every_executable_and_parameter_exists(
    run: Run, path: Path, mode: str, arguments: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    context = run(path, {**arguments, "mode": mode})
    folder = Path(get_package_prefix("semcal_ros")) / "lib" / "semcal_ros"
    assert context.nodes
    for node in context.nodes:
        assert node.package == "semcal_ros"
        assert node.name == (None if node.executable == "suite" else node.executable)
        assert (folder / node.executable).is_file()
        settings = {}
        for part in IN_SUITE if node.executable == "suite" else (node.executable,):
            # As in the process: the source that the suite is given names no source of the microscope.
            settings |= {k: v for k, v in _settings(part, monkeypatch).items() if k not in settings}
        for name, value in node.parameters.items():
            if name == "use_sim_time":  # every ROS node has it
                assert value is True
                continue
            # Refuses a wrong type and a value out of range.
            assert settings[name].convert(value) == value


# -- the suite -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ({}, ["parameter_server", "stream_corrector"]),
        ({"mode": "separate"}, ["parameter_server", "drift_compensator", "rectifier"]),
        (
            {"calibration_server": "true"},
            ["parameter_server", "stream_corrector", "calibration_server"],
        ),
        ({"mode": "one_process"}, ["suite"]),
        (
            {"mode": "one_process", "calibration_server": "true"},
            ["suite", "calibration_server"],
        ),
    ],
)
def test_the_suite_starts(run: Run, arguments: dict[str, str], wanted: list[str]) -> None:
    context = run(SUITE, arguments)
    assert [node.executable for node in context.nodes] == wanted
    assert {node.namespace for node in context.nodes} == {"sem"}


def test_the_rectifier_takes_what_the_compensator_makes(run: Run) -> None:
    assert run(SUITE, {"mode": "separate"}).node("rectifier").parameters == {"input": "stabilized"}


@pytest.mark.parametrize(
    ("path", "arguments", "source"),
    [(SUITE, {}, None), (SUITE, DRIVER, "folder"), (REPLAY, BAG, "bag")],
)
def test_one_process_has_the_source_too(
    run: Run, path: Path, arguments: dict[str, str], source: str | None
) -> None:
    (node,) = run(path, {**arguments, "mode": "one_process", "viewer": "false"}).nodes
    assert node.parameters["viewer"] is False
    assert node.parameters.get("source") == source
    assert node.parameters.get("folder") == arguments.get("folder")
    assert node.parameters.get("bag") == arguments.get("bag")
    # It must not play a recording again.
    assert node.respawn is (path == SUITE)


def test_arguments_reach_every_node(run: Run) -> None:
    for mode in ("combined", "separate", "one_process"):
        context = run(SUITE, {**EVERYTHING, "mode": mode})
        for node in context.nodes:
            assert node.namespace == "/lab/sem"
            assert node.ros_arguments == ["--log-level", "debug"]
            assert node.parameters["config"] == "jsm820"
            assert node.parameters["use_sim_time"] is True
            has_calibration = node.executable != "drift_compensator"
            # A file whose name is a number is a name all the same.
            assert node.parameters.get("calibration") == ("2024" if has_calibration else None)


@pytest.mark.parametrize(("path", "arguments"), [(SUITE, {}), (REPLAY, BAG)])
def test_what_guards_a_calibration_reaches_the_nodes_that_do_it(
    run: Run, path: Path, arguments: dict[str, str]
) -> None:
    guards = {"on_mismatch": "refuse", "monitor_period": "60"}
    for mode, corrector in (("combined", "stream_corrector"), ("separate", "rectifier")):
        context = run(path, {**arguments, **guards, "mode": mode})
        assert context.node("parameter_server").parameters == {"monitor_period": 60.0}
        assert context.node(corrector).parameters["on_mismatch"] == "refuse"
        # Left at the default, they leave the choice to params_file.
        context = run(path, {**arguments, "mode": mode})
        assert context.node("parameter_server").parameters == {}
        assert "on_mismatch" not in context.node(corrector).parameters


def test_a_home_folder_is_found(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    file = tmp_path / "more.yaml"
    for name in ("more.yaml", "cal.yaml"):
        (tmp_path / name).touch()
    given = {"calibration": "~/cal.yaml", "bag": "~/recording", "params_file": "~/more.yaml"}
    context = run(REPLAY, given)
    corrector, player = context.node("stream_corrector"), context.node("bag_player")
    assert corrector.parameters["calibration"] == str(tmp_path / "cal.yaml")
    assert player.parameters["bag"] == str(tmp_path / "recording")
    assert corrector.files == player.files == [str(file)]


WRONG = [
    (SUITE, "namespace", "my-lab"),
    (SUITE, "config", "jsm"),
    (SUITE, "config", "missing.yaml"),
    (SUITE, "calibration", "missing.yaml"),
    (SUITE, "monitor_period", "often"),
    (SUITE, "monitor_period", "-1"),
    (SUITE, "monitor_period", "nan"),
    (SUITE, "calibration_server", "ja"),
    (SUITE, "output", "missing/live.yaml"),
    (SUITE, "output", "."),
    (SUITE, "directory", "missing"),
    (SUITE, "params_file", "missing.yaml"),
    (SUITE, "folder", "missing"),
    (SUITE, "use_sim_time", "ja"),
    (SUITE, "viewer", "ja"),
    (SUITE, "respawn", "ja"),
    (SUITE, "large_images", "ja"),
    (REPLAY, "params_file", "missing.yaml"),
    (REPLAY, "bag", "missing"),
    (REPLAY, "rate", "fast"),
    (REPLAY, "rate", "0"),
    (REPLAY, "rate", "nan"),
    (REPLAY, "loop", "ja"),
    (REPLAY, "clock", "ja"),
    (REPLAY, "start_paused", "ja"),
    (REPLAY, "wait_for_subscribers", "1.5"),
    (REPLAY, "wait_for_subscribers", "-1"),
]


@pytest.mark.parametrize(("path", "name", "value"), WRONG)
def test_a_wrong_argument_is_refused_by_name_before_the_first_node(
    run: Run, path: Path, name: str, value: str
) -> None:
    """launch would leave the nodes running that have been started before."""
    context = Context({}, {})
    with pytest.raises(RuntimeError, match=f"^argument {name}:={value}: "):
        run(path, {**(BAG if path == REPLAY else {}), name: value}, context=context)
    assert context.nodes == []


@pytest.mark.parametrize("path", [SUITE, REPLAY])
def test_every_argument_is_checked(run: Run, path: Path) -> None:
    """Those without a choice must be in the list above, but for names of topics, which anything may be."""
    arguments = run(path, BAG if path == REPLAY else {}).arguments
    free = {name for name, action in arguments.items() if action.options["choices"] is None}
    assert free - {name for _, name, _ in WRONG} == (
        {"topics", "exclude", "consumers"} & set(arguments)
    )


@pytest.mark.parametrize(
    ("name", "value"), [("mode", "both"), ("log_level", "loud"), ("on_mismatch", "stop")]
)
def test_a_wrong_choice_is_refused(run: Run, name: str, value: str) -> None:
    with pytest.raises(ValueError, match=name):
        run(SUITE, {name: value})


@pytest.mark.parametrize("path", [SUITE, REPLAY])
@pytest.mark.parametrize(
    ("name", "meant"),
    [("calibraton", "calibration"), ("param_file", "params_file"), ("log-level", "log_level")],
)
def test_a_misspelt_argument_is_told(run: Run, path: Path, name: str, meant: str) -> None:
    run(path, {**(BAG if path == REPLAY else {}), name: "x"})
    (warning,) = WARNINGS
    assert name in warning
    assert f"{meant}:=x" in warning


def test_arguments_of_a_launch_file_that_includes_this_one_are_no_mistakes(run: Run) -> None:
    run(SUITE, {"rviz": "true", "name": "x", "camera": "y", "ros_namespace": "/lab"})
    # The one that is nearly meant is given.
    run(SUITE, {"calibration": "2024", "calibration_2": "x"})
    assert WARNINGS == []


def test_a_driver_is_started_with_its_source(run: Run) -> None:
    assert "microscope" not in [node.executable for node in run(SUITE).nodes]
    (driver,) = (
        n for n in run(SUITE, {**DRIVER, "config": "jsm820"}).nodes if n.name == "microscope"
    )
    assert driver.executable == "microscope"
    assert driver.parameters == {"config": "jsm820", **DRIVER}
    assert set(run(SUITE).arguments) - set(run(REPLAY, BAG).arguments) == set(DRIVER)


def test_every_argument_is_described(run: Run) -> None:
    arguments = run(REPLAY, BAG).arguments
    assert set(arguments) == {
        *EVERYTHING,
        *REPLAY_EVERYTHING,
        "mode",
        "params_file",
        "respawn",
        "large_images",
    }
    assert all(action.options["description"].endswith(".") for action in arguments.values())


def test_an_argument_left_alone_leaves_a_parameter_alone(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that params_file can set it; the shown default must then be that of the node."""
    context = run(REPLAY, BAG)
    for node in context.nodes:
        settings = _settings(node.executable, monkeypatch)
        own = {"bag", "topics", "wait_for_subscribers"}
        for name in ({*context.arguments} & {*settings}) - own:
            assert name not in node.parameters
            shown = context.launch_configurations[name]
            default = settings[name].default
            if isinstance(default, bool):
                assert _as_bool(shown) is default
            else:
                assert type(default)(shown) == default


def test_a_live_calibration_can_be_saved(run: Run, tmp_path: Path) -> None:
    """By default beside the calibration in use, else in the working directory."""
    server = {"calibration_server": "true"}
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "cal.yaml").touch()
    for given, folder in [
        ({}, tmp_path),
        ({"calibration": "folder/cal.yaml"}, tmp_path / "folder"),
        ({"calibration": "2024", "output": "folder/new.yaml"}, tmp_path / "folder"),
    ]:
        node = run(SUITE, {**server, **given}).node("calibration_server")
        assert node.fallback == {"directory": str(folder)}
        assert node.parameters.get("output") == given.get("output")
        assert "directory" not in node.parameters
    node = run(SUITE, {**server, "directory": "folder"}).node("calibration_server")
    assert node.parameters["directory"] == "folder"


# -- examples ------------------------------------------------------------------------------------------


def _declared_in_xml(path: Path) -> tuple[str, dict[str, str], dict[str, str]]:
    (include,) = (root := ElementTree.parse(path).getroot()).findall("include")
    declared = {arg.attrib["name"]: arg.attrib["default"] for arg in root.findall("arg")}
    passed = {arg.attrib["name"]: arg.attrib["value"] for arg in include.findall("arg")}
    return include.attrib["file"], declared, passed


def _declared_in_yaml(path: Path) -> tuple[str, dict[str, str], dict[str, str]]:
    parts = load_yaml(path.read_text(encoding="utf-8"), str(path))["launch"]
    (include,) = [part["include"] for part in parts if "include" in part]
    arguments = [part["arg"] for part in parts if "arg" in part]
    declared = {argument["name"]: argument["default"] for argument in arguments}
    return include["file"], declared, {arg["name"]: arg["value"] for arg in include["arg"]}


@pytest.mark.parametrize(
    ("path", "read"),
    [
        (SUITE.with_suffix(".xml"), _declared_in_xml),
        (SUITE.with_suffix(".yaml"), _declared_in_yaml),
    ],
)
def test_the_other_launch_files_include_this_one(
    run: Run, path: Path, read: Callable[[Path], Any]
) -> None:
    file, declared, passed = read(path)
    assert file == f"$(dirname)/{SUITE.name}"
    assert passed == {name: f"$(var {name})" for name in declared}
    arguments = run(SUITE).arguments
    for name, default in declared.items():
        assert default == arguments[name].options["default_value"]


def test_the_example_of_a_params_file_shows_the_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    path = ROOT / "config" / "semcal_parameters.yaml"
    sections = load_yaml(path.read_text(encoding="utf-8"), str(path))
    assert len(sections) >= 4
    for node, section in sections.items():
        namespace, _, executable = node.rpartition("/")
        assert namespace == "/sem"
        settings = _settings(executable, monkeypatch)
        (values,) = section.values()
        assert values == {name: settings[name].default for name in values}


# -- the environment -----------------------------------------------------------------------------------


def _of(context: Context, prefix: str) -> list[dict[str, str]]:
    return [
        {name: value for name, value in node.environment.items() if name.startswith(prefix)}
        for node in context.nodes
    ]


def test_large_images_are_prepared_for(run: Run) -> None:
    context = run(REPLAY, BAG)
    assert Path(PROFILE).is_file()
    names = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
    for found in _of(context, "FAST"):
        assert found == dict.fromkeys(names, PROFILE)
    text = Path(PROFILE).read_text(encoding="utf-8")
    for found in _of(context, "MALLOC_"):
        assert set(found) == {"MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"}
        # The profile tells the same to who starts nodes by hand.
        assert all(f"{name}={value}" in text for name, value in found.items())


def test_large_images_can_be_left_out(run: Run) -> None:
    context = run(REPLAY, {**BAG, "large_images": "false"})
    assert all(node.environment == {} for node in context.nodes)


def test_what_the_user_has_set_stays(run: Run) -> None:
    own = {"FASTDDS_DEFAULT_PROFILES_FILE": "own.xml", "MALLOC_TRIM_THRESHOLD_": "1"}
    context = run(REPLAY, BAG, own)
    assert _of(context, "FAST") == [{"FASTDDS_DEFAULT_PROFILES_FILE": "own.xml"}] * 3
    assert {found["MALLOC_TRIM_THRESHOLD_"] for found in _of(context, "MALLOC_")} == {"1"}


# -- the replay ----------------------------------------------------------------------------------------


def test_a_replay_needs_a_recording(run: Run) -> None:
    with pytest.raises(LookupError, match="bag"):
        run(REPLAY)


def test_a_replay_waits_for_the_suite(run: Run) -> None:
    context = run(REPLAY, BAG)
    assert [node.executable for node in context.nodes][-1] == "bag_player"
    assert context.node("bag_player").parameters == {
        "bag": "recording",
        "wait_for": "magnification:2 image:1",
    }


def test_a_replay_waits_for_every_node_that_it_starts(run: Run) -> None:
    """Frames are lost without a magnification, and before the rectifier hears the compensator."""
    given = {**BAG, "mode": "separate", "calibration_server": "true"}
    player = run(REPLAY, given).node("bag_player").parameters
    awaited = dict(word.split(":") for word in player["wait_for"].split())
    assert awaited == {"magnification": "4", "image": "3", "image_stabilized": "1", "stage": "1"}
    player = run(REPLAY, {**given, "wait_for_subscribers": "3"}).node("bag_player").parameters
    assert player["wait_for_subscribers"] == 3
    assert "wait_for" not in player


def test_the_nodes_go_by_the_clock_that_the_player_publishes(run: Run) -> None:
    context = run(REPLAY, {**BAG, "clock": "true"})
    for node in context.nodes:
        name = "clock" if node.executable == "bag_player" else "use_sim_time"
        assert node.parameters[name] is True


def _handle(context: Context, kind: str, event: Any) -> list[Any]:
    """What the handlers of a kind of event answer."""
    found: list[Any] = []
    for handler in [h for h in context.handlers if type(h).__name__ == kind]:
        options = dict(handler.options)
        target = options.pop("target_action", None)
        ((_, answer),) = options.items()
        if target is None or target(event.action):
            given = (event,) if kind == "OnProcessIO" else (event, context)
            found += answer(*given) or []
    return found


def _after_exit(context: Context, action: Any, status: int) -> list[Any]:
    """The actions that follow the exit of a process."""
    event = SimpleNamespace(action=action, returncode=status, process_name="name")
    return _handle(context, "OnProcessExit", event)


def _after_shutdown(context: Context) -> str:
    """The error with which launch ends; empty if it ends with status 0."""
    context.is_shutdown = True
    for timer in _handle(context, "OnShutdown", SimpleNamespace()):
        # By default, launch cancels a timer at the shutdown.
        assert timer.options["cancel_on_shutdown"] is False
        try:
            for action in timer.options["actions"]:
                _visit(action, context)
        except RuntimeError as error:
            return str(error)
    return ""


def _names(actions: list[Any]) -> list[str]:
    return [type(action).__name__ for action in actions]


def _is_started_again(node: Started, actions: list[Any]) -> bool:
    """Whether launch does so: it waits for the delay and then looks whether the process was shut down meanwhile.

    Whatever the status is: launch/actions/execute_local.py of https://github.com/ros2/launch.
    """
    if not node.respawn:
        return False
    assert node.respawn_delay, "without a delay launch does not wait for what follows the exit"
    for action in actions:
        if type(action).__name__ == "Shutdown":
            return False
        if type(action).__name__ == "EmitEvent":
            event = action.options["event"]
            assert isinstance(event, ShutdownProcess)
            if event.process_matcher(node.action):
                return False
    return True


def test_the_end_of_the_replay_ends_everything(run: Run) -> None:
    context = run(REPLAY, BAG)
    player = context.node("bag_player")
    (timer,) = [a for a in _after_exit(context, player.action, 0) if "period" in a.options]
    # Not at once: the last frame is still being worked on.
    assert 0.0 < timer.options["period"] <= 2.0
    assert _names(timer.options["actions"]) == ["Shutdown"]


@pytest.mark.parametrize("executable", ["bag_player", "stream_corrector", "parameter_server"])
def test_a_node_that_cannot_start_ends_the_replay(run: Run, executable: str) -> None:
    context = run(REPLAY, BAG)
    assert "Shutdown" in _names(_after_exit(context, context.node(executable).action, 2))


@pytest.mark.parametrize("status", [-9, -11, 1])
def test_a_node_that_dies_ends_the_replay_only_if_it_does_not_come_back(
    run: Run, status: int
) -> None:
    for respawn, index in itertools.product(("true", "false"), range(3)):
        context = run(REPLAY, {**BAG, "respawn": respawn})
        node = context.nodes[index]
        actions = _after_exit(context, node.action, status)
        again = _is_started_again(node, actions)
        assert ("Shutdown" in _names(actions)) is not again
        assert again is (respawn == "true" and node.executable != "bag_player")


def test_other_ends_do_not_end_the_replay(run: Run) -> None:
    context = run(REPLAY, BAG)
    assert _names(_after_exit(context, context.node("stream_corrector").action, 0)) == ["EmitEvent"]


# -- nodes that die ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["combined", "separate"])
def test_a_node_that_dies_is_started_again_after_a_delay(run: Run, mode: str) -> None:
    context = run(SUITE, {"mode": mode, "calibration_server": "true"})
    for node in context.nodes:
        assert 0.0 < node.respawn_delay <= 2.0
        # kill -9, a crash, an exception.
        for status in (-9, -11, 1):
            actions = _after_exit(context, node.action, status)
            assert actions == []
            assert _is_started_again(node, actions)


@pytest.mark.parametrize("path", [SUITE, REPLAY])
def test_a_node_that_ended_by_itself_is_not_started_again(run: Run, path: Path) -> None:
    """Status 2: with what it was given it will never start. Status 0: it was asked to end."""
    given = {"calibration_server": "true", **(BAG if path == REPLAY else {})}
    for status in (2, 0):
        context = run(path, given)
        for node in context.nodes:
            assert not _is_started_again(node, _after_exit(context, node.action, status))


def test_only_the_node_that_ended_stays_away(run: Run) -> None:
    context = run(SUITE)
    ended, other = context.nodes
    (action,) = _after_exit(context, ended.action, 2)
    matcher = action.options["event"].process_matcher
    assert matcher(ended.action)
    assert not matcher(other.action)


def test_nodes_are_left_dead_if_so_wished(run: Run) -> None:
    context = run(SUITE, {"respawn": "false"})
    assert not any(node.respawn for node in context.nodes)


def test_processes_of_other_packages_are_left_alone(run: Run) -> None:
    context = run(SUITE)
    for status in (0, 1, 2, -9):
        assert _after_exit(context, ACTIONS["Node"](package="another"), status) == []
        assert _after_exit(context, SimpleNamespace(), status) == []


# -- the status of the launch itself -------------------------------------------------------------------


def _say(context: Context, node: Started, text: bytes) -> None:
    _handle(context, "OnProcessIO", SimpleNamespace(action=node.action, text=text))


def test_a_launch_in_which_every_node_has_failed_fails(run: Run) -> None:
    context = run(SUITE)
    for node in context.nodes:
        _say(context, node, b"first\ncal.yaml: not valid YAML; calibrate again\n\n")
        _after_exit(context, node.action, 2)
    # Which node, its status, and its own reason, which says what to do.
    expected = "name ended with status 2: cal.yaml: not valid YAML; calibrate again"
    assert _after_shutdown(context) == "; ".join([expected] * 2)
    assert _after_shutdown(context) == "", "it is said once"


def test_a_launch_of_which_a_node_was_left_ends_well(run: Run) -> None:
    """Interrupted by its user, it ends with 0, though one node could not start."""
    context = run(SUITE)
    _after_exit(context, context.nodes[0].action, 2)
    assert _after_shutdown(context) == ""


@pytest.mark.parametrize("path", [SUITE, REPLAY])
def test_an_interrupted_launch_ends_well(run: Run, path: Path) -> None:
    """Even where a node was interrupted while it started, and ended with the signal."""
    context = run(path, BAG if path == REPLAY else {})
    context.is_shutdown = True
    for node in context.nodes:
        assert "Shutdown" not in _names(_after_exit(context, node.action, -2))
    assert _after_shutdown(context) == ""


def test_a_replay_of_which_one_node_has_failed_fails(run: Run) -> None:
    for index, status in itertools.product(range(3), (0, 2)):
        context = run(REPLAY, BAG)
        _after_exit(context, context.nodes[index].action, status)
        assert _after_shutdown(context) == ("name ended with status 2" if status else "")
