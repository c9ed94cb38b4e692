"""Names of all numbers of a description, and what study files set and scatter by them."""

import dataclasses

import equinox as eqx
import pytest

from rfem_jax import Circle, InputError, Link, Mechanism, load_study
from rfem_jax.description.parameters.deviations import deviation_unit, require_deviation
from rfem_jax.description.parameters.parameters import parameters_of
from rfem_jax.description.parameters.parts import number_at, parts_of, with_numbers
from tests.mechanisms import STEEL, chain_with_forces, four_bar, loop_with_springs
from tests.report.conftest import STUDY

TABLES = """
[design]
"bar.height" = "18 mm"
"drive.moment" = "2 N m"
"rocker.length" = [0.28, "320 mm"]
[tolerances]
"drive.moment" = "0.1 N m"
"steel.youngs_modulus" = "2 GPa"
"bar.height" = { half_width = "0.1 mm", distribution = "normal" }
"D.delta_x" = "0.1 deg"
"""


def values(mechanism):
    parts = parts_of(mechanism)
    return {one.name: (one.value_in(parts), one.unit) for one in parameters_of(mechanism).all}


def test_numbers_have_names_values_and_units():
    found = values(four_bar())
    assert found["crank.length"] == (0.12, "m") and found["steel.youngs_modulus"] == (210e9, "Pa")
    assert found["D.position.x"] == (0.3, "m") and found["gravity.z"] == (-9.81, "m/s^2")
    assert found["A.angle"][1] == "rad" and "B.angle" not in found, "what closing finds is a result"
    # Sections without a name belong to their links; what is shared is one number.
    assert found["crank.section.height"] == (0.01, "m") and len([n for n in found if n.startswith("steel.")]) == 4


def test_numbers_of_springs_forces_and_tables():
    found = values(chain_with_forces()) | values(loop_with_springs())
    units = {name.rpartition(".")[2]: unit for name, (_, unit) in found.items()}
    assert {"stiffness", "damping", "factor"} <= {*units} and units["factor"] == "1"


def test_a_name_of_two_things_must_be_told_apart():
    round_bar = dataclasses.replace(Circle(0.01), name="rocker")
    links = [Link("crank", 0.1, round_bar, STEEL), Link("rocker", 0.3, round_bar, STEEL)]
    joints = [joint for joint in four_bar().joints if joint.name in "AD"]
    names = parameters_of(Mechanism(links, joints))
    assert names["section.rocker.diameter"].unit == "m" and names["link.rocker.length"].unit == "m"
    with pytest.raises(InputError, match=r"tell apart .*`section.rocker.diameter`"):
        names["rocker.diameter"]


@pytest.fixture
def load(tmp_path):
    def load_text(tables):
        path = tmp_path / "study.toml"
        path.write_text(STUDY + tables, encoding="utf-8")
        return load_study(path)

    return load_text


def test_a_study_sets_bounds_and_scatters_parameters(load):
    study = load(TABLES)
    assert study.design_values == {"bar.height": pytest.approx(0.018), "drive.moment": 2.0}
    assert study.design_bounds == {"rocker.length": (0.28, pytest.approx(0.32))}
    assert float(study.designed_drive.moment) == 2.0 and float(study.drive.moment) == 1.5
    assert study.tolerances.half_widths()["steel.youngs_modulus"] == 2e9
    assert study.tolerances.half_widths()["drive.moment"] == 0.1
    assert dataclasses.replace(study, title="other").design == study.design
    mechanism = study.mechanism
    assert deviation_unit(mechanism, "steel.youngs_modulus") == "Pa"
    assert deviation_unit(mechanism, "D.d_y") == "m" and deviation_unit(mechanism, "rocker.length") == "m"
    with pytest.raises(InputError, match="did you mean `bar.height`"):
        require_deviation(mechanism, "bar.hight")


@pytest.mark.parametrize(
    ("tables", "pieces"),
    [
        ('[design]\n"bar.hight" = 0.01\n', ("`bar.hight`", "`bar.height`")),
        ('[design]\n"bar.height" = "1 kg"\n', ("`bar.height` of the design", "length")),
        ('[design]\n"bar.height" = -0.01\n', ("`bar.height` of the design",)),
        ('[design]\n"bar.height" = [0.02, 0.01]\n', ("`bar.height`", "[lowest, highest]")),
        ('[design]\n"B.angle" = 0.1\n', ("`B.angle`", "closing")),
        ('[design]\n"drive.force" = 1.0\n', ("`drive.force`", "`drive.moment`")),
        ('[design]\n"drive.moment" = 1.0\n"drive.A.moment" = [1.0, 2.0]\n', ("`drive.moment` twice",)),
        ('[tolerances]\n"drive.moment" = "1 mm"\n', ("drive.moment", "moment")),
        ('[tolerances]\n"drive.rate" = 1.0\n', ("drive.rate",)),
        ('[tolerances]\n"bar.hight" = "1 mm"\n', ("bar.hight", "bar.height")),
        ('[tolerances]\n"steel.youngs_modulus" = "1 mm"\n', ("steel.youngs_modulus", "pressure")),
    ],
)
def test_wrong_designs_and_deviations_are_refused_in_a_sentence(load, tables, pieces):
    with pytest.raises(InputError) as refused:
        load(tables)
    assert all(piece in str(refused.value) for piece in pieces), str(refused.value)


def test_a_mistake_in_the_drive_is_said_once(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(
        STUDY.replace("moment = 1.5", 'moment = "1 kg"') + '[tolerances]\n"drive.moment" = 0.1\n', encoding="utf-8"
    )
    with pytest.raises(InputError) as refused:
        load_study(path)
    assert len(refused.value.problems) == 1 and "`moment`" in refused.value.problems[0]


def test_many_numbers_are_put_in_as_one_by_one_and_nothing_else_changes():
    mechanism = chain_with_forces()
    parts = parts_of(mechanism)
    paths = [path for one in parameters_of(mechanism).all for path in one.paths if not one.factor]
    values = {path: float(i) for i, path in enumerate(paths)}
    together, one_by_one = with_numbers(parts, values), parts
    for path, value in values.items():
        one_by_one = with_numbers(one_by_one, {path: value})
        assert number_at(together, path) == value
    # A partial function of JAX is equal only to itself, and a tree of another one to one of the same function.
    assert eqx.tree_equal(together, one_by_one) and parts == parts_of(mechanism)


def test_parameters_of_the_same_mechanism_are_listed_once():
    one, other = chain_with_forces(), four_bar()
    assert parameters_of(one) is parameters_of(one)
    assert list(parameters_of(other)) != list(parameters_of(one)) and parameters_of(other) is parameters_of(other)


def test_a_name_that_occurs_twice_is_said_once():
    links = [Link(name, 0.1, Circle(0.01), STEEL, rigid=True) for name in ("a", "b", "a", "a")]
    with pytest.raises(InputError) as caught:
        Mechanism(links, [])
    assert caught.value.problems == ("Argument `links` must have unique names, but `a` occurs twice; rename one.",)
