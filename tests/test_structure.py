"""The packages import one way only: report -> validation, tolerancing -> simulation ->
mechanics -> compilation -> description; kernels import none of them."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("kernels", "description", "compilation", "mechanics", "simulation", "validation", "tolerancing", "report")
FILES = sorted(path for path in (ROOT / "rfem_jax").rglob("*.py") if path.parent != ROOT / "rfem_jax")

BESIDE = (
    "task_kinds",
    "labelled_data",
    "lazy_names",
    "rich_text",
    "stack_room",
    "text_layout",
    "usable_cores",
    "whole_files",
)  # modules that all packages may import


def imported_modules(path: Path):
    """Names of all modules that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            yield node.module


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
    assert not [one for one in imported_modules(ROOT / "rfem_jax" / f"{name}.py") if one.startswith("rfem_jax")]


TEXTS = {"read_text", "write_text", "savetxt", "loadtxt", "genfromtxt"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT / "rfem_jax")))
def test_texts_in_files_have_an_encoding(path):
    """That of the system is not UTF-8 everywhere."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        named = getattr(node.func, "attr", getattr(node.func, "id", ""))
        given = {keyword.arg for keyword in node.keywords}
        modes = [one.value for one in node.args[1:2] if isinstance(one, ast.Constant)]
        opened = named == "open" and not (isinstance(node.func, ast.Attribute) and ast.unparse(node.func) == "os.open")
        if named in TEXTS or (opened and not any("b" in str(mode) for mode in modes)):
            of_a_stream = named == "loadtxt" and ast.unparse(node.args[0]) == "file"
            assert "encoding" in given or of_a_stream, f"{path}:{node.lineno}"


def imported_files(path: Path):
    """Names of all modules of this project that a file imports; `from package import module` names a module too."""
    yield from (name for name in imported_modules(path) if name.startswith("rfem_jax."))
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rfem_jax."):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


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


def test_no_circles_of_sub_packages():
    names = {"rfem_jax." + ".".join(p.relative_to(ROOT / "rfem_jax").with_suffix("").parts): p for p in FILES}
    names = {name: path for name, path in names.items() if path.name != "__init__.py"}
    imports: dict[str, set[str]] = {}
    for name, path in names.items():
        others = {place_of(other) for other in imported_files(path) if other in names}
        imports.setdefault(place_of(name), set()).update(others - {place_of(name)})
    assert {"mechanics.implicit", "simulation.solvers", "tolerancing.problems"} <= set(imports)
    while imports:
        free = [place for place, others in imports.items() if not others & set(imports)]
        assert free, f"circle among {sorted(imports)}"
        for place in free:
            del imports[place]


def test_a_file_and_its_functions_have_different_names():
    for path in FILES:
        names = {
            node.name for node in ast.parse(path.read_text()).body if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        }
        assert path.stem not in names, path


LONGEST_FUNCTION = 60


def test_no_function_is_longer_than_a_page():
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
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
