"""Programs in processes of their own, to which nothing is known and for which nothing was set."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def path_without_matplotlib(folder):
    """PYTHONPATH of a process that finds this repository, and no matplotlib: for commands whose pictures are not the
    subject.  `folder` is empty or not there."""
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text('import sys\n\nsys.modules["matplotlib"] = None\n', encoding="utf-8")
    return os.pathsep.join([str(folder), str(ROOT)])


def in_a_new_process(code, *arguments, timeout=None):
    """What a program prints that starts with the compiler's options as XLA has them, and ends within `timeout` [s]."""
    # Tracing makes lasting objects, and to look through them for garbage takes long.
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    answer = subprocess.run(
        [sys.executable, "-c", f"import gc\ngc.disable()\n{code}", *arguments],
        env={**environment, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        cwd=ROOT, capture_output=True, text=True, timeout=timeout,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.strip()
