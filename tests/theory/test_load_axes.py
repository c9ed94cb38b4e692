"""Loads in axes of links and in global ones: a pendulum, bodies in equilibrium, a mechanism at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Point,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    discretise,
    kinetostatic_turn,
    simulate,
)
from tests.derivatives import check_derivatives
from tests.mechanisms import arm, four_bar
from tests.theory.test_shaking import GRAVITY, RATE, shaken, simulation_of

START, LENGTH = 0.4, 0.3


@pytest.fixture(scope="module")
def swung():
    return jax.tree.map(np.asarray, simulate(simulation_of(arm(), duration=0.1)))


def of_pendulum(times):
    """Force on the turning arm in global axes, and the same along and across it."""
    angle, mass = START + RATE * times, 7850.0 * 1e-4 * LENGTH
    weight = 9.81 * mass
    pull = 0.5 * mass * LENGTH * RATE**2
    on_axes = np.stack([-pull * np.cos(angle), 0.0 * angle, pull * np.sin(angle) + weight], axis=1)
    along = np.stack([-pull - weight * np.sin(angle), 0.0 * angle, weight * np.cos(angle)], axis=1)
    return on_axes, along


def test_a_pendulum_has_its_closed_form_in_all_axes(swung):
    on_axes, along = of_pendulum(swung.times)
    for axes, exact in {"global": on_axes, "parent": on_axes, "child": along, "joint": along}.items():
        np.testing.assert_allclose(swung.loads_in(axes)["A"].force, exact, rtol=0, atol=1e-7)
    weight = swung.preload_in("global")["A"].force
    np.testing.assert_allclose(weight, [0.0, 0.0, 9.81 * 7850.0 * 1e-4 * LENGTH], atol=1e-9)
    assert swung.loads_in("joint") is swung.loads


def test_labelled_data_have_the_axes_that_are_asked_for(swung):
    data = swung.to_xarray(axes="global")
    np.testing.assert_allclose(data.force.sel(joint="A"), of_pendulum(swung.times)[0], atol=1e-7)
    assert "global axes" in data.force.attrs["long_name"] and "global axes" in data.preload_force.attrs["long_name"]
    assert "frame H" in swung.to_xarray().force.attrs["long_name"]
    with pytest.raises(InputError, match="`axes`"):
        swung.to_xarray(axes="world")
    with pytest.raises(InputError, match="where its mechanism is"):
        jax.tree.map(lambda x: x, swung.__class__(**{**vars(swung), "model": None})).loads_in("global")


@pytest.mark.long
def test_the_loads_of_a_free_body_add_up_in_global_axes_and_turn_with_the_links():
    mechanism, bodies = shaken()
    run = jax.tree.map(np.asarray, simulate(simulation_of(mechanism)))
    found = {axes: run.loads_in(axes) for axes in ("parent", "child", "global")}
    (mass,) = (mass for name, mass, *_ in bodies if name == "coupler")
    # The coupler: child at B, parent at C, pulled by a spring from the base.
    at_joints = found["global"]["B"].force - found["global"]["C"].force
    rate = mass * (run.points["coupler_centre"].acceleration - GRAVITY)
    np.testing.assert_allclose(at_joints + run.forces["near"].force, rate, rtol=0, atol=1e-6 * np.abs(rate).max())
    for joint, parent, child in (("B", "crank", "coupler"), ("C", "coupler", "rocker"), ("D", None, "rocker")):
        for axes, link in (("parent", parent), ("child", child)):
            rotation = np.eye(3)[None] if link is None else run.points[f"{link}_centre"].rotation
            for load in ("force", "moment"):
                turned = np.einsum("tij,ti->tj", rotation * np.ones((31, 1, 1)), getattr(found["global"][joint], load))
                scale = 1e-9 * max(np.abs(turned).max(), 1.0)
                np.testing.assert_allclose(getattr(found[axes][joint], load), turned, rtol=0, atol=scale)


@pytest.mark.slow
def test_at_rest_the_base_carries_the_weight():
    model, at = discretise(four_bar(2)), np.array([-1.5, -0.9])
    held = kinetostatic_turn(model, {"D.delta_x": 0.01}, at, "global")
    weight = 9.81 * 7850.0 * 1e-4 * 0.72
    carried = held.in_axes["A"].force + held.in_axes["D"].force
    np.testing.assert_allclose(carried, np.array([[0.0, 0.0, weight]] * 2), atol=1e-6 * weight)
    with pytest.raises(InputError, match="`axes`"):
        kinetostatic_turn(model, None, at, "world")


@pytest.mark.slow
def test_axes_of_a_flexible_link_are_those_of_its_rfe_at_the_joint():
    points = [Point("start", "coupler", 0.0), Point("end", "coupler", 0.3)]
    simulation = Simulation(
        discretise(four_bar(2, points=points)), drive=PrescribedRate("A", RATE), method=RungeKutta4(step=1e-5),
        duration=2e-4,
    )  # fmt: skip
    run = jax.tree.map(np.asarray, simulate(simulation, {"D.delta_x": 0.01}))
    forces = {axes: run.loads_in(axes)["C"].force[0] for axes in ("global", "parent")}
    scale = 1e-9 * float(np.linalg.norm(forces["global"]))
    turned = {at: run.points[at].rotation[0].T @ forces["global"] for at in ("start", "end")}
    np.testing.assert_allclose(forces["parent"], turned["end"], rtol=0, atol=scale)
    assert np.linalg.norm(turned["start"] - turned["end"]) > 1e3 * scale  # the coupler is bent


@pytest.mark.long
def test_a_batch_and_derivatives():
    simulation = simulation_of(arm(), duration=0.04)

    def forces(errors):
        run = simulate(simulation, {"arm.length": errors[0], "A.delta_x": errors[1]})
        return run.loads_in("global")["A"].force[-1]

    at = jnp.array([4e-4, 3e-3])
    check_derivatives(forces, at, [1e-5, 1e-5], reverse=1e-9, differences=1e-5, floor=1e-3)
    several = jax.jit(jax.vmap(lambda x: simulate(simulation, {"arm.length": x})))(jnp.array([0.0, 1e-3]))
    np.testing.assert_allclose(several.loads_in("global")["A"].force[0, -1], forces(jnp.zeros(2)), atol=1e-9)
