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

import pytest
from ament_index_python import get_package_prefix

ROOT = Path(__file__).resolve().parents[2]
SUITE = ROOT / "launch" / "semcal_launch.py"
REPLAY = ROOT / "launch" / "replay_launch.py"
PROFILE = str(ROOT / "dds" / "fastdds_large_images.xml")
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
        self.value, self.value_type = value, value_type

    def evaluate(self, context: Context) -> Any:
        if not isinstance(self.value, LaunchConfiguration):
            assert isinstance(self.value, self.value_type)
            return self.value
        text = self.value.perform(context)
        return _as_bool(text) if self.value_type is bool else self.value_type(text)


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
    def node_package(self) -> str:
        return self.options["package"]


ACTIONS = {
    name: type(name, (Action,), {})
    for name in (
        "DeclareLaunchArgument",
        "EmitEvent",
        "IncludeLaunchDescription",
        "LaunchDescription",
        "Node",
        "OnProcessExit",
        "OpaqueFunction",
        "PythonLaunchDescriptionSource",
        "RegisterEventHandler",
        "SetEnvironmentVariable",
        "Shutdown",
        "TimerAction",
    )
}
STAND_INS = {
    "launch": ("LaunchDescription",),
    "launch.actions": (
        "DeclareLaunchArgument",
        "EmitEvent",
        "IncludeLaunchDescription",
        "OpaqueFunction",
        "RegisterEventHandler",
        "SetEnvironmentVariable",
        "Shutdown",
        "TimerAction",
    ),
    "launch.conditions": (IfCondition,),
    "launch.event_handlers": ("OnProcessExit",),
    "launch.events": (matches_action,),
    "launch.events.process": (ShutdownProcess,),
    "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
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
    on_exit: list[Action] = field(default_factory=list)
    arguments: dict[str, Action] = field(default_factory=dict)

    def node(self, executable: str) -> Started:
        return next(node for node in self.nodes if node.executable == executable)


def _as_bool(text: str) -> bool:
    return {"true": True, "1": True, "false": False, "0": False}[text.lower()]


def _describe(path: str | Path) -> Action:
    spec = importlib.util.spec_from_file_location("launch_file_under_test", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


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
    respawn = options.pop("respawn", False)
    if isinstance(respawn, LaunchConfiguration):
        respawn = _as_bool(respawn.perform(context))
    options.setdefault("respawn_delay", None)
    files, parameters = [], {}
    for item in options.pop("parameters"):
        if isinstance(item, str):
            # What comes later wins: a file must not win over an argument.
            assert not parameters
            files.append(item)
            continue
        for name, value in item.items():
            plain = value.evaluate(context) if isinstance(value, ParameterValue) else value
            parameters[name] = plain
    started = Started(
        **options,
        files=files,
        parameters=parameters,
        environment=dict(context.environment),
        respawn=respawn,
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
        for child in action.options["function"](context):
            _visit(child, context)
    elif kind == "SetEnvironmentVariable":
        name, value = action.given
        context.environment[name] = value
    elif kind == "IncludeLaunchDescription":
        for name, value in action.options["launch_arguments"]:
            context.launch_configurations[name] = value.perform(context)
        _visit(_describe(action.given[0].given[0]), context)
    elif kind == "RegisterEventHandler":
        context.on_exit.append(action.given[0])
    elif kind == "Node":
        _start(action, context)
    else:
        raise AssertionError(f"no stand-in for {kind}")


Run = Callable[..., Context]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    """Launch a file with arguments, in an environment."""
    for name, members in STAND_INS.items():
        module = ModuleType(name)
        for member in members:
            value = ACTIONS[member] if isinstance(member, str) else member
            setattr(module, value.__name__, value)
        monkeypatch.setitem(sys.modules, name, module)

    def launch(
        path: Path, arguments: dict[str, str] | None = None, environment: Any = ()
    ) -> Context:
        context = Context(dict(arguments or {}), dict(environment))
        _visit(_describe(path), context)
        return context

    return launch


# -- what the nodes accept ---------------------------------------------------------------------------


class _Declared(Exception):
    """Ends the construction of a node once its parameters are known."""


def _settings(executable: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The parameters that a node declares, by name; the node itself is not started."""
    from semcal_ros.nodes.common import base

    found: dict[str, Any] = {}

    def record(_node: Any, declarations: Any) -> None:
        found.update({declaration.name: declaration for declaration in declarations})
        raise _Declared

    module = importlib.import_module(f"semcal_ros.nodes.{executable}")
    with monkeypatch.context() as patch:
        patch.setattr(base.Node, "__init__", lambda *_args, **_options: None)
        patch.setattr(base, "Parameters", record)
        patch.setattr(module, "run_node", lambda factory, _args=None, threads=1: factory())
        with pytest.raises(_Declared):
            module.main([])
    return found


EVERYTHING = {
    "namespace": "/lab/sem",
    "config": "jsm820",
    "calibration": "2024",
    "calibration_server": "true",
    "use_sim_time": "true",
    "log_level": "debug",
}
REPLAY_EVERYTHING = {
    **EVERYTHING,
    "bag": "2025",
    "rate": "5",
    "loop": "true",
    "clock": "true",
    "wait_for_subscribers": "3",
}
CASES = [
    (path, mode, arguments)
    for (path, few, many), mode in itertools.product(
        [(SUITE, {}, EVERYTHING), (REPLAY, BAG, REPLAY_EVERYTHING)], ["combined", "separate"]
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
        assert node.name == node.executable
        assert (folder / node.executable).is_file()
        settings = _settings(node.executable, monkeypatch)
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
    ],
)
def test_the_suite_starts(run: Run, arguments: dict[str, str], wanted: list[str]) -> None:
    context = run(SUITE, arguments)
    assert [node.executable for node in context.nodes] == wanted
    assert {node.namespace for node in context.nodes} == {"sem"}


def test_the_rectifier_takes_what_the_compensator_makes(run: Run) -> None:
    assert run(SUITE, {"mode": "separate"}).node("rectifier").parameters == {"input": "stabilized"}


def test_arguments_reach_every_node(run: Run) -> None:
    for mode in ("combined", "separate"):
        context = run(SUITE, {**EVERYTHING, "mode": mode})
        for node in context.nodes:
            assert node.namespace == "/lab/sem"
            assert node.ros_arguments == ["--log-level", "debug"]
            assert node.parameters["config"] == "jsm820"
            assert node.parameters["use_sim_time"] is True
            has_calibration = node.executable not in {"drift_compensator", "calibration_server"}
            # A file whose name is a number is a name all the same.
            assert node.parameters.get("calibration") == ("2024" if has_calibration else None)


def test_a_home_folder_is_found(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    file = tmp_path / "more.yaml"
    file.touch()
    given = {"calibration": "~/cal.yaml", "bag": "~/recording", "params_file": "~/more.yaml"}
    context = run(REPLAY, given)
    corrector, player = context.node("stream_corrector"), context.node("bag_player")
    assert corrector.parameters["calibration"] == str(tmp_path / "cal.yaml")
    assert player.parameters["bag"] == str(tmp_path / "recording")
    assert corrector.files == player.files == [str(file)]


@pytest.mark.parametrize("path", [SUITE, REPLAY])
def test_a_missing_params_file_is_refused(run: Run, path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"missing\.yaml"):
        run(path, {**BAG, "params_file": "missing.yaml"})


@pytest.mark.parametrize(("name", "value"), [("mode", "both"), ("log_level", "loud")])
def test_a_wrong_choice_is_refused(run: Run, name: str, value: str) -> None:
    with pytest.raises(ValueError, match=name):
        run(SUITE, {name: value})


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
        for name in {*context.arguments} & {*settings} - {"bag", "wait_for_subscribers"}:
            assert name not in node.parameters
            shown = context.launch_configurations[name]
            default = settings[name].default
            if isinstance(default, bool):
                assert _as_bool(shown) is default
            else:
                assert type(default)(shown) == default


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
    assert context.node("bag_player").parameters == {"bag": "recording", "wait_for_subscribers": 1}


def test_the_nodes_go_by_the_clock_that_the_player_publishes(run: Run) -> None:
    context = run(REPLAY, {**BAG, "clock": "true"})
    for node in context.nodes:
        name = "clock" if node.executable == "bag_player" else "use_sim_time"
        assert node.parameters[name] is True


def _after_exit(context: Context, action: Action, status: int) -> list[Any]:
    """The actions that follow the exit of a process."""
    found: list[Any] = []
    for handler in context.on_exit:
        if handler.options["target_action"](action):
            event = SimpleNamespace(action=action, returncode=status, process_name="name")
            found += handler.options["on_exit"](event, context) or []
    return found


def _names(actions: list[Any]) -> list[str]:
    return [type(action).__name__ for action in actions]


def _is_started_again(context: Context, node: Started, status: int) -> bool:
    """Whether launch does so: it waits for the delay and then looks whether the process was shut down meanwhile.

    Whatever the status is: launch/actions/execute_local.py of https://github.com/ros2/launch.
    """
    if not node.respawn:
        return False
    assert node.respawn_delay, "without a delay launch does not wait for what follows the exit"
    for action in _after_exit(context, node.action, status):
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
    for respawn in ("true", "false"):
        context = run(REPLAY, {**BAG, "respawn": respawn})
        for node in context.nodes:
            ends = "Shutdown" in _names(_after_exit(context, node.action, status))
            again = _is_started_again(context, node, status)
            assert ends is not again
            assert again is (respawn == "true" and node.executable != "bag_player")


def test_other_ends_do_not_end_the_replay(run: Run) -> None:
    context = run(REPLAY, BAG)
    assert _names(_after_exit(context, context.node("stream_corrector").action, 0)) == ["EmitEvent"]
    assert _after_exit(context, ACTIONS["Node"](package="another"), 1) == []
    assert _after_exit(context, SimpleNamespace(), 1) == []


# -- nodes that die ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["combined", "separate"])
def test_a_node_that_dies_is_started_again_after_a_delay(run: Run, mode: str) -> None:
    context = run(SUITE, {"mode": mode, "calibration_server": "true"})
    for node in context.nodes:
        assert 0.0 < node.respawn_delay <= 2.0
        # kill -9, a crash, an exception.
        assert all(_is_started_again(context, node, status) for status in (-9, -11, 1))
        assert _after_exit(context, node.action, -9) == []


@pytest.mark.parametrize("path", [SUITE, REPLAY])
def test_a_node_that_ended_by_itself_is_not_started_again(run: Run, path: Path) -> None:
    """Status 2: with what it was given it will never start. Status 0: it was asked to end."""
    context = run(path, {**BAG, "calibration_server": "true"})
    for node in context.nodes:
        assert not _is_started_again(context, node, 2)
        assert not _is_started_again(context, node, 0)


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
