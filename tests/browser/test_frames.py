"""The benchmark of the page's script runs."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_script_time_of_a_frame(chromium, folder):
    command = [sys.executable, str(ROOT / "benchmarks" / "page_frames.py"), str(folder), "--seconds", "0.5"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows = re.findall(r"\| (.*) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", said)
    assert len(rows) == 2 and all(float(row[1]) > 1.0 and float(row[2]) > 0.0 for row in rows)
