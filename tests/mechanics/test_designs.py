"""Models of other numbers: equal to those of other descriptions, closed anew, differentiable."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    InputError,
    Rectangle,
    assemble,
    assembly_errors,
    design,
    designed,
    deviations,
    discretise,
    parameters,
)
from rfem_jax.mechanics.model.nominal_geometry import gaps, geometry_of, place
from tests.mechanisms import STEEL, chain_with_couplings, chain_with_forces, compliant_four_bar, four_bar

OUT = (("position", "y"), ("orientation", "xz"))
OUT_OF_PLANE = tuple(f"{part}.{axis}" for part, axes in OUT for axis in axes)
NEW = {"crank.length": 0.13, "rocker.section.height": 0.012, "steel.density": 7000.0, "D.position.x": 0.31}


def leaves_of(model):
    return [np.asarray(x) for x in jax.tree.leaves(dataclasses.replace(model, source=None))]


def described_anew():
    """The four-bar that `NEW` makes, as a description of its own."""
    nominal = four_bar()
    steel = dataclasses.replace(STEEL, density=7000.0)
    links = [dataclasses.replace(link, material=steel) for link in nominal.links]
    links[0] = dataclasses.replace(links[0], length=0.13)
    links[2] = dataclasses.replace(links[2], section=Rectangle(0.01, 0.012))
    joints = list(nominal.joints)
    joints[2] = dataclasses.replace(joints[2], position=(0.31, 0.0, 0.0))
    return discretise(dataclasses.replace(nominal, links=links, joints=joints))


@pytest.mark.slow
def test_a_design_is_what_its_description_would_be():
    model = discretise(four_bar())
    made = designed(model, design(model, NEW))
    assert STATUS[int(made.status)].name == "ok" and float(made.gap) < 1e-12
    for one, other in zip(leaves_of(made.model), leaves_of(described_anew()), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def vector_of(model):
    """Nominal values and sizes of all parameters of a planar model that leave it planar, as its loops do not close
    otherwise, and the function from values to all leaves."""
    named = {name: one for name, one in parameters(model).items() if not name.endswith(OUT_OF_PLANE)}
    names = list(named)
    nominal = np.array([one.value for one in named.values()])

    def leaves(values):
        made = designed(model, design(model, {name: values[i] for i, name in enumerate(names)}))
        return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(made.model)]), made.status

    # Zeros that may not become negative, as of a damping, stay.
    turns = np.array([0.1 if "osition." in name or "rientation." in name else 0.0 for name in names])
    return nominal, np.where(nominal != 0.0, abs(nominal), turns), leaves


@pytest.mark.long
@pytest.mark.parametrize("mechanism", [compliant_four_bar, chain_with_forces, chain_with_couplings])
def test_all_parameters_at_once(mechanism):
    # Not square: there the torsion constant of a rectangle has no second derivative, and differences are coarse.
    described = mechanism()
    links = [dataclasses.replace(one, section=one.section and Rectangle(0.01, 0.012)) for one in described.links]
    model = discretise(dataclasses.replace(described, links=links))
    nominal, sizes, function = vector_of(model)
    along = np.random.default_rng(5).uniform(-1.0, 1.0, len(nominal)) * sizes * 1e-2

    @jax.jit
    def both(values, along, cotangent):
        (found, status), change = jax.jvp(lambda x: function(x), (values,), (along,))
        (pulled,) = jax.vjp(lambda x: function(x)[0], values)[1](cotangent)
        return found, status, change[0], pulled

    cotangent = np.random.default_rng(6).uniform(-1.0, 1.0, sum(x.size for x in leaves_of(model)))
    found, status, change, pulled = both(nominal, along, cotangent)
    # The nominal values change nothing.
    assert int(status) == 0
    np.testing.assert_allclose(found, np.concatenate([x.ravel() for x in leaves_of(model)]), rtol=1e-12, atol=1e-12)
    # Forward mode is a difference of fourth order, reverse mode its transpose.
    step = 1e-2
    ends = [both(nominal + k * step * along, along, cotangent)[0] for k in (-2, -1, 1, 2)]
    difference = (ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / (12.0 * step)
    scale = np.maximum(abs(np.asarray(change)), 1e-3 * np.maximum(abs(np.asarray(found)), 1e-6))
    np.testing.assert_array_less(abs(np.asarray(difference - change)) / scale, 1e-6)
    assert float(pulled @ along) == pytest.approx(float(cotangent @ change), rel=1e-9)


@pytest.mark.slow
def test_loops_are_closed_and_what_cannot_close_spoils_no_batch():
    model = discretise(four_bar())

    def made(length):
        found = designed(model, design(model, {"rocker.length": length}))
        return found.model.start_joints, found.status, found.gap

    starts, statuses, gap = jax.jit(jax.vmap(made))(jnp.array([0.28, 0.31, 3.0]))
    assert [STATUS[int(status)].name for status in statuses] == ["ok", "ok", "not_closed"]
    assert float(gap[2]) > 1.0 and np.isfinite(starts).all()
    for length, start in zip((0.28, 0.31), starts, strict=False):
        links = list(four_bar().links)
        links[2] = dataclasses.replace(links[2], length=length)
        geometry = geometry_of(discretise(dataclasses.replace(four_bar(), links=links)))
        assert abs(gaps(geometry, place(geometry, np.asarray(start))).residual).max() < 1e-12


@pytest.mark.long
def test_statics_of_a_design_and_its_derivatives():
    model = discretise(four_bar(rfes=2))
    errors = assembly_errors(model, {"D.delta_x": 0.5e-2})

    def moment(numbers, deviation):
        wanted = design(model, {"rocker.section.height": numbers[0], "D.position.x": numbers[1]})
        found = assemble(
            model, eqx.tree_at(lambda e: e.length, errors, jnp.stack([0.0, 0.0, deviation])), design=wanted
        )
        return jnp.stack([found.preload["D"].moment[2], found.preload["A"].force[1]])

    numbers, zero = jnp.array([0.012, 0.3]), jnp.zeros(())
    values = jax.jit(jax.vmap(moment))
    forward = jax.jacfwd(moment, argnums=(0, 1))(numbers, zero)
    reverse = jax.jacrev(moment, argnums=(0, 1))(numbers, zero)
    steps = np.array([[1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0], [0.0, 0.0, 1e-5]])
    around = np.concatenate([k * steps for k in (-2, -1, 1, 2)])
    ends = np.asarray(values(numbers[None] + around[:, :2], around[:, 2])).reshape(4, 3, 2)
    difference = (ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / (12.0 * steps.max(axis=1)[:, None])
    for found in (forward, reverse):
        columns = np.concatenate([np.asarray(found[0]).T, np.asarray(found[1])[None]])
        np.testing.assert_allclose(columns, difference, rtol=1e-6, atol=1e-6 * abs(difference).max())


@pytest.mark.slow
def test_a_parameter_deviates_like_an_error():
    # A length as a parameter's deviation under its full name, and as the error.
    model = discretise(four_bar(rfes=2))
    one, other = (deviations(model, {name: 2e-4}) for name in ("rocker.length", "link.rocker.length"))
    assert not one.parameters and [*other.parameters] == ["link.rocker.length"]
    found = [assemble(model, errors).preload["D"].force for errors in (one, other)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-8, atol=1e-8)


def test_errors_of_assembly_are_no_parameters():
    """A call of the version before, which warns, means what it meant."""
    model = discretise(four_bar(rfes=2))
    values = {"D.delta_x": 2e-3, "rocker.section.height": 1e-4}
    with pytest.warns(DeprecationWarning, match=r"write deviations\(model"):
        former = assembly_errors(model, values)
    made = [designed(model, None, errors) for errors in (former, deviations(model, values), values)]
    joint, link = model.topology.joints.index("D"), model.topology.links.index("rocker")
    for one in made:
        assert float(one.errors.seat[0, joint]) == 2e-3 and one.status is not None
        np.testing.assert_allclose(
            one.model.section.stiffness[0, link], 1.01 * model.section.stiffness[0, link], rtol=1e-12
        )


def test_new_numbers_do_not_retrace():
    model = discretise(four_bar(rfes=2))
    traced = []

    @jax.jit
    def function(height):
        traced.append(1)
        return designed(model, design(model, {"rocker.section.height": height})).model.section.stiffness

    assert float(function(0.012)[0, 1]) == pytest.approx(1.2 * float(function(0.01)[0, 1])) and len(traced) == 1


@pytest.mark.wrong_types
def test_what_is_no_parameter_is_refused():
    model = discretise(four_bar())
    with pytest.raises(InputError, match="did you mean `rocker.section.height`"):
        design(model, {"rocker.section.hight": 0.01})
    with pytest.raises(InputError, match="closing the loops"):
        design(model, {"B.angle": 0.1})
    with pytest.raises(InputError, match="must name each parameter once"):
        design(model, {"crank.length": 0.1, "link.crank.length": 0.1})
    with pytest.raises(InputError, match="`errors` must name each parameter once"):
        deviations(model, {"steel.density": 10.0, "material.steel.density": 10.0})
    with pytest.raises(InputError, match="a table of them by their names, but is 5"):
        deviations(model, 5)  # pyright: ignore[reportArgumentType]
