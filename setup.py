"""Build of the ament_python package, for colcon and for pip.

colcon calls the commands ``install`` or ``develop``, and ``setup.cfg`` sends every executable to
``lib/semcal_ros``. pip builds a wheel and would put them all on the PATH; a wheel therefore
declares only the command ``semcal`` and carries the nodes as launchers in ``lib/semcal_ros``, so
that the ament index describes a Python environment and a workspace in the same way.
"""

from __future__ import annotations

import sys
from pathlib import Path

from setuptools import Distribution, find_packages, setup

from distutils.command.install_data import install_data  # isort: skip  # setuptools' own copy

NAME = "semcal_ros"
VERSION = "0.1.0"
NODES = (
    "bag_player",
    "calibration_server",
    "drift_compensator",
    "parameter_server",
    "rectifier",
    "stream_corrector",
    "virtual_sem",
    "visual_servo",
)
RUNTIME = (
    "click>=8.1",
    "jinja2>=3.0",
    "joblib>=1.3",
    "jsonschema>=4.10",
    "matplotlib>=3.6",
    "numpy>=1.26",
    "opencv-python-headless>=4.8",
    "pydantic>=2.6",
    "pyyaml>=6.0",
    "rosbags>=0.11.7",
    "scipy>=1.11",
    "tifffile>=2023.2.3",
    "tqdm>=4.64",
    "trimesh>=5.2",
)
FOR_PIP = not {"install", "develop"} & set(sys.argv[1:])

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
    from semcal_ros.nodes.{node} import main

    sys.exit(main())
"""


class InstallData(install_data):
    """Adds to a wheel what colcon provides by itself."""

    def run(self) -> None:
        super().run()
        if not FOR_PIP:
            return
        data = Path(self.install_dir)
        folder = data / "lib" / NAME
        folder.mkdir(parents=True, exist_ok=True)
        for node in NODES:
            path = folder / node
            path.write_text(LAUNCHER.format(node=node), encoding="ascii")
            path.chmod(0o755)
            self.outfiles.append(str(path))


class WithData(Distribution):
    """Lets an editable install take the data files too: setuptools asks for ``has_data``."""

    def has_data(self) -> bool:
        return self.has_data_files()


def shared(folder: str) -> tuple[str, list[str]]:
    """A folder of the source tree as data files below ``share/semcal_ros``."""
    files = sorted(str(path) for path in Path(folder).glob("*") if path.is_file())
    return f"share/{NAME}/{folder}", files


node_scripts = [f"{node} = {NAME}.nodes.{node}:main" for node in NODES]

setup(
    name=NAME,
    version=VERSION,
    description="Magnification-continuous calibration and live correction of SEM image streams",
    license="Apache-2.0",
    maintainer="semcal_ros maintainers",
    maintainer_email="semcal-ros@users.noreply.github.com",
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={"": ["*.json", "py.typed"], f"{NAME}.report": ["templates/*.j2"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        shared("launch"),
        shared("msg_configs"),
        shared("dds"),
        shared("security"),
    ],
    install_requires=list(RUNTIME) if FOR_PIP else ["setuptools"],
    zip_safe=False,
    entry_points={
        "console_scripts": [f"semcal = {NAME}.cli:main", *([] if FOR_PIP else node_scripts)],
    },
    distclass=WithData,
    cmdclass={"install_data": InstallData},
)
