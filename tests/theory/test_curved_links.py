"""Curved and bent links against closed forms and beam finite elements."""

import jax
import numpy as np
import pytest

from rfem_jax import (
    AxisPoint,
    Joint,
    Link,
    Mechanism,
    Rectangle,
    assembly_errors,
    discretise,
)
from rfem_jax.mechanics.elements.elasticity import stiffness_blocks
from rfem_jax.mechanics.model.with_errors import apply_errors
from tests.mechanisms import STEEL

NOTHING = (0.0, 0.0, 0.0)
RADIUS, LOAD = 0.2, 1e-3
SECTION = Rectangle(0.01, 0.016)
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(60)
RING = AxisPoint((RADIUS, 0.0, RADIUS), through=(RADIUS * np.sin(0.5), 0.0, RADIUS * (1.0 - np.cos(0.5))))


def clamped(axis, rfes, forces=(), section=SECTION, **more):
    smooth = more.pop("smooth", False)
    beam = Link("beam", section=section, material=STEEL, rfes=rfes, axis=axis, smooth=smooth)
    return discretise(
        Mechanism([beam], [Joint("A", "base", "beam", kind="fixed")], forces=forces, gravity=NOTHING, **more)
    )


@jax.jit
def stiffness(actual):
    return stiffness_blocks(actual), actual.rest


def tip_compliance(axis, rfes, **more):
    """Displacements and rotations (6, 6) of the end of a clamped link per unit of forces and moments there."""
    model = clamped(axis, rfes, **more)
    blocks, rest = jax.tree.map(np.asarray, stiffness(apply_errors(model, assembly_errors(model))))
    m = rfes - 1
    whole = np.zeros((6 * m, 6 * m))  # rotations first
    for k in range(m):
        at, before = slice(6 * k, 6 * k + 6), slice(6 * k - 6, 6 * k)
        whole[at, at] = blocks.diagonal[k]
        if k:
            whole[at, before], whole[before, at] = blocks.lower[k], blocks.lower[k].T
    of_last = np.linalg.inv(whole)[-6:, -6:][np.ix_((3, 4, 5, 0, 1, 2), (3, 4, 5, 0, 1, 2))]
    x, y, z = np.array(axis[-1].to) - rest[:, -1]
    to_tip = np.eye(6)
    to_tip[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return to_tip @ of_last @ to_tip.T


def castigliano(place, axes, length, end):
    """Compliance (6, 6) of a clamped curved beam at its end by its energy, of the curve `place(s)` and the sections'
    axes `axes(s)`, columns."""
    found = SECTION.properties(STEEL)
    names = "axial", "shear_y", "shear_z", "torsion", "bending_y", "bending_z"
    compliance = np.diag([1.0 / getattr(found, name) for name in names])
    total = np.zeros((6, 6))
    for node, weight in zip(0.5 * length * (1.0 + POINTS), 0.5 * length * WEIGHTS):
        x, y, z = np.array(end) - place(node)
        lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        loads = np.block([[axes(node).T, np.zeros((3, 3))], [axes(node).T @ lever, axes(node).T]])
        total += weight * loads.T @ compliance @ loads
    return total


def ring_axes(s):
    a = s / RADIUS
    return np.array([[np.cos(a), 0.0, -np.sin(a)], [0.0, 1.0, 0.0], [np.sin(a), 0.0, np.cos(a)]])


def ring_place(s):
    a = s / RADIUS
    return RADIUS * np.array([np.sin(a), 0.0, 1.0 - np.cos(a)])


def test_a_quarter_ring_deflects_as_castigliano_says_with_an_error_of_second_order():
    """In its plane and out of it, with the coupling of bending and torsion."""
    exact = castigliano(ring_place, ring_axes, 0.5 * np.pi * RADIUS, RING.to)
    found = SECTION.properties(STEEL)
    bending, torsion, shear, r = found.bending_z, found.torsion, found.shear_y, RADIUS
    out_of_plane = r**3 * (np.pi / 4 / bending + (3 * np.pi / 4 - 2) / torsion) + 0.5 * np.pi * r / shear
    assert exact[1, 1] == pytest.approx(out_of_plane, rel=1e-12)  # Castigliano's theorem by hand
    size = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    coarse, fine = ((tip_compliance([RING], rfes) - exact) / size for rfes in (5, 9))
    assert np.abs(coarse[3:, 3:]).max() < 1e-9  # by moments: the sdes' compliances are those of their segments
    assert 0.01 < np.abs(coarse).max() < 0.03
    assert np.abs(coarse).max() / np.abs(fine).max() == pytest.approx(4.0, rel=0.05)
