"""The suite on a recording; everything ends with it.

ros2 launch semcal_ros replay_launch.py bag:=recording calibration:=jsm820.yaml
ros2 launch semcal_ros replay_launch.py --show-args
"""

from pathlib import Path

from launch import LaunchDescription  # isort: skip - this folder has the same name
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "semcal_ros"
SUITE = Path(__file__).absolute().with_name("semcal_launch.py")
# Seconds for the frames that have been received but are still being worked on.
GRACE_S = 1.0
# Status of a node that cannot start with what it was given.
CANNOT_START = 2

# Default (None: there is none), type and description.
ARGUMENTS = {
    "bag": (None, str, "Recording: a rosbag2 folder, or an .mcap or .db3 file."),
    "rate": ("1.0", float, "Seconds of recording per second."),
    "loop": ("false", bool, "Begin again at the end, until interrupted."),
    "clock": (
        "false",
        bool,
        "Publish the time of the recording on /clock, and let all nodes go by it.",
    ),
    "wait_for_subscribers": (
        "1",
        int,
        "Start once every image topic of the recording has this many subscribers: 1 is the suite,"
        " 2 with calibration_server:=true, one more for each viewer. 0: at once.",
    ),
}


def generate_launch_description():
    suite = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(SUITE)),
        launch_arguments={"use_sim_time": LaunchConfiguration("clock")}.items(),
    )
    # The recording keeps the names of its topics: `namespace` must be the one it was made in.
    # The player comes second, for it uses the arguments and the environment of the suite.
    return LaunchDescription(
        [
            *(declaration(name) for name in ARGUMENTS),
            suite,
            OpaqueFunction(function=start_player),
        ]
    )


def declaration(name):
    default, _, description = ARGUMENTS[name]
    return DeclareLaunchArgument(name, default_value=default, description=description)


def start_player(context):
    values = {
        name: LaunchConfiguration(name).perform(context)
        for name in (*ARGUMENTS, "namespace", "config", "params_file", "log_level")
    }
    # As in the suite: what is left at its default does not win over params_file. Only to wait for
    # subscribers is a default that the node does not have.
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (default, kind, _) in ARGUMENTS.items()
        if values[name] != default or name == "wait_for_subscribers"
    }
    # A shell leaves the ~ of `name:=~/file` to us.
    parameters["bag"] = ParameterValue(str(Path(values["bag"]).expanduser()), value_type=str)
    if values["config"] != "generic":
        parameters["config"] = ParameterValue(values["config"], value_type=str)
    files = [str(Path(values["params_file"]).expanduser())] if values["params_file"] else []
    # As the suite does for its nodes.
    secure = context.environment.get("ROS_SECURITY_ENABLE") == "true"
    enclave = ["--enclave", f"/{values['namespace'].strip('/')}/bag_player"] if secure else []
    player = Node(
        package=PACKAGE,
        executable="bag_player",
        name="bag_player",
        namespace=values["namespace"],
        parameters=[*files, parameters],
        ros_arguments=["--log-level", values["log_level"], *enclave],
        output="screen",
    )
    watch = OnProcessExit(
        target_action=lambda action: getattr(action, "node_package", None) == PACKAGE,
        on_exit=lambda event, context: on_exit(event, context, event.action is player),
    )
    return [RegisterEventHandler(watch), player]


def on_exit(event, context, is_player):
    """What follows the end of a node."""
    if event.returncode == 0:
        after = TimerAction(period=GRACE_S, actions=[Shutdown(reason="the recording has ended")])
        return [after] if is_player else None
    # The suite restarts a node that has died. A player that was restarted would play everything twice, and would
    # wait forever for a node that cannot start.
    final = is_player or event.returncode == CANNOT_START
    if not final and IfCondition(LaunchConfiguration("respawn")).evaluate(context):
        return None
    return [Shutdown(reason=f"{event.process_name} ended with {event.returncode}")]
