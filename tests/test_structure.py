"""The packages import one way only: report -> exchange -> validation, tolerancing -> simulation ->
mechanics -> compilation -> description; kernels import none of them.  None of them changes what is the user's, the
environment and JAX's settings, or uses what is JAX's own."""

import ast
import functools
import re
from pathlib import Path

import pytest

import rfem_jax
from tests.processes import in_a_new_process

ROOT = Path(__file__).parents[1]
PACKAGES = (
    "kernels",
    "description",
    "compilation",
    "mechanics",
    "simulation",
    "validation",
    "tolerancing",
    "exchange",
    "report",
)
FILES = sorted(path for path in (ROOT / "rfem_jax").rglob("*.py") if path.parent != ROOT / "rfem_jax")

BESIDE = (
    "task_kinds",
    "labelled_data",
    "lazy_names",
    "progress_line",
    "rich_text",
    "text_layout",
    "usable_cores",
    "whole_files",
)  # modules that all packages may import
READ_BESIDE = {"labelled_data": ("rich_text", "text_layout")}  # and those of them that one of them imports

NAME_OF_A_MODULE = re.compile(r"(rfem_jax(?:\.\w+)+)(?::\w+)?")
PUBLIC = {name: f"rfem_jax.{module}" for module, names in rfem_jax._names.items() for name in names.split()}
BY_STRINGS_OF_USERS = {"task_kinds.py", "lazy_names.py"}  # whose import_module has any argument
FORMER = {"simulation/outcome/run.py": "report_run"}  # names of a package above that methods of the version before call


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module", autouse=True)
def _forget_trees():
    """They are many objects, through which Python's garbage collector would go again and again."""
    yield
    tree_of.cache_clear()
    nodes_of.cache_clear()


@functools.cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree_of(path)))


def imported_modules(path: Path):
    """Names of all modules that a file imports: inside functions, by strings and by the package's public names, too."""
    former = FORMER.get(path.relative_to(ROOT / "rfem_jax").as_posix()) if path.is_relative_to(ROOT) else None
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            yield node.module
            if node.module == "rfem_jax":
                yield from (PUBLIC.get(alias.name, f"rfem_jax.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "rfem_jax" and node.attr != former:
            yield PUBLIC.get(node.attr, f"rfem_jax.{node.attr}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            named = NAME_OF_A_MODULE.fullmatch(node.value)
            if named and is_module(named[1]):
                yield named[1]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            yield from imported_by_call(node, path)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("import rfem_jax.report.contents.tables", {"rfem_jax.report.contents.tables"}),
        ("def f():\n    from rfem_jax.report.contents.tables import format_table", {"rfem_jax.report.contents.tables"}),
        ("from rfem_jax import report_run", {"rfem_jax", "rfem_jax.report.page.run_page"}),
        ("import rfem_jax\nrfem_jax.simulate()", {"rfem_jax", "rfem_jax.simulation"}),
        ('import_module("rfem_jax.report.contents.tables")', {"rfem_jax.report.contents.tables"}),
        ('A = "rfem_jax.report.contents.tables:format_table"', {"rfem_jax.report.contents.tables"}),
        ('A = "rfem_jax.schema.json"', set()),
    ],
)
def test_imports_are_seen(text, names, tmp_path):
    path = tmp_path / "module.py"
    path.write_text(text, encoding="utf-8")
    assert set(imported_modules(path)) == names


def test_imports_of_computed_names_are_seen_or_refused(tmp_path):
    path = tmp_path / "module.py"
    path.write_text("import_module(name)", encoding="utf-8")
    with pytest.raises(AssertionError, match="cannot read"):
        set(imported_modules(path))
    commands = ROOT / "rfem_jax" / "report" / "commands"
    assert module_name(commands / "init.py") in set(imported_modules(commands / "catalogue.py"))


def imported_by_call(call: ast.Call, path: Path):
    """Names of modules of the package that `import_module` may import: all of a package where a part of the name is
    computed.  Names that are plain strings are found as such."""
    argument = call.args[0]
    if path.name in BY_STRINGS_OF_USERS or isinstance(argument, ast.Constant):
        return
    beginning = argument.values[0] if isinstance(argument, ast.JoinedStr) else None
    of_its_package = isinstance(beginning, ast.FormattedValue) and ast.unparse(beginning.value) == "__package__"
    assert of_its_package, f"{path}:{call.lineno} imports what this test cannot read"
    yield from (module_name(one) for one in path.parent.glob("*.py") if one not in (path, path.parent / "__init__.py"))


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def package_of(path: Path) -> str:
    """The package of the pipeline that a file belongs to, in a sub-package or not."""
    return path.relative_to(ROOT / "rfem_jax").parts[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / "rfem_jax")))
def test_imports_run_one_way(path):
    level = PACKAGES.index(package_of(path))
    for name in imported_modules(path):
        parts = name.split(".")
        if parts[0] == "rfem_jax" and len(parts) > 1 and parts[1] not in BESIDE:
            assert PACKAGES.index(parts[1]) <= level, f"{path} imports {name}"


@pytest.mark.parametrize("name", BESIDE)
def test_what_stands_beside_the_packages_imports_none_of_them(name):
    imported = {one for one in imported_modules(ROOT / "rfem_jax" / f"{name}.py") if one.startswith("rfem_jax")}
    assert imported <= {f"rfem_jax.{one}" for one in READ_BESIDE.get(name, ())}


TEXTS = {"read_text", "write_text", "savetxt", "loadtxt", "genfromtxt"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / "rfem_jax")))
def test_texts_in_files_have_an_encoding(path):
    """That of the system is not UTF-8 everywhere, nor do its lines end with one character; `whole_files.write_text`
    knows both."""
    for node in nodes_of(path):
        if not isinstance(node, ast.Call):
            continue
        named = getattr(node.func, "attr", getattr(node.func, "id", ""))
        given = {keyword.arg for keyword in node.keywords}
        modes = [one.value for one in node.args[1:2] if isinstance(one, ast.Constant)]
        opened = named == "open" and not (isinstance(node.func, ast.Attribute) and ast.unparse(node.func) == "os.open")
        if isinstance(node.func, ast.Name) and named == "write_text":
            continue
        if named in TEXTS or (opened and not any("b" in str(mode) for mode in modes)):
            of_a_stream = named in ("loadtxt", "savetxt") and ast.unparse(node.args[0]) == "file"
            assert "encoding" in given or of_a_stream, f"{path}:{node.lineno}"
            written = named == "write_text" or (opened and any(set(str(mode)) & set("wax") for mode in modes))
            assert not written or given & {"newline", "closefd"}, f"{path}:{node.lineno}"


def imported_files(path: Path):
    """Names of all modules of this project that a file imports; `from package import module` names a module too."""
    yield from (name for name in imported_modules(path) if name.startswith("rfem_jax."))
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rfem_jax."):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.slow
def test_no_circles_of_files():
    imports = {
        "rfem_jax." + ".".join(p.relative_to(ROOT / "rfem_jax").with_suffix("").parts): set(imported_files(p))
        for p in FILES
        if p.name != "__init__.py"
    }
    done: set[str] = set()

    def visit(name, path):
        assert name not in path, f"circle: {' -> '.join([*path, name])}"
        if name in done or name not in imports:
            return
        for other in imports[name]:
            visit(other, [*path, name])
        done.add(name)

    for name in imports:
        visit(name, [])


def place_of(name: str) -> str:
    """The sub-package of a module, such as `mechanics.statics`, or the module itself where it is in none."""
    parts = name.split(".")[1:]
    return ".".join(parts[:2] if (ROOT / "rfem_jax" / "/".join(parts[:2])).is_dir() else parts)


@pytest.mark.slow
def test_no_circles_of_sub_packages():
    names = {"rfem_jax." + ".".join(p.relative_to(ROOT / "rfem_jax").with_suffix("").parts): p for p in FILES}
    names = {name: path for name, path in names.items() if path.name != "__init__.py"}
    imports: dict[str, set[str]] = {}
    for name, path in names.items():
        others = {place_of(other) for other in imported_files(path) if other in names}
        imports.setdefault(place_of(name), set()).update(others - {place_of(name)})
    rooms = {
        "description.mechanism",
        "mechanics.laws",
        "mechanics.implicit",
        "simulation.solvers",
        "tolerancing.problems",
    }
    assert rooms <= set(imports)
    while imports:
        free = [place for place, others in imports.items() if not others & set(imports)]
        assert free, f"circle among {sorted(imports)}"
        for place in free:
            del imports[place]


@pytest.mark.slow
def test_a_file_and_its_functions_have_different_names():
    for path in FILES:
        names = {node.name for node in tree_of(path).body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
        assert path.stem not in names, path


LONGEST_FUNCTION = 60


@pytest.mark.slow
def test_no_function_is_longer_than_a_page():
    for path in FILES:
        for node in nodes_of(path):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                length = node.end_lineno - node.lineno + 1
                assert length <= LONGEST_FUNCTION, f"{path}: {node.name} has {length} lines"


def test_public_names_exist():
    import rfem_jax

    for name in rfem_jax.__all__:
        assert getattr(rfem_jax, name) is not None


@pytest.mark.parametrize("folder", ["benchmarks", "studies"])
def test_a_test_runs_every_program_beside_the_library(folder):
    """Modules that such programs import are run with these."""
    tests = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests" / "programs").glob("*.py"))
    paths = sorted((ROOT / folder).rglob("*.py"))
    programs = [path for path in paths if '__name__ == "__main__"' in path.read_text(encoding="utf-8")]
    assert programs
    assert [path for path in programs if path.relative_to(ROOT).as_posix() not in tests] == []


ALL_FILES = sorted(
    path for folder in ("rfem_jax", "tests", "benchmarks", "studies") for path in (ROOT / folder).rglob("*.py")
)


def test_no_file_uses_the_inside_of_jax():
    """It changes without notice."""
    inside = ".".join(("jax", "_src"))
    assert len(ALL_FILES) > 500
    assert [path for path in ALL_FILES if inside in path.read_text(encoding="utf-8")] == []


def run_at_import(node: ast.AST):
    """All parts of a module that run when it is imported."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for one in (*child.decorator_list, child.args, *filter(None, [child.returns])):
                yield from run_at_import(one)
        elif not isinstance(child, ast.Lambda):
            yield child
            yield from run_at_import(child)


def changes_of_settings(path: Path) -> list[str]:
    """What a module does with the environment, but to read it, and with JAX's settings, when it is imported."""
    reading = ("get", "items", "copy")
    found = []
    for node in run_at_import(tree_of(path)):
        if isinstance(node, ast.Call):
            *whose, act = ast.unparse(node.func).split(".")
            of_environment = whose[-1:] == ["environ"] and act not in reading
            if of_environment or act in ("putenv", "unsetenv") or (whose[-1:] == ["config"] and act == "update"):
                found.append(ast.unparse(node))
        targets = getattr(node, "targets", None) or [getattr(node, "target", None)]
        found += [ast.unparse(node) for target in targets if target and "environ" in ast.unparse(target)]
    return found


@pytest.mark.parametrize("text", [
    'import os\nos.environ["A"] = "1"', 'import os\nif True:\n    os.environ.setdefault("A", "1")',
    'import os\ndel os.environ["A"]', 'import os\nos.environ |= {"A": "1"}',
    'class A:\n    jax.config.update("jax_enable_x64", True)', '@of(os.environ.pop("A"))\ndef function(): pass',
])  # fmt: skip
def test_changes_of_settings_are_seen(text, tmp_path):
    path, other = tmp_path / "module.py", tmp_path / "other.py"
    path.write_text(text, encoding="utf-8")
    assert len(changes_of_settings(path)) == 1
    other.write_text(
        f"import os\ndef function():\n    os.environ.clear()\nA = os.environ.get({text!r})", encoding="utf-8"
    )
    assert changes_of_settings(other) == []


@pytest.mark.slow
def test_no_module_changes_settings_when_it_is_imported():
    """The package changes none; tests do, but not the options of the compiler, which are those of users."""
    for path in ALL_FILES:
        if path.is_relative_to(ROOT / "rfem_jax"):
            assert changes_of_settings(path) == [], path
        if path.is_relative_to(ROOT / "tests"):
            assert not [change for change in changes_of_settings(path) if "XLA_FLAGS" in change], path


IMPORTED = """
import os
import jax
environment, settings = dict(os.environ), {name: repr(value) for name, value in jax.config.values.items()}
import rfem_jax
assert [getattr(rfem_jax, name) for name in rfem_jax.__all__]
assert dict(os.environ) == environment
assert {name: repr(value) for name, value in jax.config.values.items()} == settings
jax.config.update("jax_num_cpu_devices", 3)  # which no longer can be changed when JAX has looked for devices
print(len(jax.devices()))
"""


@pytest.mark.slow
def test_import_changes_nothing_and_starts_nothing():
    """Not even that of all its modules."""
    assert in_a_new_process(IMPORTED) == "3"
