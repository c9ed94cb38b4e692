"""Errors that stress nothing, and joints between the ends of a flexible link, against statics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    assemble,
    assembly_errors,
    discretise,
)


def batch(items):
    return jax.tree.map(lambda *x: jnp.stack(x), *items)


STRESSING = {"C.delta_x": 0.008}
PINS = [{f"{joint}.pin_tilt_{axis}": 0.008} for joint in "ABCD" for axis in "xz"]
TURNED = 0.8


@pytest.fixture(scope="module")
def preloads(four_bar):
    """Function: index of the case -> preloads without gravity, at the start angle and turned."""
    model = four_bar("C", rigid="crank", rfes=2, gravity=(0.0, 0.0, 0.0))
    cases = [{}, STRESSING, *PINS, *PINS]
    start = model.start_joints[model.topology.driven]
    turn = np.array([0.0] * (2 + len(PINS)) + [TURNED] * len(PINS))

    @eqx.filter_jit
    @eqx.filter_vmap
    def assembled(errors, angle):
        return assemble(model, errors, {"A": angle})

    result = assembled(batch([assembly_errors(model, case) for case in cases]), start + turn)
    assert (np.asarray(result.status) == 0).all()
    return lambda case: {
        joint: np.concatenate([np.asarray(load.force[case]), np.asarray(load.moment[case])])
        for joint, load in result.preload.items()
    }


@pytest.mark.slow
def test_a_tilted_seat_stresses_the_loop(preloads):
    assert all(np.abs(load).max() > 1.0 for load in preloads(1).values())
    assert all(np.abs(load).max() < 1e-9 for load in preloads(0).values())


@pytest.mark.parametrize("case", range(len(PINS)), ids=[next(iter(pin)) for pin in PINS])
def test_crooked_pin_stresses_nothing_at_the_start_but_does_when_turned(preloads, case):
    """One axis through both links: the start position is the nominal one."""
    for load in preloads(2 + case).values():
        assert np.abs(load).max() < 1e-8
    turned = preloads(2 + len(PINS) + case)
    assert max(np.abs(load).max() for load in turned.values()) > 1.0


# A weightless beam clamped at A with something hinged to it between its ends.
LENGTH, SEGMENTS, EI, GA = 0.8, 4, 400.0, 6e4
LOAD = 1e-3  # N
WHERE, HANGER = 0.45, 0.2
FEATHER = (1e-12, 2e-16, 1e-16, 1e-16)


def beam(*point_masses):
    section = GivenSection(3e7, 9e4, GA, 150.0, EI, 900.0, *FEATHER)
    return Link("beam", LENGTH, section, rfes=SEGMENTS + 1, point_masses=point_masses)


def feather(name, length, *point_masses):
    section = GivenSection(1e7, 1e6, 1e6, 1e3, 1e3, 1e3, *FEATHER)
    return Link(name, length, section, rigid=True, point_masses=point_masses)


def flexibility(of, at):
    """Deflection at `of` by a unit force at `at`: sdes between the clamp and the rfe of each."""
    sdes = (np.arange(SEGMENTS) + 0.5) * LENGTH / SEGMENTS
    shared = sdes[sdes < min(of, at)]
    return np.sum((of - shared) * (at - shared) / EI + 1.0 / GA) * LENGTH / SEGMENTS


@pytest.mark.long
def test_hinge_between_the_ends_loads_its_own_rfe():
    """A mass hangs from the beam: vertically, so it loads it with its weight."""
    mass, g = 2.0, LOAD / 2.0
    links = [beam(), feather("hanger", HANGER, PointMass(mass, HANGER))]
    joints = [
        Joint("A", "base", "beam"),
        Joint("B", "beam", "hanger", position=(WHERE, 0.0, 0.0), angle=1.0),
    ]
    model = discretise(Mechanism(links, joints, gravity=(0.0, 0.0, -g)))
    result = eqx.filter_jit(assemble)(model, assembly_errors(model), {"A": 0.0})
    assert result.status == 0
    elastic = np.asarray(result.state.position.elastic)
    drop = elastic[2, -1] - elastic[4, -1] * LENGTH / (4.0 * SEGMENTS)
    np.testing.assert_allclose(drop, -LOAD * flexibility(LENGTH, WHERE), rtol=1e-6)
    hanging = result.state.position.joints[1]
    np.testing.assert_allclose(hanging, np.pi / 2.0 - elastic[4, 1], atol=1e-9)
    # The hanger's x points down: the beam pulls it up.
    np.testing.assert_allclose(result.preload["B"].force, [-LOAD, 0.0, 0.0], atol=1e-8 * LOAD)
    np.testing.assert_allclose(result.preload["A"].force, [0.0, 0.0, LOAD], atol=1e-8 * LOAD)
    np.testing.assert_allclose(result.preload["A"].moment, [0.0, -LOAD * WHERE, 0.0], atol=1e-6 * LOAD)


@pytest.mark.slow
def test_cut_joint_between_the_ends_props_the_beam():
    """A rigid strut from the ground holds the beam at WHERE; the load at the tip is shared as the
    beam's flexibilities say."""
    mass = 2.0
    links = [beam(PointMass(mass, LENGTH)), feather("strut", HANGER)]
    joints = [
        Joint("A", "base", "beam"),
        Joint("B", "base", "strut", position=(WHERE, 0.0, -HANGER), angle=-np.pi / 2.0),
        Joint("C", "beam", "strut", position=(WHERE, 0.0, 0.0), cut=True),
    ]
    model = discretise(Mechanism(links, joints, gravity=(0.0, 0.0, -LOAD / mass), driven_joint="A"))
    result = eqx.filter_jit(assemble)(model, assembly_errors(model), None)
    assert result.status == 0
    prop = LOAD * flexibility(WHERE, LENGTH) / flexibility(WHERE, WHERE)
    # The beam presses the strut down (C, in the beam's axes); the ground presses it up (B, x up).
    np.testing.assert_allclose(result.preload["C"].force, [0.0, 0.0, -prop], atol=2e-6 * LOAD)
    np.testing.assert_allclose(result.preload["B"].force, [prop, 0.0, 0.0], atol=2e-6 * LOAD)
    np.testing.assert_allclose(result.preload["A"].force, [0.0, 0.0, LOAD - prop], atol=2e-6 * LOAD)
    elastic = np.asarray(result.state.position.elastic)
    drop = elastic[2, -1] - elastic[4, -1] * LENGTH / (4.0 * SEGMENTS)
    expected = LOAD * flexibility(LENGTH, LENGTH) - prop * flexibility(WHERE, LENGTH)
    np.testing.assert_allclose(drop, -expected, rtol=1e-6)
