"""Streams that lack characters or are not there, and Ctrl-C while nothing is done: no result is lost, nothing is said
but one sentence."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rfem_jax.report import command_line
from rfem_jax.report.terminal import console
from rfem_jax.report.terminal.messages import show

from .conftest import STUDY
from .test_command_line import packages  # noqa: F401

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
TITLE = "Größe Δ\N{SLIGHTLY SMILING FACE}"


@pytest.fixture
def titled(tmp_path):
    path = tmp_path / "study.toml"
    old = next(line for line in STUDY.splitlines() if line.startswith("title"))
    path.write_text(STUDY.replace(old, f'title = "{TITLE}"'), encoding="utf-8")
    return path


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_characters_that_the_console_lacks_are_printed_by_number(packages, titled, tmp_path, monkeypatch, encoding):  # noqa: F811
    printed = io.BytesIO()
    stream = io.TextIOWrapper(printed, encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    assert command_line.main(["run", str(titled), "--out", str(tmp_path / "out"), "--no-pictures"]) == 0
    assert stream.errors == "strict"  # as before
    first = printed.getvalue().decode(encoding).splitlines()[0]
    assert first == TITLE.encode(encoding, "backslashreplace").decode(encoding)
    assert json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["title"] == TITLE


def test_a_process_without_streams(packages, study_file, tmp_path, monkeypatch):  # noqa: F811
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert command_line.main(["run", str(study_file), "--out", str(tmp_path / "out"), "--no-pictures"]) == 0
    assert sys.stdout is None
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.skipif(os.name == "nt", reason="shells of POSIX")
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_files_do_not_take_the_place_of_closed_streams(tmp_path, closed):
    """The next file that is opened has the smallest number that is free: that of standard output, say."""
    code = "from rfem_jax.report.terminal.console import *; open_closed_streams(); file = open('file', 'w'); "
    code += "print(sys.stdout.encoding); print('x', file=sys.stderr); sys.exit(file.fileno() < 3)"
    done = subprocess.run(
        ["sh", "-c", f'"{sys.executable}" -c "import os, sys; {code}" {closed}'],
        cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "file").read_text(encoding="utf-8") == ""
    assert ("x" in done.stderr) == ("2>" not in closed)


def test_a_full_disk_behind_standard_output_ends_no_command(monkeypatch):
    class Full(io.StringIO):
        def write(self, text):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    monkeypatch.setattr(console.Reading, "ends", False)
    show("text")
    assert console.Reading.ends and not console.flush()


INTERRUPTED = """
import signal, sys
module, lost, *arguments = sys.argv[1:]

class Interrupting:
    def find_spec(self, name, path, target=None):
        if name == module:
            sys.meta_path.remove(self)
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:  # a library's extension may lose it
                if lost == "no":
                    raise

sys.meta_path.insert(0, Interrupting())
import rfem_jax_command
sys.argv = ["rfem-jax", *arguments]
sys.exit(rfem_jax_command.run())
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "lost", "options"),
    [
        ("rfem_jax", "no", []),
        ("rfem_jax.report.commands.turn", "yes", []),
        ("jax", "yes", ["--json"]),
        ("rfem_jax.mechanics", "yes", []),
    ],
)
def test_ctrl_c_while_something_is_imported(titled, module, lost, options):
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, module, lost, "check", str(titled), *options],
        env=ENVIRONMENT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 130, done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.endswith("...")]  # those of the progress
    assert lines == ["Interrupted: nothing was done yet; start the same command again."]
    document = {"command": "check", "exit_code": 130, "problems": lines}
    assert (json.loads(done.stdout) if options else {}) == (document if options else {})
