"""What nobody reads ends no command: it does its work, and then says so by its exit code."""

import io
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rfem_jax.report import command_line
from rfem_jax.report.terminal.messages import ProgressLine

from .conftest import STUDY
from .test_command_line import packages  # noqa: F401

ROOT = Path(__file__).parents[2]
COMMAND = "import sys; from rfem_jax.report.command_line import main; sys.exit(main())"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": ""}
FAULTS = ("Traceback", "Error", "Exception", "ignored")


def run_unread(*arguments, both=False):
    """Exit code and standard error of the command with standard output (and error) that nobody reads."""
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments],
        stdout=writing, stderr=writing if both else subprocess.PIPE, text=True, env=ENVIRONMENT,
    )  # fmt: skip
    os.close(writing)
    _, errors = process.communicate(timeout=300)
    return process.returncode, errors


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("keys",), ("keys", "joints")])
def test_output_that_nobody_reads(arguments):
    code, errors = run_unread(*arguments)
    assert code == 1
    assert not [word for word in FAULTS if word in errors], errors  # the progress of the command may be there


def test_errors_that_nobody_reads():
    code, _ = run_unread("check", "there_is_no_such_file.toml", both=True)
    assert code in (1, 2)  # wrong input, if the line of progress before it has gone nowhere; no other, such as 120


@pytest.mark.slow
def test_a_command_that_prints_while_it_works(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    code, errors = run_unread("check", str(path))
    assert code == 1
    assert not [word for word in FAULTS if word in errors], errors


@pytest.mark.skipif(shutil.which("bash") is None, reason="a pipe of a shell")
def test_head():
    script = f'"{sys.executable}" -c "{COMMAND}" keys | head -n 1; echo "${{PIPESTATUS[0]}}"'
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=ENVIRONMENT, check=True)
    first, code = done.stdout.splitlines()
    assert first.strip() and not [word for word in FAULTS if word in done.stderr], done.stderr
    assert code in ("0", "1")  # as `head` is faster or not


class Unread(io.TextIOBase):
    """A stream of a pipe without a reader."""

    def write(self, text):
        raise BrokenPipeError(32, "Broken pipe")

    def flush(self):
        pass

    def isatty(self):
        return False


@pytest.mark.long
@pytest.mark.parametrize("command", ["run", "check"])
def test_it_is_no_folder_that_cannot_be_written(packages, study_file, tmp_path, monkeypatch, capsys, command):  # noqa: F811
    monkeypatch.setattr(sys, "stdout", Unread())
    options = ["--out", str(tmp_path / "out")] if command == "run" else []
    assert command_line.main([command, str(study_file), *options]) == 1
    assert "--out" not in capsys.readouterr().err
    if command == "run":
        assert (tmp_path / "out" / "results.json").exists() and (tmp_path / "out" / "P1.csv").exists()


def test_a_progress_line_that_nobody_reads_stops_no_work():
    with ProgressLine(Unread(), patience=0.0) as line:
        line("Working")
        line("Working", 0.5)
        line.clear()
