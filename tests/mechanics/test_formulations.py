"""The recursive formulation against the reference (trace formula, dense augmented system)."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from rfem_jax import State, discretise
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import energy_and_momentum, loads
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.laws.frame_forces import Time
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.reference.formulation import reference_accelerations
from rfem_jax.mechanics.reference.node_transforms import constraints
from tests.mechanisms import (
    ALL,
    chain_of_kinds,
    chain_with_balls,
    chain_with_couplings,
    chain_with_drives,
    chain_with_forces,
    chain_with_ideal_couplings,
    compliant_chain,
    compliant_four_bar,
    curved_four_bar,
    four_bar,
    loop_cut_by,
    loop_cut_by_sprung,
    loop_with_a_ball,
    loop_with_an_ideal_coupling,
    loop_with_line_loads,
    loop_with_point_forces,
    loop_with_springs,
    open_chain,
    random_state,
    slender_four_bar,
    slender_six_bar,
    some_errors,
    tapered_four_bar,
    two_cuts_of_different_kinds,
)

GAINS = Stabilisation(3.0, 7.0, 0.3)
STATES = 5
# Mechanisms that contain another one stand for it, as `chain_with_forces` for `chain_of_kinds`. Every kind of cut joint
# is met with exact elements (prismatic and universal in `two_cuts_of_different_kinds`), and linear ones between these,
# with which the closure equations have nothing to do, by a few.
# Components of the load in H (tree) or L (cut) along the free motions in their order: force x, y, z, moment x, y, z.
FREE = {"revolute": (4,), "prismatic": (0,), "cylindrical": (4, 1), "planar": (0, 2, 4), "fixed": (), "free": range(6)}


def close(actual, state):
    """The nearest state whose cut joints are closed (positions only; the rates stay free)."""
    flat, unravel = ravel_pytree(state.position)
    if actual.topology.n_cuts == 0:
        return state
    # What is prescribed is imposed again in the formulations, so it must not move here.
    moves = jnp.ones_like(flat)
    for k in actual.topology.held:
        moves = moves.at[actual.topology.place_of(k)].set(0.0)

    def newton(flat, _):
        def residual(q):
            value = constraints(actual, unravel(q), 0.3)
            return value, value

        jacobian, value = jax.jacfwd(residual, has_aux=True)(flat)
        free = jacobian * moves[None]
        square = free @ free.T
        damping = 1e-13 * jnp.trace(square) * jnp.eye(len(square))  # rows may say the same
        return flat - free.T @ jnp.linalg.solve(square + damping, value), None

    flat, _ = jax.lax.scan(newton, flat, length=12)
    return State(unravel(flat), state.velocity)


def named(make, *arguments):
    """`make` with arguments, and a name that says them."""
    made = partial(make, *arguments)
    made.__name__ = "-".join([make.__name__, *arguments])
    return made


CASES = [
    *[(make, "moment", "linear") for make in ALL],
    (four_bar, "prescribed", "linear"),
    (four_bar, "moment", "geometrically_exact"),
    (tapered_four_bar, "prescribed", "linear"),
    (tapered_four_bar, "moment", "geometrically_exact"),
    (curved_four_bar, "prescribed", "linear"),
    (curved_four_bar, "moment", "geometrically_exact"),
    (open_chain, "prescribed", "geometrically_exact"),
    (slender_four_bar, "moment", "linear"),
    (slender_six_bar, "prescribed", "geometrically_exact"),
    (chain_of_kinds, "prescribed", "geometrically_exact"),
    (named(loop_cut_by, "cylindrical"), "moment", "geometrically_exact"),
    (two_cuts_of_different_kinds, "moment", "geometrically_exact"),
    (chain_with_balls, "prescribed", "linear"),
    (chain_with_balls, "moment", "geometrically_exact"),
    (chain_with_forces, "moment", "linear"),
    (chain_with_couplings, "moment", "linear"),
    (chain_with_ideal_couplings, "moment", "linear"),
    (loop_with_an_ideal_coupling, "prescribed", "geometrically_exact"),
    (loop_with_springs, "moment", "geometrically_exact"),
    (chain_with_forces, "prescribed", "linear"),
    (loop_with_point_forces, "moment", "linear"),
    (loop_with_line_loads, "moment", "linear"),
    (loop_with_a_ball, "moment", "linear"),
    (chain_with_drives, "several", "linear"),
    *[(named(loop_cut_by, kind), "moment", "linear") for kind in ("prismatic", "planar")],
    *[(named(loop_cut_by, kind), "moment", "geometrically_exact") for kind in ("spherical", "planar", "fixed")],
    (compliant_chain, "moment", "linear"),
    (compliant_four_bar, "moment", "linear"),
    *[(named(loop_cut_by_sprung, kind), "moment", "linear") for kind in ("revolute", "universal", "fixed")],
]

# Mechanisms that take half a minute or more; ten seconds or more.
EXHAUSTIVE = {"slender_six_bar", "two_loop_six_bar"}
LONG = {
    "three_link_loop", "six_link_loop", "twisted_spatial_loop", "curved_four_bar", "chain_of_kinds",
    "chain_with_forces", "chain_with_couplings", "chain_with_ideal_couplings", "compliant_chain", "compliant_four_bar",
    "two_cuts_of_different_kinds", "loop_with_point_forces", "loop_with_springs", "loop_cut_by-cylindrical",
    "loop_cut_by_sprung-fixed",
}  # fmt: skip


def marks_of(name):
    return [pytest.mark.exhaustive] if name in EXHAUSTIVE else [pytest.mark.long] if name in LONG else []


def drives_of(topology, driven):
    """The first two of several drives prescribed and the others given, or one of the two."""
    if topology.driven is None:
        return DriveInput()
    motion = jnp.asarray(0.3), jnp.asarray(-2.0), jnp.asarray(11.0)
    if driven == "several":
        first, second, *others = topology.drives
        forces = {k: jnp.asarray(1.7 - 4.0 * n) for n, k in enumerate(others)}
        return DriveInput(forces, {first: motion, second: tuple(0.1 * x for x in motion)})
    k = topology.driven_coordinate
    return DriveInput(motions={k: motion}) if driven == "prescribed" else DriveInput({k: jnp.asarray(1.7)})


@pytest.fixture(
    scope="module",
    params=[pytest.param(case, marks=marks_of(case[0].__name__)) for case in CASES],
    ids=lambda case: "-".join([case[0].__name__, *case[1:]]),
)
def compared(request):
    """Both formulations on random closed states with random errors, driven by a moment or a prescribed angle."""
    make, driven, elements = request.param
    model = discretise(make(), elements=elements)
    prescribed = tuple(drives_of(model.topology, driven).motions)
    rng = np.random.default_rng(7)

    def both(errors, state):
        actual = apply_errors(model, errors)
        drive = drives_of(model.topology, driven)
        if model.vectors_of_time:
            drive = drive._replace(time=Time(0.2, 0.1))
        state = close(actual, impose(model.topology, state, drive))
        fast = accelerations(actual, state, drive, GAINS)
        slow, multipliers = reference_accelerations(actual, state, drive, GAINS)
        joint = loads.joint_loads(actual, fast, drive)
        chain, base = loads.chain_loads(actual, fast, fast.angular, fast.linear, drive)
        residual = energy_and_momentum.momentum_residual(actual, state, fast.coordinates, base, fast.frame_loads)
        inside = {} if fast.laws is None else fast.laws.inside
        return fast.coordinates, fast.multipliers, slow, multipliers, residual, joint, chain, inside, state

    # The law of a tilt is that of angles below 90 deg; displacements of bearings are small.
    size = 0.1 if model.topology.sprung else 0.5
    samples = [(some_errors(model, rng), random_state(model, rng, size)) for _ in range(STATES)]
    samples = jax.tree.map(lambda *x: jnp.stack(x), *samples)
    return model, prescribed, jax.jit(jax.vmap(both if model.topology.minimum_norm else kernel(both)))(*samples)


@pytest.mark.slow
def test_accelerations_and_multipliers_agree(compared):
    model, _, out = compared
    fast, multipliers, slow, reference, *_ = out
    for one, other in ((fast.joints, slow.joints), (fast.elastic, slow.elastic)):
        scale = np.abs(other).max(axis=tuple(range(1, other.ndim)), keepdims=True)
        np.testing.assert_allclose(one / scale, other / scale, rtol=0, atol=1e-9)
    if model.topology.sprung_rows:
        multipliers = multipliers[:, ~np.array(model.topology.sprung_rows)]
    if reference.shape[1]:
        scale = np.abs(reference).max(axis=1, keepdims=True)
        assert scale.min() > 1.0
        np.testing.assert_allclose(multipliers / scale, reference / scale, rtol=0, atol=1e-9)


def test_joint_loads_balance_the_rate_of_momentum(compared):
    _, _, out = compared
    *_, (force, moment), joint, _, _, _ = out
    largest = np.abs(joint.force).max(axis=(1, 2))
    np.testing.assert_allclose(np.abs(force).max(axis=1) / largest, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(moment).max(axis=1) / largest, 0.0, atol=1e-9)


def test_no_load_along_free_motions_but_that_of_springs(compared):
    model, prescribed, out = compared
    joint, inside, state = out[-3:]  # by Newton-Euler over all rfes, where no equation makes the load vanish
    largest = np.abs(joint.moment).max(axis=(1, 2)) + np.abs(joint.force).max(axis=(1, 2))
    loads = np.concatenate([joint.force, joint.moment], axis=1) / largest[:, None, None]
    positions = np.asarray(state.position.joints)
    topology = model.topology
    for j, kind in enumerate(topology.kinds):
        if topology.kind(j) is not topology.kind(j).nominal:
            continue  # told in test_compliant_joints
        along = loads[:, FREE.get(kind, ()), j].T
        if kind == "universal" and j < topology.n_links:
            # y of the parent in H, behind the rotation about z.
            angle = positions[:, topology.positions[j][1]]
            about_y = np.sin(angle) * loads[:, 3, j] + np.cos(angle) * loads[:, 4, j]
            along = np.array([about_y, loads[:, 5, j]])
        if kind == "planar" and j < topology.n_links:
            # x and z of the parent in H, behind the rotation about y.
            angle, (x, z, about) = positions[:, topology.positions[j][2]], along
            along = np.array([np.cos(angle) * x + np.sin(angle) * z, np.cos(angle) * z - np.sin(angle) * x, about])
        if kind == "universal" and j >= topology.n_links:
            along = loads[:, 4:5, j].T
        if kind == "spherical":
            along = loads[:, 3:, j].T
        for n, k in enumerate(topology.coordinates[j] if j < topology.n_links else ()):
            along[n] = along[n] - inside.get(k, 0.0) / largest
        enforced = np.isin(topology.coordinates[j] if j < topology.n_links else np.zeros(len(along)) - 1, prescribed)
        assert (np.abs(along[enforced]) > 1e-6).all()
        np.testing.assert_allclose(along[~enforced], 0.0, atol=1e-9)


def test_both_ways_to_the_joint_loads_agree(compared):
    _, _, out = compared
    *_, joint, chain, _, _ = out
    scale = np.abs(chain.force).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(joint.force / scale, chain.force / scale, rtol=0, atol=1e-9)
    np.testing.assert_allclose(joint.moment / scale, chain.moment / scale, rtol=0, atol=1e-9)
