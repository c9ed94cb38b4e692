"""Numbers with units: conversion to SI, dimensions, refusals."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.description.basics.units import (
    DIMENSIONS,
    UNITS,
    non_negative_quantity,
    positive_quantity,
    quantity,
    sequence,
    vector,
)


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        ("0.5 deg", "angle", math.pi / 360),
        ("-90deg", "angle", -math.pi / 2),
        ("0.5\u00b0", "angle", math.pi / 360),
        ("30 arcmin", "angle", math.pi / 360),
        ("1 rev", "angle", 2 * math.pi),
        ("0.5 mm", "length", 5e-4),
        ("12 \u00b5m", "length", 12e-6),
        ("1e1 cm", "length", 0.1),
        (".5 in", "length", 0.0127),
        ("210 GPa", "pressure", 210e9),
        ("210e3 N/mm^2", "pressure", 210e9),
        ("7.85 g/cm^3", "density", 7850.0),
        ("7.85 kg/dm**3", "density", 7850.0),
        ("1.5 N m", "moment", 1.5),
        ("1.5 N*m", "moment", 1.5),
        ("1500 Nmm", "moment", 1.5),
        ("1.5 kg m^2 / s^2", "moment", 1.5),
        ("60 rpm", "rate", 2 * math.pi),
        ("180 deg/s", "rate", math.pi),
        ("3 ms", "time", 3e-3),
        ("100 mm\u00b2", "area", 1e-4),
        ("833 mm^4", "second_moment", 833e-12),
        ("9.81 m s^-2", "acceleration", 9.81),
        ("21 MN", "axial_stiffness", 21e6),
        ("175 N m^2", "bending_stiffness", 175.0),
        ("785 g/m", "line_density", 0.785),
        ("6.5 g m", "rotary_inertia", 6.5e-3),
        ("2 kg mm^2", "moment_of_inertia", 2e-6),
        ("5 %", "none", 0.05),
        ("20 g", "mass", 0.02),
        ("12 kN", "force", 12e3),
    ],
)
def test_strings_with_units_become_si(text, dimension, value):
    assert quantity(text, dimension, "x") == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_every_dimension_takes_its_own_unit_and_its_example(dimension):
    _, unit, example = DIMENSIONS[dimension]
    assert quantity(f"2.5 {unit}", dimension, "x") == 2.5
    assert quantity(example, dimension, "x") > 0.0


def test_decimal_units_round_as_the_decimal_number_does():
    assert quantity("0.5 mm", "length", "x") == 5e-4
    assert quantity("0.3 mm", "length", "x") == 3e-4
    assert quantity("10 mm", "length", "x") == 0.01
    assert quantity("0.7 ms", "time", "x") == 7e-4


@pytest.mark.parametrize("kind", [int, float, np.float64, np.float32, np.int64, np.array, jnp.array])
def test_numbers_of_any_kind_become_floats(kind):
    result = quantity(kind(2), "length", "x")
    assert type(result) is float and result == 2.0


def test_each_unit_is_refused_where_another_dimension_is_wanted(refused):
    for unit, (_, exponents) in UNITS.items():
        for dimension, (wanted, si_unit, _) in DIMENSIONS.items():
            if exponents != wanted:
                with refused("`x`", si_unit, unit):
                    quantity(f"1 {unit}", dimension, "x")


@pytest.mark.parametrize(
    ("value", "pieces"),
    [
        ("0.5 degg", ("known unit", "degg")),
        ("0.5 mm deg", ("length",)),
        ("0.5", ("unit", "without quotes")),
        ("mm", ("start with a number",)),
        ("1 m^", ("known unit",)),
        ("1 /s", ("known unit",)),
        ("", ("number",)),
        ("nan m", ("number",)),
        (math.nan, ("finite",)),
        (math.inf, ("finite",)),
        ("1e999 m", ("finite",)),
        (10**400, ("number",)),
        (True, ("True",)),
        (np.True_, ("True",)),
        (jnp.array(True), ("number",)),
        (None, ("None",)),
        (1j, ("number",)),
        ([1.0], ("number",)),
        ({"value": 1.0}, ("number",)),
    ],
)
def test_what_is_no_length_is_refused(refused, value, pieces):
    with refused("Argument `x`", *pieces):
        quantity(value, "length", "x")


def test_the_dimension_found_is_named(refused):
    with refused("must be an angle", "which is a length", '"0.5 deg"'):
        quantity("3 mm", "angle", "tilt")


def test_a_traced_value_is_refused_with_the_reason(refused):
    with refused("known before compilation", "jit"):
        jax.jit(lambda x: quantity(x, "length", "x"))(1.0)


def test_signs(refused):
    assert positive_quantity("1 mm", "length", "x") == 1e-3
    assert non_negative_quantity(0, "length", "x") == 0.0
    for value in (0, -1.0, "-1 mm"):
        with refused("greater than 0"):
            positive_quantity(value, "length", "x")
    with refused("not be negative"):
        non_negative_quantity("-1 mm", "length", "x")


def test_vectors_and_sequences(refused):
    assert vector([0, "5 mm", 1.5], "length", "x") == (0.0, 5e-3, 1.5)
    assert vector(np.arange(3.0), "length", "x") == (0.0, 1.0, 2.0)
    assert sequence((), "time", "x") == ()
    with refused("three components", "has 2"):
        vector([0.0, 1.0], "length", "x")
    with refused("entry 2", "length"):
        vector([0.0, "1 deg", 0.0], "length", "x")
    for value in ("0 m", 1.0, None, {"x": 1.0}):
        with refused("list of numbers"):
            vector(value, "length", "x")
    with refused("entry 1"):
        sequence([[1.0, 2.0], 3.0], "length", "x")
