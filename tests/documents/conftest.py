"""Code in documents: asked for by the name of this folder, as in `python -m pytest -n0 tests/documents`."""

import shutil
import tomllib

import pytest

from tests.programs.test_study_files import ROOT, STUDIES, reduced, to_toml

# Second derivatives of a four-bar take minutes to compile: these are asked of a double pendulum.
DOUBLE_PENDULUM = ("tolerance_sensitivity", "tolerance_allocation")


@pytest.fixture(scope="session")
def workplace(tmp_path_factory):
    """A folder like that of the repository, whose studies are small."""
    folder = tmp_path_factory.mktemp("workplace")
    for path in sorted(STUDIES.rglob("*.toml")):
        name = path.relative_to(STUDIES).as_posix()
        target = folder / "studies" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(reduced(name, pendulum=name.startswith(DOUBLE_PENDULUM)), encoding="utf-8")
    shutil.copy(ROOT / "README.md", folder)
    return folder


@pytest.fixture
def in_workplace(workplace, monkeypatch):
    """The working directory is the workplace; commands take the process as it is, and keep no programs."""
    monkeypatch.chdir(workplace)
    monkeypatch.setattr("rfem_jax.report.command_line.set_up_jax", lambda *arguments: None)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return workplace


def merged(study, fragment):
    """A study's content with the tables of a fragment in the place of its own, within the mechanism, too."""
    mechanism = {**study["mechanism"], **fragment.get("mechanism", {})}
    return {**study, **fragment, "mechanism": mechanism}


@pytest.fixture
def load_with(workplace, tmp_path):
    """Load the four-bar with a fragment of a study file."""
    from rfem_jax import load_study

    def load(text):
        study = tomllib.loads((workplace / "studies/four_bar/study.toml").read_text(encoding="utf-8"))
        content = merged(study, tomllib.loads(text))
        path = tmp_path / "fragment.toml"
        path.write_text("\n".join(f"{key} = {to_toml(value)}" for key, value in content.items()), encoding="utf-8")
        return load_study(path)

    return load
