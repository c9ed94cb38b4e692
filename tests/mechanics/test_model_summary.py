"""What `print(model)` shows: a few lines, true ones, whatever stands in the model's places."""

import equinox as eqx
import jax
import numpy as np
import pytest

from rfem_jax import Joint, Mechanism, PointMass, discretise
from tests.mechanisms import compliant_chain, four_bar, link


def test_links_joints_loops_mobility_and_mass():
    model = discretise(four_bar(3))
    text = str(model)
    assert repr(model) == text and len(text.splitlines()) < 20
    head, freedoms = text.splitlines()[:2]
    mass = 7850.0 * 0.01**2 * (0.12 + 0.3 + 0.3)
    assert head == f"Model of 3 links and 4 joints, 1 loop, mass {mass:.4g} kg"
    # Of 3 angles and 24 deflections five closure equations leave 22; with rigid links a four-bar has one freedom.
    assert freedoms == "degrees of freedom: 1 with rigid links, 22 as discretised"
    rows = [line.split() for line in text.splitlines()]
    assert ["coupler", "0.3", f"{7850.0 * 1e-4 * 0.3:.4g}", "3"] in rows and [
        "crank",
        "0.12",
        "0.0942",
        "rigid",
    ] in rows
    assert ["A", "revolute", "base", "crank", "driven"] in rows and [
        "C",
        "revolute",
        "coupler",
        "rocker",
        "cut",
    ] in rows


def test_point_masses_count_and_compliance_is_said():
    bar = link("bar", 0.2, 2, point_masses=[PointMass(0.5, 0.1)])
    text = str(discretise(Mechanism([bar], [Joint("A", "base", "bar", kind="fixed")])))
    assert f"{7850.0 * 1e-4 * 0.2 + 0.5:.4g} kg" in text and "no loops" in text
    assert "compliant" in str(discretise(compliant_chain()))


@pytest.mark.parametrize("part", ["batch", "shapes", "mask", "traced"])
def test_it_is_told_of_batches_tracers_and_masks_without_numbers(part):
    model = discretise(four_bar(3))
    if part == "traced":
        texts = []
        eqx.filter_jit(lambda model: texts.append(str(model)))(model)
        (text,) = texts
    else:
        other = {
            "batch": lambda x: np.stack([x, x]),
            "shapes": lambda x: jax.eval_shape(lambda: x),
            "mask": eqx.is_array,
        }
        text = str(jax.tree.map(other[part], model))
    assert text.startswith("Model of 3 links and 4 joints, 1 loop\n") and "coupler  " in text


def test_many_links_are_not_all_listed():
    links = [link(f"link{i}", 0.1) for i in range(60)]
    joints = [Joint(f"J{i}", f"link{i - 1}" if i else "base", f"link{i}") for i in range(60)]
    text = str(discretise(Mechanism(links, joints)))
    assert len(text.splitlines()) < 60 and text.count("... and 40 more") == 2
