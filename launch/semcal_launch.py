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

"""The suite on a live stream.

ros2 launch semcal_ros semcal_launch.py config:=jsm820 calibration:=jsm820.yaml
ros2 launch semcal_ros semcal_launch.py --show-args
"""

import difflib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from launch import LaunchDescription  # isort: skip - this folder has the same name
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit, OnProcessIO, OnShutdown
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "semcal_ros"
SHARE = Path(__file__).absolute().parents[1]
PROFILE = SHARE / "dds" / "fastdds_large_images.xml"
# Fast DDS 2 reads the first name, Fast DDS 3 the second.
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
# Bytes. The memory of one frame is reused for the next instead of being faulted in again.
MALLOC_VARIABLES = {"MALLOC_MMAP_THRESHOLD_": "268435456", "MALLOC_TRIM_THRESHOLD_": "536870912"}
# Seconds. Long enough for on_exit to come first, short for a user who waits for frames.
RESPAWN_DELAY_S = 1.0
# Asked to end; cannot start with what it was given.
FINAL = (0, 2)
# Share of equal letters from which on a name counts as a misspelt argument, as `calibraton` and `param_file` do. A
# launch file that includes this one may have arguments of its own, and launch sets `ros_namespace` (0.82).
ALIKE = 0.85


# -- arguments ---------------------------------------------------------------------------------------
# All values are checked before the first node: launch does not end nodes that run when a later value is refused.


class Argument(NamedTuple):
    """One argument; ``check`` returns the value to use, or raises ValueError with what was expected."""

    default: str | None
    description: str
    check: Callable[[str], str] = str
    choices: list[str] | None = None


def boolean(text):
    if text.lower() not in ("true", "false", "1", "0"):
        raise ValueError("expected true or false")
    return "true" if text.lower() in ("true", "1") else "false"


def number(low, high, kind=float):
    what = "a number" if kind is float else "an integer"

    def check(text):
        try:
            if low <= kind(text) <= high:
                return text
        except ValueError:
            pass
        raise ValueError(f"expected {what} from {low:g} to {high:g}")

    return check


def ros_namespace(text):
    if text != "/" and not re.fullmatch(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", text, re.ASCII):
        raise ValueError("expected names of letters, digits and _, with / between them")
    return text


def expand(text):
    # A shell leaves the ~ of `name:=~/file` to us.
    return os.path.expanduser(text)


def existing_file(text):
    if text and not Path(expand(text)).is_file():
        raise ValueError("there is no such file; check the path")
    return expand(text)


def existing_folder(text):
    if text and not Path(expand(text)).is_dir():
        raise ValueError("there is no such folder; make it, or check the path")
    return expand(text)


def new_file(text):
    path = Path(expand(text))
    if text and (path.is_dir() or not path.parent.is_dir()):
        raise ValueError("expected a file in a folder that exists")
    return expand(text)


def microscope(text):
    """A path, or the name of a configuration that is shipped; the nodes read it."""
    places = [SHARE / "msg_configs" / f"{Path(text).name}{end}" for end in ("", ".yaml", ".yml")]
    if Path(expand(text)).is_file() or (
        text == Path(text).name and any(place.is_file() for place in places)
    ):
        return expand(text)
    names = sorted(path.stem for path in (SHARE / "msg_configs").glob("*.yaml"))
    raise ValueError(f"expected the path of a YAML file or one of {', '.join(names)}")


ARGUMENTS = {
    "namespace": Argument("sem", "Namespace of all nodes and of their topics.", ros_namespace),
    "config": Argument(
        "generic",
        "The microscope: a file as in msg_configs, or the name of one of those.",
        microscope,
    ),
    "calibration": Argument(
        "", "Calibration file; empty to wait for one on the topic calibration.", existing_file
    ),
    "mode": Argument(
        "combined",
        "combined: stream_corrector removes drift and distortion in one interpolation."
        " separate: drift_compensator, then rectifier, for users who need the images in between as well."
        " one_process: suite, in which source, stream_corrector, parameter_server, viewer and consumers hand frames"
        " over in memory.",
        choices=["combined", "separate", "one_process"],
    ),
    "viewer": Argument(
        "true", "For mode:=one_process: also show the stream in the browser.", boolean
    ),
    "consumers": Argument(
        "all",
        "For mode:=one_process: entry points semcal_ros.consumers that get the frames. Names with commas between them,"
        " all, or none.",
    ),
    "on_mismatch": Argument(
        "warn",
        "While the topic conditions tells of another microscope, voltage, working distance or scan rotation than the"
        " calibration was made with. warn: the log and the diagnostics say so. refuse: image_rect stays silent, too.",
        choices=["warn", "refuse"],
    ),
    "monitor_period": Argument(
        "0",
        "Seconds between two frames in which parameter_server looks for the grid, to say whether the calibration still"
        " holds. 0: none.",
        number(0.0, 86400.0),
    ),
    "calibration_server": Argument(
        "false", "Also start calibration_server, to calibrate live.", boolean
    ),
    "output": Argument(
        "",
        "File to which ~/save of calibration_server writes. Empty: calibration.yaml in directory.",
        new_file,
    ),
    "directory": Argument(
        "",
        "Folder of the files that may be named while calibration_server runs. Empty: that of output, else that of"
        " calibration, else the working directory.",
        existing_folder,
    ),
    "params_file": Argument(
        "",
        "YAML file with further parameters, as config/semcal_parameters.yaml. An argument of this launch file that is"
        " not left at its default wins over the file.",
        existing_file,
    ),
    "use_sim_time": Argument(
        "false", "Take the time from /clock. Frames keep their stamps either way.", boolean
    ),
    "log_level": Argument(
        "info",
        "Least severity that is logged.",
        choices=["debug", "info", "warn", "error", "fatal"],
    ),
    "respawn": Argument(
        "true",
        "Start a node again that has died, after a second. Not one that was asked to end, nor one"
        " that ended with status 2 because it cannot start with what it was given.",
        boolean,
    ),
    "large_images": Argument(
        "true",
        "Set the environment for large images: shared memory for Fast DDS, and malloc."
        " What the environment sets already stays.",
        boolean,
    ),
}
# What is no text.
TYPES = {"monitor_period": float, "viewer": lambda text: text == "true"}
# Not of a replay, whose recording takes the place of the microscope.
DRIVER = {
    "source": Argument(
        "",
        "Also start the node microscope with this source; empty for a driver of your own. Its other parameters come"
        " from params_file.",
        choices=["", "folder", "openfibsem", "video"],
    ),
    "folder": Argument(
        "",
        "Folder into which the microscope saves, for source:=folder.",
        existing_folder,
    ),
}
LIVE = {**ARGUMENTS, **DRIVER}


def generate_launch_description():
    return LaunchDescription(
        [
            *declarations(LIVE),
            OpaqueFunction(function=check_arguments, args=[LIVE]),
            OpaqueFunction(
                function=set_environment, condition=IfCondition(LaunchConfiguration("large_images"))
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )


def declarations(arguments):
    return [
        DeclareLaunchArgument(
            name,
            default_value=argument.default,
            description=argument.description,
            choices=argument.choices,
        )
        for name, argument in arguments.items()
    ]


def check_arguments(context, arguments):
    """Refuse the first wrong value by name; warn of names that look misspelt."""
    checked = []
    for name, argument in arguments.items():
        text = LaunchConfiguration(name).perform(context)
        try:
            checked.append(SetLaunchConfiguration(name, argument.check(text)))
        except ValueError as error:
            raise RuntimeError(f"argument {name}:={text}: {error}") from None
    values = dict(context.launch_configurations)
    # launch takes any name. Those of a launch file that includes this one are here as well.
    unset = [name for name, argument in arguments.items() if values[name] == argument.default]
    for name in sorted(set(values) - set(arguments)):
        for meant in difflib.get_close_matches(name, unset, n=1, cutoff=ALIKE):
            get_logger(PACKAGE).warning(
                f"there is no argument {name}, and {meant} is not set: is {meant}:={values[name]} meant?"
            )
    return checked


# -- nodes -------------------------------------------------------------------------------------------


def set_environment(context):
    """For all processes that start later, the image viewers of an including launch file as well."""
    wanted = dict(MALLOC_VARIABLES)
    # A profile of the user's own may do more than carry large images, such as name a discovery server.
    if not any(name in context.environment for name in PROFILE_VARIABLES):
        wanted.update(dict.fromkeys(PROFILE_VARIABLES, str(PROFILE)))
    return [
        SetEnvironmentVariable(name, value)
        for name, value in wanted.items()
        if name not in context.environment
    ]


def start_nodes(context):
    if in_one_process(context):
        nodes = [make_suite(context, *DRIVER), *make_calibration_server(context)]
    else:
        nodes = [*make_driver(context), *make_nodes(context)]
    return [*NodeWatch(nodes).handlers(), *nodes]


def make_driver(context):
    if not LaunchConfiguration("source").perform(context):
        return []
    return [suite_node(context, "microscope", "config", *DRIVER)]


def make_nodes(context):
    # The stream nodes get the file as well as the topic: their first frame is rectified already.
    corrector = ("config", "calibration", "on_mismatch")
    nodes = [suite_node(context, "parameter_server", "config", "calibration", "monitor_period")]
    if LaunchConfiguration("mode").perform(context) == "combined":
        nodes.append(suite_node(context, "stream_corrector", *corrector))
    else:
        stabilized = {"input": "stabilized"}
        nodes.append(suite_node(context, "drift_compensator", "config"))
        nodes.append(suite_node(context, "rectifier", *corrector, fixed=stabilized))
    return [*nodes, *make_calibration_server(context)]


def make_calibration_server(context):
    if LaunchConfiguration("calibration_server").perform(context) != "true":
        return []
    folder = {"directory": folder_of_calibrations(context)}
    server = ("calibration_server", "config", "calibration", "output", "directory")
    return [suite_node(context, *server, fallback=folder)]


def in_one_process(context):
    return LaunchConfiguration("mode").perform(context) == "one_process"


def make_suite(context, *source, fixed=None, **options):
    """The nodes in one process, which all get the parameters that they have; ``source`` names those of the source."""
    passed = ("config", "calibration", "on_mismatch", "monitor_period", "viewer", "consumers")
    return suite_node(context, "suite", *passed, *source, fixed=fixed, name=None, **options)


def folder_of_calibrations(context):
    for name in ("output", "calibration"):
        if path := LaunchConfiguration(name).perform(context):
            return str(Path(path).absolute().parent)
    return str(Path.cwd())


def suite_node(context, executable, *passed, fixed=None, fallback=None, **options):
    """An executable of the suite, which is started again when it dies."""
    respawn = LaunchConfiguration("respawn").perform(context) == "true"
    values = given(context, LIVE, passed)
    parameters = {name: TYPES.get(name, str)(text) for name, text in values.items()}
    parameters.update(fixed or {})
    if LaunchConfiguration("use_sim_time").perform(context) == "true":
        parameters["use_sim_time"] = True
    respawning = {"respawn": respawn, "respawn_delay": RESPAWN_DELAY_S}
    return make_node(context, executable, parameters, fallback, **{**respawning, **options})


def given(context, arguments, names):
    """The arguments that are not left at their default, so that params_file can set the others."""
    values = {name: LaunchConfiguration(name).perform(context) for name in names}
    return {name: text for name, text in values.items() if text != arguments[name].default}


def make_node(context, executable, parameters, fallback=None, **options):
    """``parameters`` win over params_file, which wins over ``fallback``."""
    params_file = LaunchConfiguration("params_file").perform(context)
    # Several nodes in one process keep their names, and get the parameters of a section for all nodes.
    options.setdefault("name", executable)
    return Node(
        package=PACKAGE,
        executable=executable,
        namespace=LaunchConfiguration("namespace").perform(context),
        parameters=[
            *([typed(fallback)] if fallback else []),
            *([params_file] if params_file else []),
            typed(parameters),
        ],
        ros_arguments=[
            "--log-level",
            LaunchConfiguration("log_level").perform(context),
            *enclave(context, executable),
        ],
        output="screen",
        **options,
    )


def typed(parameters):
    """With the type said, for a file named 2024 would become a number."""
    return {
        name: ParameterValue(value, value_type=type(value)) for name, value in parameters.items()
    }


def enclave(context, executable):
    """Where DDS security is on, a node has the enclave of its name (doc/security.md)."""
    if context.environment.get("ROS_SECURITY_ENABLE") != "true":
        return []
    namespace = LaunchConfiguration("namespace").perform(context).strip("/")
    return ["--enclave", f"/{namespace}/{executable}"]


# -- ends --------------------------------------------------------------------------------------------


class NodeWatch:
    """Follows nodes to their ends, so that a launch in which all have failed does not end with 0."""

    def __init__(self, nodes):
        self.running = list(nodes)
        self.failures = []
        self.is_told = False
        self.last_words = {}

    def handlers(self):
        def is_mine(action):
            return action in self.running

        return [
            RegisterEventHandler(OnProcessIO(target_action=is_mine, on_stderr=self.on_stderr)),
            RegisterEventHandler(OnProcessExit(target_action=is_mine, on_exit=self.on_exit)),
            RegisterEventHandler(OnShutdown(on_shutdown=self.on_shutdown)),
        ]

    def on_stderr(self, event):
        lines = event.text.decode(errors="replace").splitlines()
        self.last_words[event.action] = next((x for x in reversed(lines) if x.strip()), "")

    def comes_back(self, event, context):
        respawn = LaunchConfiguration("respawn").perform(context) == "true"
        return respawn and event.returncode not in FINAL

    def on_exit(self, event, context):
        """launch itself would start a node again whatever its status."""
        if self.comes_back(event, context):
            return None
        self.running.remove(event.action)
        # A node that is interrupted while it starts ends with the signal.
        if event.returncode != 0 and not context.is_shutdown:
            words = self.last_words.get(event.action, "").strip()
            text = f"{event.process_name} ended with status {event.returncode}"
            self.failures.append(f"{text}: {words}" if words else text)
        if event.returncode not in FINAL:
            return None
        return [EmitEvent(event=ShutdownProcess(process_matcher=matches_action(event.action)))]

    def has_failed(self):
        return bool(self.failures) and not self.running

    def on_shutdown(self, _event, _context):
        """launch ends with another status than 0 only if an exception reaches its loop.

        It is raised after this event, for the handlers of other nodes, which end them, would be skipped.
        """
        if self.is_told or not self.has_failed():
            return None
        self.is_told = True
        failing = OpaqueFunction(function=fail, args=["; ".join(self.failures)])
        return [TimerAction(period=0.0, actions=[failing], cancel_on_shutdown=False)]


def fail(_context, reason):
    raise RuntimeError(reason)
