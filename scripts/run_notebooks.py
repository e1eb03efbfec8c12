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

"""Run the notebooks of the tutorials, and keep their outputs in them: ``python scripts/run_notebooks.py``.

The tests run them, too, and compare what they print with what is kept. A notebook runs in a process and a folder of its
own, with the commands of the environment of this script.

The cells are run by IPython alone. A Jupyter kernel (ipykernel, nbclient, nbformat) would do the same with 12 more
packages in the environment of the tests, and a socket between them.
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from IPython.core.interactiveshell import InteractiveShell
from IPython.display import display
from IPython.utils.capture import capture_output

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "doc" / "tutorials").glob("*.ipynb"))
# A calibration takes seconds; a busy machine several times that.
NOTEBOOK_S = 170


def read_notebook(path: Path) -> dict[str, Any]:
    """Return a notebook (nbformat 4), which is JSON."""
    notebook: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return notebook


def write_notebook(notebook: dict[str, Any], path: Path) -> None:
    """Write a notebook as Jupyter does: one line of source in one line of the file."""
    text = json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True)
    path.write_text(f"{text}\n", encoding="utf-8")


def run_notebook(path: Path, folder: Path, but: str = "") -> dict[str, Any]:
    """Return the notebook with the outputs of a run in ``folder``; cells that begin with ``but`` keep theirs.

    Raises
    ------
    RuntimeError
        A cell fails; with its traceback.
    """
    commands = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = {
        **os.environ,
        "PATH": commands,
        "PYTHONPATH": str(ROOT),
        # Not the settings and the history of whoever runs this.
        "IPYTHONDIR": str(folder),
        # What `%matplotlib inline` chooses, which a notebook does by itself.
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    }
    done = subprocess.run(
        [sys.executable, str(Path(__file__).resolve()), str(path.resolve()), "done.ipynb", but],
        cwd=folder,
        env=environment,
        timeout=NOTEBOOK_S,
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{path.name}:\n{done.stderr}")
    return read_notebook(folder / "done.ipynb")


def execute_here(notebook: dict[str, Any], but: str) -> None:
    """Run the cells of a notebook in this process, and replace their outputs; not those that begin with ``but``.

    Raises
    ------
    Exception
        Whatever a cell raises.
    """
    shell = InteractiveShell.instance()
    # A last expression is displayed as plt.show() is; without a front end it would be printed.
    shell.display_trap.hook = _display
    for count, cell in enumerate((c for c in notebook["cells"] if c["cell_type"] == "code"), 1):
        source = "".join(cell["source"])
        if but and source.startswith(but):
            continue
        with capture_output() as captured:
            result = shell.run_cell(source, store_history=True)
        result.raise_error()
        cell["execution_count"] = count
        cell["outputs"] = _outputs(captured)


def _display(value: Any) -> None:
    if value is not None:
        display(value)


def _outputs(captured: Any) -> list[dict[str, Any]]:
    """What a cell printed and drew, as a notebook keeps it."""
    found: list[dict[str, Any]] = []
    for name, text in (("stdout", captured.stdout), ("stderr", captured.stderr)):
        if text:
            # A command ends its lines as a terminal does.
            lines = text.replace("\r\n", "\n").splitlines(keepends=True)
            found.append({"name": name, "output_type": "stream", "text": lines})
    for output in captured.outputs:
        data = {kind: _lines(value) for kind, value in output.data.items()}
        found.append({"data": data, "metadata": {}, "output_type": "display_data"})
    return found


def _lines(value: Any) -> Any:
    if isinstance(value, bytes):
        value = base64.b64encode(value).decode("ascii")
    return value if "\n" not in value else value.splitlines(keepends=True)


def main() -> None:
    if len(sys.argv) == 4:
        source, target, but = sys.argv[1:]
        notebook = read_notebook(Path(source))
        execute_here(notebook, but)
        write_notebook(notebook, Path(target))
        return
    for path in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            write_notebook(run_notebook(path, Path(folder)), path)
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
