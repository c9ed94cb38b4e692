"""The JSON Schema of study files: all studies keep it, and mistakes are found where they are."""

import copy
import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.study_file.key_reference import key_tables
from rfem_jax.description.study_file.schema import schema_text, study_schema

FOLDER = Path(__file__).parents[2]
STUDIES = sorted(
    [*(FOLDER / "studies").glob("*/*.toml"), *(FOLDER / "rfem_jax").glob("report/starting_studies/*.toml")]
)
CHECKER = jsonschema.Draft7Validator(study_schema())
FOUR_BAR = tomllib.loads((FOLDER / "studies" / "four_bar" / "study.toml").read_text(encoding="utf-8"))


def mistakes(study):
    """Where there are mistakes, and what they are."""
    found = [jsonschema.exceptions.best_match([error]) for error in CHECKER.iter_errors(study)]
    return [("/".join(map(str, error.absolute_path)), error.message) for error in found]


def test_the_schema_is_one():
    jsonschema.Draft7Validator.check_schema(study_schema())
    assert json.loads(schema_text()) == study_schema()


def test_what_may_be_of_several_forms_is_not_marked():
    study = copy.deepcopy(FOUR_BAR)
    study["optimise"] = {"objective": "A.rms_force", "bounds": {"coupler.length": ["290 mm", 0.31]}}
    study["mechanism"]["links"][1]["point_masses"] = [{"mass": "20 g", "position": "0.1 m"}]
    study["sensitivity"] = {"metrics": "A.rms_force"}
    assert mistakes(study) == []


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_studies_keep_it(path):
    assert mistakes(tomllib.loads(path.read_text(encoding="utf-8"))) == []


def test_every_key_of_the_reference_is_in_it():
    text = schema_text()
    for table in key_tables():
        for key in table.keys:
            assert " = " in key.name or json.dumps(key.name) in text, (table.header, key.name)


CHANGES = {
    "misspelt key": (lambda study: study["mechanism"].update(gravitiy=[0, 0, 0]), "mechanism", "gravitiy"),
    "of a link": (lambda study: study["mechanism"]["links"][1].update(lenght=1.0), "mechanism/links/1", "lenght"),
    "missing key": (lambda study: study["mechanism"]["joints"][2].pop("parent"), "mechanism/joints/2", "parent"),
    "missing table": (lambda study: study.pop("simulation"), "", "simulation"),
    "another type": (lambda study: study["mechanism"]["joints"][0].update(cut="yes"), "mechanism/joints/0/cut", "yes"),
    "a number": (lambda study: study["simulation"].update(duration=[1.0]), "simulation/duration", "number"),
    "table of a task": (lambda study: study.update(monte_carlo={"samples": 10}), "monte_carlo", "samples"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_mistakes_are_found_where_they_are(name):
    change, where, what = CHANGES[name]
    study = copy.deepcopy(FOUR_BAR)
    change(study)
    (found,) = {place for place, _ in mistakes(study)}
    assert found == where and any(what in message for _, message in mistakes(study))


def test_kinds_are_offered():
    joints = study_schema()["properties"]["mechanism"]["properties"]["joints"]["items"]["anyOf"][0]
    assert joints["properties"]["kind"]["anyOf"][0]["enum"] == list(KINDS)
    drives = study_schema()["properties"]["drive"]["anyOf"]
    assert "prescribed_rate" in [drive["properties"]["kind"]["const"] for drive in drives]
