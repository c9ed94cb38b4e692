"""Windows and macOS, as far as Linux can emulate them: what is not there, encodings, files that others hold open, new
processes. The package has run on neither."""

import ast
import json
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rfem_jax import load_study, whole_files
from rfem_jax.report.commands import folders
from rfem_jax.report.page.folder import folder_content
from rfem_jax.report.terminal import messages
from rfem_jax.whole_files import write_text

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "rfem_jax").rglob("*.py"))
STUDY = ROOT / "rfem_jax" / "report" / "starting_studies" / "slider_crank.toml"
# Modules that Windows does not have, and names that it has not in `os`.
OF_POSIX = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "posix")
NOT_IN_OS = (
    "geteuid", "getuid", "getgid", "fork", "forkpty", "killpg", "setsid", "sched_getaffinity", "O_DIRECTORY",
    "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "fchmod", "fchown", "chown", "uname", "statvfs", "getpgid", "sysconf",
)  # fmt: skip
# They ask whether there is such a name, or are called only where there is one.
KNOWS = {"compilation/cache.py", "compilation/keeping.py", "usable_cores.py"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_source(path):
    """What only POSIX has is neither imported by a module nor asked for outside of those that know."""
    tree, name = ast.parse(path.read_text(encoding="utf-8")), str(path.relative_to(ROOT / "rfem_jax").as_posix())
    for node in tree.body:
        imported = [one.name for one in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", "")]
        assert not set(imported) & set(OF_POSIX), f"{name}: {imported}"
    used = {node.attr for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "os"}  # fmt: skip
    assert name in KNOWS or not used & set(NOT_IN_OS), f"{name}: {used & set(NOT_IN_OS)}"


EMULATED = """
import os, sys
import jax, scipy.optimize, diffrax, xarray, matplotlib.figure, llvmlite.binding  # what others import may need them
for name in {names!r}:
    if hasattr(os, name):
        delattr(os, name)
for name in {modules!r}:
    sys.modules[name] = None
import ctypes.util
ctypes.util.find_library = lambda name: None  # of Windows, which has no libm of its own
sys.platform = "win32"
opened = os.open
def of_files(path, *rest, dir_fd=None, **words):
    assert dir_fd is None, "Windows has no descriptors of folders"
    if os.path.isdir(path):
        raise PermissionError(13, "Permission denied")
    return opened(path, *rest, **words)
os.open = of_files
from rfem_jax.report.command_line import main
sys.exit(max(main(arguments.split()) for arguments in sys.argv[1:]))
"""


def as_on_windows(folder, *commands):
    """Commands in a process whose system lacks what Windows has not, on a console of its code page."""
    code = EMULATED.format(names=NOT_IN_OS, modules=OF_POSIX[:6])
    settings = {"PYTHONIOENCODING": "cp1252:strict", "PYTHONUTF8": "0", "LC_ALL": "C", "JAX_PLATFORMS": "cpu"}
    folders = {"PYTHONPATH": str(ROOT), "HOME": str(folder), "LOCALAPPDATA": str(folder / "local")}
    environment = {**os.environ, **settings, **folders}
    environment.pop("RFEM_JAX_NO_CACHE", None)
    done = subprocess.run([sys.executable, "-c", code, *commands], cwd=folder, env=environment, capture_output=True)
    assert b"Traceback" not in done.stderr, done.stderr.decode("cp1252")
    return done


def titled(folder, title):
    """A study file with a title, in a folder."""
    text = STUDY.read_text(encoding="utf-8").replace("@NAME@", "x").replace("@FILE@", "x.toml")
    old = next(line for line in text.splitlines() if line.startswith("title"))
    (folder / "x.toml").write_text(text.replace(old, f'title = "{title}"'), encoding="utf-8")


@pytest.mark.slow
def test_commands_without_what_windows_lacks(tmp_path):
    """Letters that the console has not are printed by number; files are UTF-8 with the same ends of lines."""
    header = "name,kind,parent,child,x_m,y_m,z_m,axis_x,axis_y,axis_z,mass_kg,centre_x_m,centre_y_m,centre_z_m"
    body = "arm\u0394,body,,,,,,,,,1,0.1,0,0,1e-3,1e-3,1e-3"
    table = f"{header},xx_kgm2,yy_kgm2,zz_kgm2\n{body}\nA,hinge,base,arm\u0394,0,0,0,0,1,0\n"
    (tmp_path / "arm.csv").write_text(table, encoding="utf-8")
    done = as_on_windows(tmp_path, "init new.toml", "import arm.csv -o y.toml", "keys joints")
    assert done.returncode == 0, done.stderr
    assert rb"`arm\u0394` is called `arm_`" in done.stdout
    assert "`arm\u0394` is called" in (tmp_path / "y.toml").read_text(encoding="utf-8")
    assert all(b"\r" not in (tmp_path / name).read_bytes() for name in ("new.toml", "y.toml", "rfem_jax.schema.json"))


@pytest.mark.long
def test_a_run_without_what_windows_lacks(tmp_path):
    """Programs are not kept, since nobody says whose their folder is; all files are written."""
    titled(tmp_path, "Kurbel \u0394\u03c6 \u017b")
    commands = "check x.toml", "export x.toml --to frames -o x.csv", "run x.toml --out out --motion vtp gltf"
    done = as_on_windows(tmp_path, *commands)
    assert done.returncode == 0 and rb"Kurbel \u0394\u03c6 \u017b" in done.stdout, done.stderr
    results = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert results["compilation"]["kept_programs"] == "not used: this system does not say who owns a folder"
    for file in (tmp_path / "out").rglob("*.*"):
        if file.suffix in (".csv", ".json", ".html", ".vtp", ".pvd", ".gltf"):
            assert b"\r\n" not in file.read_bytes(), file
            file.read_text(encoding="utf-8")


def held(monkeypatch, times):
    """A system on which a file cannot be replaced `times` times, and the pauses that are made."""
    real, pauses, left = os.replace, [], [times]

    def replace(source, target):
        if left[0]:
            left[0] -= 1
            raise PermissionError(13, "The process cannot access the file because it is being used by another process")
        real(source, target)

    monkeypatch.setattr(whole_files, "HELD_WHILE_OPEN", True)
    monkeypatch.setattr(whole_files.os, "replace", replace)
    monkeypatch.setattr(whole_files.time, "sleep", pauses.append)
    return pauses


def test_a_file_that_a_scanner_holds_for_a_moment(tmp_path, monkeypatch):
    pauses = held(monkeypatch, 3)
    write_text(tmp_path / "x.csv", "a\nb\n")
    assert (tmp_path / "x.csv").read_bytes() == b"a\nb\n" and pauses == [0.05, 0.1, 0.2]


def test_a_file_that_a_spreadsheet_has_open(tmp_path, monkeypatch):
    """Refused in a sentence that says what to do; nothing unfinished stays."""
    held(monkeypatch, 100)
    with (
        pytest.raises(ValueError, match=r"close programs that have its files open") as found,
        folders.writing_into(tmp_path),
    ):
        write_text(tmp_path / "x.csv", "a")
    assert found.value.problems and list(tmp_path.iterdir()) == []


def test_elsewhere_a_file_that_cannot_be_replaced_is_told_at_once(tmp_path, monkeypatch):
    pauses = held(monkeypatch, 1)
    monkeypatch.setattr(whole_files, "HELD_WHILE_OPEN", False)
    with pytest.raises(PermissionError):
        write_text(tmp_path / "x.csv", "a")
    assert pauses == []


class Terminal:
    def isatty(self):
        return True


def test_the_old_console_of_windows_gets_no_codes_of_colours(monkeypatch):
    for name in ("NO_COLOR", "WT_SESSION", "ANSICON"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "")
    monkeypatch.setattr(messages.sys, "platform", "win32")
    assert messages.paint("x", "red", Terminal()) == "x"
    monkeypatch.setenv("WT_SESSION", "1")
    assert messages.paint("x", "red", Terminal()) == "\033[31mx\033[0m"
    monkeypatch.delenv("WT_SESSION")
    monkeypatch.setattr(messages.sys, "platform", "darwin")
    assert messages.paint("x", "red", Terminal()) == "\033[31mx\033[0m"


@pytest.mark.parametrize("name", ["C:case", "..\\case", "a/b", "C:\\case", "\\\\host\\case"])
def test_results_name_no_files_elsewhere(name, tmp_path, monkeypatch):
    """Also by drive letters and backslashes, which lead out of a folder on Windows alone."""
    content = {"title": "x", "cases": {name: {"status": "ok", "joints": {}}}}
    (tmp_path / "results.json").write_text(json.dumps(content), encoding="utf-8")
    read = []
    monkeypatch.setattr("rfem_jax.report.page.folder.read_table", lambda path: read.append(path))
    folder_content(tmp_path)
    assert read == []


def title_of(path):
    import jax

    jax.config.update("jax_enable_x64", True)
    return load_study(path).title


@pytest.mark.slow
def test_new_processes_that_begin_anew():
    """Windows and macOS start processes afresh: what they are given is pickled, the package is imported again."""
    study = ROOT / "studies" / "four_bar" / "study.toml"
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(title_of, (study,)) == load_study(study).title
