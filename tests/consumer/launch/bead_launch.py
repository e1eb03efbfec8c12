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

from pathlib import Path

from ament_index_python import get_package_share_directory
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.conditions import UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    suite = Path(get_package_share_directory("semcal_ros")) / "launch" / "replay_launch.py"
    # It gets the arguments of this file, too; one without a default must be handed on.
    bag = {"bag": LaunchConfiguration("bag")}
    one_process = EqualsSubstitution(LaunchConfiguration("mode"), "one_process")
    beside = UnlessCondition(one_process)
    return LaunchDescription(
        [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(suite)), launch_arguments=bag.items()
            ),
            Node(package="bead_tracker", executable="bead", output="screen", condition=beside),
        ]
    )
