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

"""What pyproject.toml cannot say about the build of this ament_python package.

The two ways to install it put the ROS executables in the same place, lib/semcal_ros, where
`ros2 run` looks for them:

- colcon calls the commands ``install`` or ``develop``. The nodes become ordinary console scripts,
  which setup.cfg sends there, and rosdep provides the dependencies. ``bin``, which a sourced
  workspace has on its PATH, gets a link to the command ``semcal`` alone: the names of the nodes
  (``rectifier``) are too common for a PATH.
- pip builds a wheel, whose console scripts all land on the PATH. The wheel therefore carries the
  nodes as launchers in lib/semcal_ros.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import setuptools

from distutils.command.install_data import install_data  # isort: skip  # setuptools' own copy

# Read by sh first, then by the Python that sh finds from the launcher's own place, so that no
# installer has to rewrite a path. To sh the third line is a command that does nothing.
LAUNCHER = """\
#!/bin/sh
''':'
python=$(dirname -- "$(readlink -f -- "$0")")/../../bin/python3
[ -x "$python" ] || python=python3
exec "$python" "$0" "$@"
'''
import sys

# Processes that a node starts run this file again, under another name; they need no ROS.
if __name__ == "__main__":
    from {module} import {function}

    sys.exit({function}())
"""


class Distribution(setuptools.Distribution):
    """Knows whether colcon installs the package, and gives an editable wheel its data files."""

    in_workspace = False

    def parse_config_files(self, *args: Any, **kwargs: Any) -> None:
        super().parse_config_files(*args, **kwargs)
        if not Path("pyproject.toml").exists():
            # colcon build --symlink-install works in a folder that holds a link to this file only.
            source = Path(__file__).resolve().parent
            super().parse_config_files([str(source / "pyproject.toml")])
        # colcon reads all attributes as Python literals, and stops at an object.
        self.python_requires = self.metadata.python_requires = str(self.python_requires)

    def parse_command_line(self) -> bool:
        parsed = super().parse_command_line()
        self.in_workspace = not {"develop", "install"}.isdisjoint(self.commands)
        if self.in_workspace:
            self.entry_points["console_scripts"] += self.entry_points["semcal_ros.nodes"]
            self.install_requires = []
            # The setuptools of Ubuntu 24.04 keeps requirements with a condition here.
            self.extras_require = {
                name: needed for name, needed in self.extras_require.items() if name[:1] != ":"
            }
        return parsed

    def run_commands(self) -> None:
        super().run_commands()
        for command, attribute in (("install", "install_scripts"), ("develop", "script_dir")):
            # Since setuptools 80, `develop` calls pip and has no folder of its own.
            folder = getattr(self.command_obj.get(command), attribute, None)
            if command in self.commands and folder is not None:
                link_command(Path(folder) / "semcal", Path(folder).parents[1] / "bin" / "semcal")

    def has_data(self) -> bool:
        """What the build of an editable wheel asks for."""
        return self.has_data_files()


def link_command(executable: Path, link: Path) -> None:
    """Make a relative link, so that the installed folder can be moved."""
    # None without the former: `develop --uninstall`, or scripts that go to another folder.
    if executable.parent.name == "semcal_ros" and executable.exists():
        link.parent.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(os.path.relpath(executable, link.parent))


class InstallData(install_data):
    """Adds to a wheel what colcon provides by itself."""

    def run(self) -> None:
        super().run()
        if self.distribution.in_workspace:
            return
        data = Path(self.install_dir)
        folder = data / "lib" / "semcal_ros"
        folder.mkdir(parents=True, exist_ok=True)
        for entry in self.distribution.entry_points["semcal_ros.nodes"]:
            node, _, target = entry.replace(" ", "").partition("=")
            module, _, function = target.partition(":")
            path = folder / node
            path.write_text(LAUNCHER.format(module=module, function=function), encoding="ascii")
            path.chmod(0o755)
            self.outfiles.append(str(path))


setuptools.setup(
    license="Apache-2.0",
    distclass=Distribution,
    cmdclass={"install_data": InstallData},
)
