"""The suite on a live stream.

ros2 launch semcal_ros semcal_launch.py config:=jsm820 calibration:=jsm820.yaml
ros2 launch semcal_ros semcal_launch.py --show-args
"""

from pathlib import Path

from launch import LaunchDescription  # isort: skip - this folder has the same name
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "semcal_ros"
PROFILE = Path(__file__).absolute().parents[1] / "dds" / "fastdds_large_images.xml"
# Fast DDS 2 reads the first name, Fast DDS 3 the second.
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
# Bytes. The memory of one frame is reused for the next instead of being faulted in again.
MALLOC_VARIABLES = {"MALLOC_MMAP_THRESHOLD_": "268435456", "MALLOC_TRIM_THRESHOLD_": "536870912"}
# Seconds. Long enough for on_exit to come first, short for a user who waits for frames.
RESPAWN_DELAY_S = 1.0
# Asked to end; cannot start with what it was given.
FINAL = (0, 2)

ARGUMENTS = {
    "namespace": ("sem", "Namespace of all nodes and of their topics."),
    "config": ("generic", "The microscope: a file as in msg_configs, or the name of one of those."),
    "calibration": ("", "Calibration file; empty to wait for one on the topic calibration."),
    "mode": (
        "combined",
        "combined: stream_corrector removes drift and distortion in one interpolation."
        " separate: drift_compensator, then rectifier, for users who need the images in between as well.",
    ),
    "calibration_server": ("false", "Also start calibration_server, to calibrate live."),
    "params_file": (
        "",
        "YAML file with further parameters. An argument of this launch file that is not left at"
        " its default wins over the file.",
    ),
    "use_sim_time": ("false", "Take the time from /clock. Frames keep their stamps either way."),
    "log_level": ("info", "Least severity that is logged."),
    "respawn": (
        "true",
        "Start a node again that has died, after a second. Not one that was asked to end, nor one"
        " that ended with status 2 because it cannot start with what it was given.",
    ),
    "large_images": (
        "true",
        "Set the environment for large images: shared memory for Fast DDS, and malloc."
        " What the environment sets already stays.",
    ),
}
CHOICES = {
    "mode": ["combined", "separate"],
    "log_level": ["debug", "info", "warn", "error", "fatal"],
}


def generate_launch_description():
    return LaunchDescription(
        [
            *(declaration(name) for name in ARGUMENTS),
            OpaqueFunction(
                function=set_environment, condition=IfCondition(LaunchConfiguration("large_images"))
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )


def declaration(name):
    default, description = ARGUMENTS[name]
    return DeclareLaunchArgument(
        name, default_value=default, description=description, choices=CHOICES.get(name)
    )


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
    # The stream nodes get the file as well as the topic: their first frame is rectified already.
    nodes = [node(context, "parameter_server", "config", "calibration")]
    if LaunchConfiguration("mode").perform(context) == "combined":
        nodes.append(node(context, "stream_corrector", "config", "calibration"))
    else:
        stabilized = {"input": "stabilized"}
        nodes.append(node(context, "drift_compensator", "config"))
        nodes.append(node(context, "rectifier", "config", "calibration", fixed=stabilized))
    wanted = IfCondition(LaunchConfiguration("calibration_server"))
    nodes.append(node(context, "calibration_server", "config", condition=wanted))
    watch = OnProcessExit(
        target_action=lambda action: getattr(action, "node_package", None) == PACKAGE,
        on_exit=on_exit,
    )
    return [RegisterEventHandler(watch), *nodes]


def on_exit(event, _context):
    """launch itself would start a node again whatever its status."""
    if event.returncode not in FINAL:
        return None
    return [EmitEvent(event=ShutdownProcess(process_matcher=matches_action(event.action)))]


def node(context, executable, *passed, fixed=None, condition=None):
    """An executable with those arguments of the launch file that it has as parameters."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    given = {name for name, (default, _) in ARGUMENTS.items() if values[name] != default}
    for name in given & {"calibration", "params_file"}:
        # A shell leaves the ~ of `name:=~/file` to us.
        values[name] = str(Path(values[name]).expanduser())
    # The type is said, or a file named 2024 would become a number.
    parameters = {
        name: ParameterValue(values[name], value_type=str) for name in passed if name in given
    }
    if "use_sim_time" in given:
        parameters["use_sim_time"] = ParameterValue(
            LaunchConfiguration("use_sim_time"), value_type=bool
        )
    parameters.update(fixed or {})
    files = [values["params_file"]] if "params_file" in given else []
    for path in files:
        # launch itself would only warn and go on without.
        if not Path(path).is_file():
            raise RuntimeError(f"params_file is {path!r}; expected a YAML file; check the path")
    return Node(
        package=PACKAGE,
        executable=executable,
        name=executable,
        namespace=values["namespace"],
        parameters=[*files, parameters],
        ros_arguments=["--log-level", values["log_level"], *enclave(context, executable)],
        output="screen",
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=RESPAWN_DELAY_S,
        condition=condition,
    )


def enclave(context, executable):
    """Where DDS security is on, a node has the enclave of its name (doc/security.md)."""
    if context.environment.get("ROS_SECURITY_ENABLE") != "true":
        return []
    namespace = LaunchConfiguration("namespace").perform(context).strip("/")
    return ["--enclave", f"/{namespace}/{executable}"]
