"""Gear trains of the starting studies, held at positions of their drives: a geared five-bar, a planetary train."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import rfem_jax
from rfem_jax import deviations, discretise, kinetostatic_turn, load_study

STUDIES = Path(rfem_jax.__file__).parent / "report" / "starting_studies"


def started(name):
    return discretise(load_study(STUDIES / f"{name}.toml").mechanism)


CRANK, ROD, GROUND, RATIO, MESH = 0.06, 0.2, 0.2, -2.0, 20e3
LINE = 7850.0 * 0.01**2 * 9.81  # N/m, the weight of all links over their length


def point(first, second):
    """Where the rods meet, above the line between the crank pins; angles about y of both cranks."""
    left = CRANK * jnp.stack([jnp.cos(first), -jnp.sin(first)])
    right = jnp.array([GROUND, 0.0]) + CRANK * jnp.stack([jnp.cos(second), -jnp.sin(second)])
    apart = right - left
    square = jnp.sum(apart**2)
    return 0.5 * (left + right) + jnp.sqrt(ROD**2 / square - 0.25) * jnp.stack([-apart[1], apart[0]])


def potential(first, second):
    """Of the weight."""
    pins = -CRANK * (jnp.sin(first) + jnp.sin(second))
    return LINE * (0.5 * CRANK * pins + 0.5 * ROD * (pins + 2.0 * point(first, second)[1]))


@pytest.mark.long
def test_a_geared_five_bar():
    """P by both cranks' angles, the mesh's moment and what holds the left crank by virtual work, over a revolution:
    loops alone would let the right crank stand anywhere."""
    start, tooth = -0.5 * np.pi, 0.004
    first = start + np.radians(np.arange(0.0, 360.0, 30.0))
    model = started("geared_five_bar")
    turn = kinetostatic_turn(model, deviations(model, {"mesh.pitch_error": tooth}), first)
    assert (np.asarray(turn.status) == 0).all()
    load = np.asarray(turn.couplings["mesh"])
    second = start + RATIO * (first + tooth - start) - load[:, 1] / MESH
    wanted = np.array(jax.vmap(point)(first, second))
    assert_allclose(np.asarray(turn.places["P"])[:, [0, 2]], wanted, rtol=0, atol=1e-9)
    slopes = jax.vmap(jax.grad(potential, argnums=(0, 1)))(first, second)
    by_first, by_second = (np.array(one) for one in slopes)
    assert_allclose(load, np.stack([-RATIO * by_second, by_second], axis=1), rtol=0, atol=1e-6)
    assert_allclose(turn.holding, by_first + RATIO * by_second, rtol=0, atol=1e-6)
    assert np.abs(turn.holding).max() > 0.2


@pytest.mark.slow
def test_a_planetary_train():
    """Willis: what holds the carrier is the sun's moment times 1 + z_r / z_s, wherever it stands. The planets share it,
    but for a pin that is off: its meshes, in series, are wound up more by what the mean of all is less."""
    sun, ring, moment, stiffness, off = 21.0, 81.0, 20.0, 90e3, 5e-5
    ratio = 30.0 / sun, ring / 30.0
    model = started("planetary")
    angles = np.array([0.0, 1.0, 4.0])
    perfect = kinetostatic_turn(model, None, angles)
    assert (np.asarray(perfect.status) == 0).all()
    assert_allclose(perfect.holding, moment * (1.0 + ring / sun), rtol=1e-9)
    share = moment * ratio[0] / 3.0
    for n in (1, 2, 3):
        inner, outer = (np.asarray(perfect.couplings[f"{name}_{n}"]) for name in ("sun", "ring"))
        assert_allclose(inner, np.tile([moment / 3.0, share], (3, 1)), rtol=1e-9)
        assert_allclose(outer, np.tile([-share * ratio[1], -share], (3, 1)), rtol=1e-9)
    early = kinetostatic_turn(model, deviations(model, {"ring_1.pitch_error": off}), angles)
    assert_allclose(early.holding, moment * (1.0 + ring / sun), rtol=1e-9)
    for n, part in ((1, 2.0 / 3.0), (2, -1.0 / 3.0), (3, -1.0 / 3.0)):
        wanted = share + 0.5 * stiffness * ratio[1] * off * part
        assert_allclose(np.asarray(early.couplings[f"sun_{n}"])[:, 1], wanted, rtol=1e-8)
