"""Programs in processes of their own: XLA reads its options once."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def in_a_new_process(code, *arguments, flags=""):
    """What a program prints that starts with the given XLA_FLAGS."""
    answer = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.strip()
