"""Temperatures of links and of the base as a user states them."""

import pytest

from rfem_jax import (
    Base,
    Joint,
    Link,
    Material,
    Mechanism,
    Rectangle,
    RigidBody,
    design,
    deviations,
    discretise,
    load_study,
    parameters,
)
from rfem_jax.description.parameters.parameters import parameters_of

from .test_study_files import FULL

BAR, ALPHA = Rectangle(0.01, 0.01), "12e-6 1/K"
STEEL = Material("steel", 2.1e11, 7850.0, 0.3)
WARM = Material("warm", "210 GPa", 7850.0, 0.3, thermal_expansion=ALPHA)
BODY = RigidBody(1.0, (0, 0, 0), (1, 1, 1))


def test_quantities_and_parameters():
    links = [
        Link("a", 0.1, BAR, WARM, rigid=True, temperature="-15 K"),
        Link("b", 0.1, BAR, WARM, rigid=True, thermal_expansion="2e-5 1/K"),
        Link("c", 0.1, BAR, STEEL, rigid=True),
        Link("d", 0.1, body=BODY, thermal_expansion=1e-6),
    ]
    assert [one.expansion for one in links] == [12e-6, 2e-5, None, 1e-6] and links[0].temperature == -15.0
    names = [one.name for one in links]
    joints = [Joint(f"J{b}", a, b) for a, b in zip(["base", *names], names, strict=False)]
    known = parameters(discretise(Mechanism(links, joints, base=Base("23e-6 1/K", "5 K"))))
    found = {name: (one.value, one.unit) for name, one in known.items() if one.unit in ("K", "1/K")}
    assert found == {
        "a.temperature": (-15.0, "K"), "b.temperature": (0.0, "K"), "b.thermal_expansion": (2e-5, "1/K"),
        "d.temperature": (0.0, "K"), "d.thermal_expansion": (1e-6, "1/K"), "warm.thermal_expansion": (12e-6, "1/K"),
        "base.thermal_expansion": (23e-6, "1/K"), "base.temperature": (5.0, "K"),
    }  # fmt: skip


@pytest.mark.parametrize(
    "make, pieces",
    [
        (lambda: Link("a", 0.1, BAR, STEEL, temperature=3.0), ("`temperature` of link `a`", "`thermal_expansion`")),
        (lambda: Link("a", 0.1, body=BODY, temperature=3.0), ("`temperature` of link `a`", "`thermal_expansion`")),
        (lambda: Link("a", 0.1, BAR, WARM, temperature="3 m"), ("`temperature` of link `a`", "a temperature (K)")),
        (lambda: Link("a", 0.1, BAR, WARM, temperature="20 degC"), ("`temperature` of link `a`", "known unit", "`K`")),
        (
            lambda: Material("m", 1e11, 1e3, 0.3, thermal_expansion="1 K"),
            ("`thermal_expansion` of material `m`", "1/K"),
        ),
        (
            lambda: Link("a", 0.1, BAR, STEEL, temperature_gradient_z=3.0),
            ("`temperature_gradient_z` of link `a`", "`thermal_expansion`"),
        ),
        (
            lambda: Link("a", 0.1, BAR, WARM, rigid=True, temperature_gradient_y="3 K/mm"),
            ("`temperature_gradient_y` of link `a`", "is rigid", "3000"),
        ),
        (
            lambda: Link("a", 0.1, BAR, WARM, temperature_gradient_y="3 K"),
            ("`temperature_gradient_y` of link `a`", "K/m"),
        ),
        (lambda: Base("12 K"), ("`thermal_expansion` of the base", "1/K")),
        (lambda: Base(1e-5, "1 m"), ("`temperature` of the base", "(K)")),
        (
            lambda: Mechanism([Link("a", 0.1, BAR, WARM)], [Joint("A", "base", "a")], base=1e-5),
            ("`base`", "Base(", "1e-05"),
        ),
    ],
)
def test_mistakes_are_told(refused, make, pieces):
    with refused(*pieces):
        make()


WARM_FULL = FULL.replace("[drive]", '[mechanism.base]\nthermal_expansion = "23e-6 1/K"\n[drive]', 1)


def load(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    return load_study(path)


def with_expansion(text):
    """The study whose materials expand."""
    header = text.index("[mechanism.materials.")
    end = text.index("\n", header) + 1
    return text[:end] + f'thermal_expansion = "{ALPHA}"\n' + text[end:]


def test_a_study_file(tmp_path):
    study = load(tmp_path, with_expansion(WARM_FULL))
    assert study.mechanism.base == Base(23e-6)
    known = parameters_of(study.mechanism)
    assert {"base.temperature", "one.temperature"} <= {*known}
    flexible = {link.name for link in study.mechanism.links if link.expansion is not None and link.flexible}
    gradients = {name for name in known if "gradient" in name}
    assert flexible and gradients == {f"{name}.temperature_gradient_{axis}" for name in flexible for axis in "yz"}


def test_what_does_not_grow_has_no_temperature(refused, tmp_path):
    text = FULL.replace('"two.length" = 1e-4', '"one.temperature" = "4 K"', 1)
    assert text != FULL
    with refused("of what grows", "`one`", "`thermal_expansion`"):
        load(tmp_path, text)
    model = discretise(Mechanism([Link("a", 0.1, BAR, STEEL)], [Joint("A", "base", "a")]))
    with refused("`a.temperature`", "`thermal_expansion`"):
        design(model, {"a.temperature": 3.0})
    with refused("`a.temperature`", "`thermal_expansion`"):
        deviations(model, {"a.temperature": 3.0})
    with refused("`a.temperature_gradient_z`", "`thermal_expansion`"):
        deviations(model, {"a.temperature_gradient_z": 3.0})


@pytest.mark.parametrize(
    "old, new, pieces",
    [
        ("23e-6 1/K", "23e-6 K", ("[mechanism.base]", "`thermal_expansion`", "1/K")),
        ("thermal_expansion", "expansion", ("[mechanism.base]", "`expansion`")),
    ],
)
def test_mistakes_in_a_study_file_are_named(refused, tmp_path, old, new, pieces):
    with refused(*pieces):
        load(tmp_path, WARM_FULL.replace(old, new, 1))
