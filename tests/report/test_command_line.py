"""The command: exit codes, one sentence per mistake, what is written; simulation replaced."""

import ast
import io
import json
import os
import signal
import stat
import subprocess
import sys
import time
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import rfem_jax

# The modules themselves serve beside the stand-ins for their packages.
import rfem_jax.mechanics.statics.designs
import rfem_jax.simulation.outcome.quantities
from rfem_jax import InputError, task_kinds
from rfem_jax.compilation import cache, keeping
from rfem_jax.compilation.cache import user_cache_folder
from rfem_jax.compilation.stages import listening, on_stage
from rfem_jax.report import command_line
from rfem_jax.report.command_line import build_parser, main
from rfem_jax.report.commands.catalogue import all_commands
from rfem_jax.report.drawings import pictures
from rfem_jax.report.terminal import console
from rfem_jax.report.terminal.messages import ProgressLine, paint, show
from rfem_jax.report.terminal.process import count_devices, require_platform

from .conftest import START

STATUS = {0: ("ok", "The run is complete."), 3: ("diverged", "The run diverged; reduce the step.")}


@pytest.fixture
def packages(monkeypatch, runs):
    """Stand-ins for mechanics and simulation; what they do can be changed by a test."""
    mechanics, simulation = ModuleType("mechanics"), ModuleType("simulation")
    counts = {"coordinates": 51, "constraints": 5, "rank": 5, "mobility": 46, "rigid_mobility": 1, "gap": 0.0}
    mechanics.discretise = lambda mechanism: SimpleNamespace(mechanism=mechanism)
    mechanics.describe = lambda model: SimpleNamespace(**counts, redundant=False, reactions="", idle=(), start=START)
    simulation.STATUS = STATUS
    simulation.check_step = lambda model, method, drive: 1.94e-5
    simulation.drive_limit = lambda model, drive, duration: None

    def run_cases(study, progress, keep):
        progress(1.0)
        return None, {case.name: runs[case.name] for case in study.cases}

    simulation.run_cases = run_cases
    monkeypatch.setitem(sys.modules, "rfem_jax.mechanics", mechanics)
    monkeypatch.setitem(sys.modules, "rfem_jax.simulation", simulation)
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    return SimpleNamespace(mechanics=mechanics, simulation=simulation)


def refuse(*_, **__):
    raise InputError("Argument `step` must be at most 1.9e-05 s, but is\n 1e-3 s; reduce it.")


def one_sentence(capsys):
    """The only line on standard error."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.long
def test_run_prints_and_writes_everything(packages, runs, study_file, tmp_path, capsys):
    out = tmp_path / "deep" / "results"
    assert main(["run", str(study_file), "--out", str(out)]) == 0
    names = {path.name for path in out.iterdir()}
    assert {"results.json", "P1.csv", "P2.csv", "P3.csv"} <= names
    assert {"angle.png", "assembly.png"} <= names
    captured = capsys.readouterr()
    assert "RMS resultant force, N" in captured.out
    assert "report.html" in names and "19 files written" in captured.out
    assert "Simulating 3 cases: 100 %" in captured.err


def test_pictures_can_be_left_out(packages, study_file, tmp_path, capsys, monkeypatch):
    """No process is started for them, and those that are there already are said to be older."""
    done = []
    monkeypatch.setattr(pictures, "draw_beside", lambda: done.append("process"))
    monkeypatch.setattr(pictures, "drawn", lambda write: done.append("drawn") or [])
    out = tmp_path / "out"
    with_pictures = ["run", str(study_file), "--out", str(out)]
    assert main([*with_pictures, "--no-pictures"]) == 0
    assert {path.name for path in out.iterdir()} == {"results.json", "P1.csv", "P2.csv", "P3.csv", "report.html"}
    assert "older" not in capsys.readouterr().err
    (out / "angle.png").write_bytes(b"older")
    assert main([*with_pictures, "--no-pictures"]) == 0
    assert f"Pictures in {out} are older than these results." in capsys.readouterr().err
    assert done == []
    assert main(with_pictures) == 0
    assert done == ["process", "drawn"] and "older" not in capsys.readouterr().err


def test_a_failed_case_is_exit_code_3_and_is_written(packages, runs, study_file, tmp_path, capsys):
    runs["P2"].status = 3
    assert main(["run", str(study_file), "--out", str(tmp_path), "--no-pictures"]) == 3
    assert '"status": "diverged"' in (tmp_path / "results.json").read_text(encoding="utf-8")
    assert (tmp_path / "P2.csv").exists()
    assert "Case P2: The run diverged; reduce the step." in capsys.readouterr().out


def test_check_prints_what_was_understood(packages, study_file, capsys):
    packages.simulation.run_cases = None
    assert main(["check", str(study_file)]) == 0
    text = capsys.readouterr().out
    assert "Test four-bar" in text
    assert "Coordinates: 51" in text
    assert "Cost\n  cases: 3 simulations of 50000 steps, computed together; results at 11 saved times" in text
    assert "Largest stable step of rk4: 1.94e-05 s." in text


def test_check_of_an_adaptive_method(packages, study_file, capsys):
    packages.simulation.check_step = lambda model, method, drive: None
    assert main(["check", str(study_file)]) == 0
    assert "Largest stable step of rk4: any, chosen by the method, or not known." in capsys.readouterr().out


@pytest.mark.parametrize("command", [["check"], ["run", "--out", "unused"]])
def test_a_step_that_is_too_large_is_refused(packages, study_file, command, capsys, monkeypatch):
    monkeypatch.chdir(study_file.parent)
    packages.simulation.check_step = refuse
    packages.simulation.run_cases = None
    assert main([*command, str(study_file)]) == 2
    assert one_sentence(capsys) == ("Argument `step` must be at most 1.9e-05 s, but is 1e-3 s; reduce it.")
    assert not Path("unused").exists()


def test_wrong_study_files(packages, study_file, tmp_path, capsys):
    assert main(["check", str(tmp_path / "missing.toml")]) == 2
    assert "missing.toml" in one_sentence(capsys)
    text = study_file.read_text(encoding="utf-8").replace("D.delta_x", "D.delta_q")
    study_file.write_text(text, encoding="utf-8")
    assert main(["check", str(study_file)]) == 2
    assert "D.delta_q" in one_sentence(capsys)


def test_every_mistake_of_a_study_file_is_a_line(packages, study_file, capsys):
    text = study_file.read_text(encoding="utf-8").replace("D.delta_x", "D.delta_q").replace("rfes = 5", "rfes = 0")
    study_file.write_text(text, encoding="utf-8")
    assert main(["check", str(study_file)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert ["D.delta_q" in line for line in lines] == [False, False, True]
    assert all("`rfes`" in line for line in lines[:2])


def test_a_folder_that_cannot_be_made_is_refused_before_simulating(packages, study_file, tmp_path, capsys):
    packages.simulation.run_cases = None
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert main(["run", str(study_file), "--out", str(tmp_path / "file" / "results")]) == 2
    assert "`--out` must be a folder" in one_sentence(capsys)


def test_a_full_disk_is_one_sentence(packages, study_file, tmp_path, capsys, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rfem_jax.report.contents.files.write_files", fail)
    assert main(["run", str(study_file), "--out", str(tmp_path)]) == 2
    assert "No space left on device" in capsys.readouterr().err.splitlines()[-1]


def test_an_interruption_is_130(packages, study_file, tmp_path, capsys):
    def interrupt(study, progress, keep):
        raise KeyboardInterrupt

    packages.simulation.run_cases = interrupt
    assert main(["run", str(study_file), "--out", str(tmp_path)]) == 130
    error = capsys.readouterr().err
    assert error.splitlines()[-1].startswith("Interrupted")
    assert "nothing was done yet; start the same command again" in error
    assert "Traceback" not in error


def test_what_no_folder_or_machine_is_is_refused_first(packages, study_file, tmp_path, capsys):
    packages.mechanics.discretise = None
    assert main(["run", str(study_file), "--out", ""]) == 2
    assert "`--out` must name a folder" in one_sentence(capsys)
    assert main(["run", str(study_file), "--out", str(tmp_path), "--devices", "100000"]) == 2
    assert "`--devices` must be at most" in one_sentence(capsys)
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert main(["run", str(study_file), "--out", str(tmp_path / "file" / "results")]) == 2
    assert "`--out` must be a folder" in one_sentence(capsys)


def test_what_is_wrong_with_the_mechanism_is_said_with_the_file(packages, study_file, tmp_path, capsys, monkeypatch):
    designs = ModuleType("designs")
    designs.model_of_study = refuse
    monkeypatch.setitem(sys.modules, "rfem_jax.mechanics.statics.designs", designs)
    for command in (["check", str(study_file)], ["run", str(study_file), "--out", str(tmp_path)]):
        assert main(command) == 2
        assert str(study_file) in one_sentence(capsys)


def test_a_platform_that_is_not_there_is_one_sentence(monkeypatch):
    def missing():
        raise AssertionError

    monkeypatch.setattr("jax.devices", missing)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(InputError, match="JAX_PLATFORMS must name .* 'cuda'"):
        require_platform()


def test_keys_prints_the_reference(packages, capsys):
    assert main(["keys"]) == 0
    text = capsys.readouterr().out
    for word in ("[[mechanism.joints]]", "[allocation.cost]", "child_position", "needed", "0.01, 0.05, 0.5"):
        assert word in text
    assert max(map(len, text.splitlines())) <= 120
    assert main(["keys", "cases"]) == 0
    assert capsys.readouterr().out.startswith("[[cases]]\n---------\n  name    needed  letters")
    assert main(["keys", "plots"]) == 2
    assert "`plots` is in none of them" in one_sentence(capsys)


def test_keys_prints_all_metrics(packages, capsys):
    assert main(["keys", "metrics"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 120
    lines = {line.split()[0]: line for line in text.splitlines() if line.startswith("  ")}
    assert lines["max_force"].split()[1] == "N" and "theory (8.6)" in lines["max_force"]
    assert "lower bound of the maximum" in lines["peak_force"]
    code, found, _ = answer_of(capsys, "keys", "metrics")
    assert code == 0 and "max_moment" in [row["name"] for row in found["metrics"][0]["rows"]]
    assert main(["keys", "max_"]) == 0
    text = capsys.readouterr().out
    assert "max_axial_force" in text and "max_stress" in text and "rms_force" not in text
    assert main(["keys", "metrisc"]) == 2
    assert "did you mean `metrics`?" in one_sentence(capsys)


def test_version(capsys):
    assert main(["--version"]) == 0
    specified = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert capsys.readouterr().out == f"rfem-jax {specified['project']['version']}\n"


def test_a_fault_of_the_program_is_not_hidden(packages, study_file):
    packages.simulation.check_step = lambda model, method, drive: 1 / 0
    with pytest.raises(ZeroDivisionError):
        main(["check", str(study_file)])


@pytest.mark.parametrize("arguments", [[], ["simulate"], ["run", "study.toml"], ["check"], ["check", "a", "--fast"]])
def test_a_wrong_call_is_one_sentence(arguments, capsys):
    assert main(arguments) == 2
    assert "--help" in one_sentence(capsys)


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["check", "--help"], ["keys", "--help"]])
def test_help(arguments, capsys):
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: rfem-jax")
    assert "run" in arguments or "--out" not in text


def test_without_matplotlib_the_rest_is_written(packages, study_file, tmp_path, capsys, monkeypatch):
    out = tmp_path / "results"
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["run", str(study_file), "--out", str(out)]) == 0
    names = sorted(path.name for path in out.iterdir())
    assert names == ["P1.csv", "P2.csv", "P3.csv", "report.html", "results.json"]
    assert 'pip install "rfem_jax[plots]"' in capsys.readouterr().out


COMMANDS = Path(rfem_jax.__file__).parent / "report" / "commands"
LIGHT = {
    "report.contents.annotations",
    *("report.terminal.console", "report.terminal.process", "report.terminal.messages", "task_kinds"),
}
LIGHT |= {"progress_line", "usable_cores"}
LIGHT |= {f"report.commands.{path.stem}" for path in COMMANDS.glob("*.py") if path.stem != "__init__"}


@pytest.mark.parametrize("module", ["report.command_line", *sorted(LIGHT)])
def test_the_command_imports_nothing_heavy_at_its_top(module):
    path = Path(rfem_jax.__file__).parent / f"{module.replace('.', '/')}.py"
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module.removeprefix("rfem_jax.") not in LIGHT:
            names.add(node.module.split(".")[0])
    assert names <= set(sys.stdlib_module_names)


def test_every_file_of_a_command_is_in_the_list():
    shared = {"__init__", "catalogue", "command", "folders", "steps", "tasks"}
    assert {path.stem.replace("_", "-") for path in COMMANDS.glob("*.py") if path.stem not in shared} == set(
        task_kinds.COMMANDS
    )
    commands = all_commands()
    of_tasks = [kind.command for kind in task_kinds.task_kinds().values()]
    assert [one.name for one in commands][: 2 + len(of_tasks)] == ["init", "run", *of_tasks]
    assert all(one.purpose and one.description.endswith(".") for one in commands)


def answer_of(capsys, *arguments):
    """Exit code, document on standard output, standard error."""
    code = main([*arguments, "--json"])
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert (found["command"], found["exit_code"]) == (arguments[0], code)
    return code, found, captured.err


@pytest.mark.long
def test_an_answer_for_machines(packages, runs, study_file, tmp_path, capsys):
    """One document and nothing else on standard output, of every command."""
    runs["P2"].status = 3
    code, found, said = answer_of(capsys, "run", str(study_file), "--out", str(tmp_path / "out"))
    assert (code, found["problems"], found["folder"]) == (3, [], str(tmp_path / "out"))
    assert found["results.json"] == json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert len(found["files"]) == 19 and all(Path(one).exists() for one in found["files"])
    assert "Simulating 3 cases: 100 %" in said
    code, found, _ = answer_of(capsys, "check", str(study_file))
    assert (code, found["structure"]["mobility"], found["largest_stable_step"]) == (0, 46, 1.94e-5)
    assert found["cases"]["P3"] == {"D.d_y": 5e-4, "coupler.length": -1e-4}
    code, found, said = answer_of(capsys, "keys", "cases")
    assert (code, said, [one["header"] for one in found["tables"]]) == (0, "", ["[[cases]]"])
    code, found, said = answer_of(capsys, "check", str(tmp_path / "missing.toml"))
    assert code == 2 and "missing.toml" in found["problems"][0] and said == found["problems"][0] + "\n"


def test_quiet(packages, study_file, tmp_path, capsys):
    assert main(["run", str(study_file), "--out", str(tmp_path / "out"), "--no-pictures", "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.err == "" and "RMS resultant force, N" in captured.out
    assert main(["run", str(study_file), "--out", str(tmp_path / "out"), "--no-pictures", "--quiet", "--json"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["check", str(tmp_path / "missing.toml"), "--quiet"]) == 2
    assert "missing.toml" in one_sentence(capsys)


def settings_in_a_new_process(tmp_path, arguments="", **environment):
    """Double precision and cache folder that `set_up_jax` leaves behind."""
    code = (
        "from rfem_jax.report.terminal.process import set_up_jax; import jax; "
        f"set_up_jax({arguments}); "
        "print(jax.config.jax_enable_x64, jax.config.jax_compilation_cache_dir)"
    )
    base = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "RFEM_JAX_NO"))}
    homes = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"), str(tmp_path))
    answer = subprocess.run(
        [sys.executable, "-c", code],
        env={**base, **homes, **environment, "JAX_PLATFORMS": "cpu"},
        cwd=Path(command_line.__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    return answer.stdout.split()


@pytest.mark.long
def test_jax_is_set_up_with_a_cache_in_the_users_folder(tmp_path):
    double, folder = settings_in_a_new_process(tmp_path)
    assert double == "True"
    assert Path(folder).is_relative_to(tmp_path)
    for made in (Path(folder), Path(folder).parent):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700
    assert settings_in_a_new_process(tmp_path, RFEM_JAX_NO_CACHE="1")[1] == "None"


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """The user's cache folder, of this test alone."""
    monkeypatch.setattr(keeping, "user_cache_folder", lambda: tmp_path / "rfem_jax")
    monkeypatch.delenv("RFEM_JAX_NO_CACHE", raising=False)
    return tmp_path / "rfem_jax"


def test_the_cache_of_jax_is_guarded_as_kept_programs_are(own_cache, monkeypatch):
    assert keeping.folder_for_jax() == own_cache / "jax"
    (own_cache / "jax").chmod(0o755)
    assert keeping.folder_for_jax() is None
    (own_cache / "jax").chmod(0o700)
    own_cache.chmod(0o777)  # another user could put another folder in its place
    assert keeping.folder_for_jax() is None
    own_cache.chmod(0o700)
    assert keeping.folder_for_jax() is not None
    (own_cache / "jax").rename(own_cache / "elsewhere")
    (own_cache / "jax").symlink_to(own_cache / "elsewhere")
    assert keeping.folder_for_jax() is None
    (own_cache / "jax").unlink()
    own_cache.chmod(0o500)  # nothing can be made there, but by root
    assert keeping.folder_for_jax() is None or os.geteuid() == 0
    own_cache.chmod(0o700)


def test_the_cache_of_jax_does_not_grow_without_end(own_cache, monkeypatch):
    folder = keeping.folder_for_jax()
    for number in range(5):
        file = folder / f"program_{number}-cache"
        file.write_bytes(bytes(1000))
        os.utime(file, (1e9 + number,) * 2)
    (folder / "folder_of_XLA").mkdir()
    monkeypatch.setattr(cache, "LIMIT", 2500)
    assert keeping.folder_for_jax() == folder
    assert {one.name for one in folder.iterdir()} == {"program_3-cache", "program_4-cache", "folder_of_XLA"}


def test_the_user_can_choose_the_cache(tmp_path):
    chosen = str(tmp_path / "chosen")
    assert settings_in_a_new_process(tmp_path, JAX_COMPILATION_CACHE_DIR=chosen)[1] == chosen


def test_the_cache_folder_is_the_platforms(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere/cache")
    assert user_cache_folder() == Path("/somewhere/cache/rfem_jax")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert user_cache_folder() == Path.home() / ".cache" / "rfem_jax"


def test_progress_in_a_log_is_a_line_per_quarter():
    stream = io.StringIO()
    with ProgressLine(stream, patience=1e9) as line:
        for percent in (0, 10, 26, 30, 24, 99, 100, 100):
            line("Simulating", percent / 100.0)
    lines = stream.getvalue().splitlines()
    assert [line.split()[:2] for line in lines] == [["Simulating:", n] for n in ("26", "99", "100")]
    assert "s remaining" in lines[0] and "remaining" not in lines[-1]


def test_a_stage_that_takes_a_moment_is_a_line_in_a_log():
    stream = io.StringIO()
    with ProgressLine(stream, patience=0.01) as line:
        line("Tracing")
        while "Tracing" not in stream.getvalue():
            time.sleep(0.001)
        line("Compiling")
        while "Compiling" not in stream.getvalue():
            time.sleep(0.001)
    assert stream.getvalue() == "Tracing ...\nCompiling ...\n"


def test_progress_on_a_terminal_rewrites_its_line(monkeypatch):
    """What is printed takes the place of the line; at the end nothing of it is left."""
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stdout", terminal)
    with ProgressLine(terminal) as line:
        line("Compiling the simulation")
        line("Simulating", 0.5)
        show("a result")
        line("Simulating", 0.75)
    assert "50 %" in terminal.getvalue() and "75 %" in terminal.getvalue()
    assert seen_on_a_terminal(terminal.getvalue()) == ["a result", ""]


def seen_on_a_terminal(text):
    """Lines that stand there in the end."""
    lines = []
    for written in text.split("\n"):
        shown = ""
        for part in written.split("\r"):
            shown = part + shown[len(part) :]
        lines.append(shown.rstrip())
    return lines


@pytest.fixture
def own_signals():
    """What a process that is a command does with Ctrl-C is undone."""
    before = signal.getsignal(signal.SIGINT)
    yield
    console.work_begins()
    signal.signal(signal.SIGINT, before)


def test_the_command_ends_without_looking_for_garbage(monkeypatch, own_signals):
    asked = []
    monkeypatch.setattr(command_line, "main", lambda: 3)
    monkeypatch.setattr(command_line.gc, "freeze", lambda: asked.append("freeze"))
    (script,) = entry_points(group="console_scripts", name="rfem-jax")
    assert script.load()() == 3 and asked == ["freeze"]


@pytest.mark.long
def test_a_check_loads_what_it_needs(tmp_path):
    """Integrators, optimisers, statistics and pictures take longer to import than the check itself."""
    study = Path(__file__).parents[2] / "studies" / "four_bar" / "study.toml"
    program = (
        "import sys\n"
        "from rfem_jax.report.command_line import main\n"
        f"assert main(['check', {str(study)!r}]) == 0\n"
        "print([name for name in sys.argv[1:] if name in sys.modules])\n"
    )
    names = ["diffrax", "optimistix", "lineax", "scipy.interpolate", "scipy.stats", "matplotlib"]
    done = subprocess.run(
        [sys.executable, "-c", program, *names], capture_output=True, text=True, check=True,
        cwd=tmp_path, env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)},
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "[]"
    assert "Largest stable step of rk4: 1.94e-05 s." in done.stdout


def test_colours_are_for_terminals(monkeypatch):
    terminal, file = io.StringIO(), io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert paint("wrong", "red", terminal) == "\033[31mwrong\033[0m"
    assert paint("wrong", "red", file) == "wrong"
    monkeypatch.setenv("NO_COLOR", "1")
    assert paint("wrong", "red", terminal) == "wrong"
    monkeypatch.setenv("NO_COLOR", "")
    monkeypatch.setenv("TERM", "dumb")
    assert paint("wrong", "red", terminal) == "wrong"


def test_stages_reach_listeners_and_only_while_they_listen():
    heard = []
    with listening(lambda *told: heard.append(told)):
        on_stage("Tracing")
        on_stage("Simulating", 0.5)
    on_stage("Compiling")
    assert heard == [("Tracing", None), ("Simulating", 0.5)]


def test_the_first_word_comes_before_anything_is_imported(tmp_path):
    """JAX is not loaded when the command says that it has started."""
    program = (
        "import sys\n"
        "from rfem_jax.report import command_line\n"
        "def said(self, *_): print('jax' in sys.modules); raise KeyboardInterrupt\n"
        "command_line.ProgressLine.__call__ = said\n"
        "command_line.main(['check', 'study.toml'])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout == "False\n"


def test_a_check_compiles_what_a_run_takes():
    """A kept program serves processes of as many devices."""
    arguments = [build_parser().parse_args(line) for line in (["check", "x.toml"], ["run", "x.toml", "--out", "out"])]
    checked, ran = map(count_devices, arguments)
    assert checked == ran and checked >= 1
    assert count_devices(build_parser().parse_args(["validate"])) is None
