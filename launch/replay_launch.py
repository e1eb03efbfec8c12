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

"""The suite on a recording; everything ends with it.

ros2 launch semcal_ros replay_launch.py bag:=recording calibration:=jsm820.yaml
ros2 launch semcal_ros replay_launch.py --show-args
"""

from pathlib import Path

from launch import LaunchDescription  # isort: skip - this folder has the same name
from launch.actions import OpaqueFunction, SetLaunchConfiguration, Shutdown, TimerAction
from launch.conditions import IfCondition
from launch.launch_description_sources import load_python_launch_file_as_module
from launch.substitutions import LaunchConfiguration

suite = load_python_launch_file_as_module(
    str(Path(__file__).absolute().with_name("semcal_launch.py"))
)
# Seconds for the frames that have been received but are still being worked on.
GRACE_S = 1.0

# What the nodes of the suite subscribe to, of what a recording can hold; `image`, `magnification` and `stage` are the
# configured topics. In the mode `separate` the images go through drift_compensator to the rectifier, which takes the
# stamps of the originals as well.
INPUTS = {
    "parameter_server": ["magnification"],
    "stream_corrector": ["image", "magnification"],
    "drift_compensator": ["image", "magnification"],
    "rectifier": ["image", "magnification", "image_stabilized"],
    "calibration_server": ["image", "magnification", "stage"],
}


def recording(text):
    if not Path(suite.expand(text)).exists():
        raise ValueError("there is no such recording; check the path")
    return suite.expand(text)


def subscribers(text):
    return text if text == "suite" else suite.number(0, 100, int)(text)


PLAYER = {
    "bag": suite.Argument(
        None, "Recording: a rosbag2 folder, or an .mcap or .db3 file.", recording
    ),
    "topics": suite.Argument(
        "inputs",
        "What is played. inputs: images, magnification and stage by the configuration, and conditions; all: whatever"
        " was recorded, also what the suite publishes itself, which then comes twice; or names, with commas between"
        " them.",
    ),
    "exclude": suite.Argument("", "Topics that are not played, with commas between them."),
    "rate": suite.Argument("1.0", "Seconds of recording per second.", suite.number(0.001, 1000.0)),
    "loop": suite.Argument("false", "Begin again at the end, until interrupted.", suite.boolean),
    "clock": suite.Argument(
        "false",
        "Publish the time of the recording on /clock, and let all nodes go by it.",
        suite.boolean,
    ),
    "start_paused": suite.Argument(
        "false", "Wait for ~/resume or ~/play_next of bag_player.", suite.boolean
    ),
    "wait_for_subscribers": suite.Argument(
        "suite",
        "suite: start once all nodes that this file starts have subscribed. A number: once images and magnification"
        " have so many subscribers each. 0: at once.",
        subscribers,
    ),
}
ARGUMENTS = {**suite.ARGUMENTS, **PLAYER}
TYPES = {
    "rate": float,
    "loop": bool,
    "clock": bool,
    "start_paused": bool,
    "wait_for_subscribers": int,
}


def generate_launch_description():
    # The recording keeps the names of its topics: `namespace` must be the one it was made in.
    return LaunchDescription(
        [
            *suite.declarations(ARGUMENTS),
            OpaqueFunction(function=suite.check_arguments, args=[ARGUMENTS]),
            SetLaunchConfiguration(
                "use_sim_time", "true", condition=IfCondition(LaunchConfiguration("clock"))
            ),
            OpaqueFunction(
                function=suite.set_environment,
                condition=IfCondition(LaunchConfiguration("large_images")),
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context):
    if suite.in_one_process(context):
        # Nobody is waited for but those in other processes: within one, all have subscribed before the player begins.
        values = {"source": "bag", **player_parameters(context)}
        player = suite.make_suite(context, respawn=False, fixed=values)
        nodes = suite.make_calibration_server(context)
    else:
        nodes = suite.make_nodes(context)
        player = make_player(context, [node.node_executable for node in nodes])
    watch = ReplayWatch(nodes, player)
    return [*watch.handlers(), *nodes, player]


def player_parameters(context):
    values = suite.given(context, ARGUMENTS, PLAYER)
    return {name: convert(text, TYPES.get(name, str)) for name, text in values.items()}


def make_player(context, executables):
    parameters = {**suite.given(context, ARGUMENTS, ["config"]), **player_parameters(context)}
    # What is waited for is not the default of the node.
    if "wait_for_subscribers" not in parameters:
        parameters["wait_for"] = awaited(executables)
    return suite.make_node(context, "bag_player", parameters)


def convert(text, kind):
    return text == "true" if kind is bool else kind(text)


def awaited(executables):
    """How many of these nodes subscribe to each topic, as the player's parameter wait_for."""
    topics = [topic for executable in executables for topic in INPUTS[executable]]
    return " ".join(f"{topic}:{topics.count(topic)}" for topic in dict.fromkeys(topics))


class ReplayWatch(suite.NodeWatch):
    """Ends the launch with the recording, or with the first node that will not come back."""

    def __init__(self, nodes, player):
        super().__init__([*nodes, player])
        self.player = player

    def comes_back(self, event, context):
        # A player that was restarted would play everything twice.
        return event.action is not self.player and super().comes_back(event, context)

    def on_exit(self, event, context):
        actions = super().on_exit(event, context) or []
        if context.is_shutdown:
            return actions
        if self.failures:
            # The player would wait forever for a node that has failed.
            return [*actions, Shutdown(reason=self.failures[0])]
        if event.action is self.player and event.returncode == 0:
            end = Shutdown(reason="the recording has ended")
            return [*actions, TimerAction(period=GRACE_S, actions=[end])]
        return actions

    def has_failed(self):
        return bool(self.failures)
