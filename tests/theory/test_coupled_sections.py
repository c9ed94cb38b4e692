"""Channels, angles and laminates: sections that couple bending, shear and torsion, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    AngleSection,
    ChannelSection,
    CompositeSection,
    InputError,
    Joint,
    Link,
    Mechanism,
    PointForce,
    PointMoment,
    PolygonSection,
    Station,
    TeeSection,
    assemble,
    assembly_errors,
    discretise,
)
from rfem_jax.description.mechanism.shear_flows import shear_flow
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.simulation.rest.statics import static_loads
from tests.derivatives import check_derivatives
from tests.mechanisms import STEEL

LENGTH, LOAD, RFES = 0.6, 1e-3, 4
SEGMENTS = RFES - 1
DISCRETE = 1.0 - 1.0 / (4.0 * SEGMENTS**2)  # of the bending of a cantilever with its elements in the middles
NOTHING = (0.0, 0.0, 0.0)
CHANNEL = ChannelSection(0.03, 0.04, 0.002, 0.003, name="channel")
ANGLE = AngleSection(0.04, 0.025, 0.003, name="angle")
E, G = STEEL.youngs_modulus, STEEL.modulus_of_rigidity


def clamped(section, forces=(), material=STEEL, rfes=RFES, stations=(), **more):
    beam = Link("beam", LENGTH, section, material, rfes=rfes, stations=stations)
    joint = Joint("A", "base", "beam", kind="fixed")
    return discretise(Mechanism([beam], [joint], forces=forces, gravity=NOTHING, **more))


def tip(model):
    """Displacement and rotation of the end of the clamped beam, small ones."""
    position = assemble(model, assembly_errors(model))
    u, phi = position.state.position.elastic.reshape(2, 3, -1)[:, :, -1]
    return jnp.concatenate([u + jnp.cross(phi, jnp.array([LENGTH / (4.0 * SEGMENTS), 0.0, 0.0])), phi])


def force_at(section, at_shear_centre, direction=(0.0, 0.0, 1.0)):
    place = section.shear_centre if at_shear_centre else (0.0, 0.0)
    return [PointForce("push", "beam", (LENGTH, *place), force=tuple(LOAD * x for x in direction))]


@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_a_channel_turns_under_a_force_at_its_centroid_and_not_at_its_shear_centre(elements):
    y_s, z_s = CHANNEL.shear_centre
    assert y_s < -0.01  # beyond the web
    assert z_s == pytest.approx(0.0, abs=1e-15)
    turned = np.asarray(tip(clamped(CHANNEL, force_at(CHANNEL, False), elements=elements)))
    straight = np.asarray(tip(clamped(CHANNEL, force_at(CHANNEL, True), elements=elements)))
    expected = -y_s * LOAD * LENGTH / (G * CHANNEL.torsion_constant)
    assert turned[3] == pytest.approx(expected, rel=1e-6)
    assert abs(straight[3]) < 1e-6 * abs(expected)
    bending = LOAD * LENGTH**3 / (3.0 * E * CHANNEL.second_moment_y) * DISCRETE
    shear = CHANNEL.kappas[1] * LOAD * LENGTH / (G * CHANNEL.area)
    assert straight[2] == pytest.approx(bending + shear, rel=1e-6)
    # The centroid turns about the shear centre.
    assert turned[2] == pytest.approx(bending + shear - y_s * expected, rel=1e-6)


def test_a_force_along_the_hinges_turns_a_tee():
    section = TeeSection(0.03, 0.04, 0.002, 0.003)
    found = np.asarray(tip(clamped(section, force_at(section, False, (0.0, 1.0, 0.0)))))
    assert found[3] == pytest.approx(section.shear_centre[1] * LOAD * LENGTH / (G * section.torsion_constant), rel=1e-6)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_an_angle_bends_out_of_the_plane_of_its_load(direction):
    """Unsymmetric bending, with the shear of thin walls."""
    found = np.asarray(tip(clamped(ANGLE, force_at(ANGLE, True, direction))))
    about_y, about_z, product = ANGLE.second_moment_y, ANGLE.second_moment_z, ANGLE.product_of_inertia
    assert product < 0.0
    bending = np.array([[about_y, -product], [-product, about_z]]) / (E * (about_y * about_z - product**2))
    yy, yz, zz = shear_flow(ANGLE.walls).factors
    shear = np.array([[yy, yz], [yz, zz]]) / (G * ANGLE.area)
    expected = (LENGTH**3 / 3.0 * DISCRETE * bending + LENGTH * shear) @ direction[1:] * LOAD
    np.testing.assert_allclose(found[1:3], expected, rtol=1e-6)
    assert abs(expected[0] * expected[1]) > 0.1 * max(expected**2)
    assert abs(found[3]) < 1e-9 * LOAD


def test_a_triangle_bends_in_the_direction_of_its_load():
    """An equilateral one, whose second moments are alike about all axes: s^4 sqrt(3) / 96."""
    side, load = 0.02, np.array([0.0, 0.6, 0.8])
    points = [(0, 0), (side, 0), (0.5 * side, 0.5 * np.sqrt(3.0) * side)]
    torsion, centre = np.sqrt(3.0) / 80.0 * side**4, (0.5 * side, side / np.sqrt(12.0))
    section = PolygonSection(points, torsion, 1.3, 1.3, shear_centre=centre)
    found = np.asarray(tip(clamped(section, [PointForce("push", "beam", LENGTH, force=tuple(LOAD * load))])))
    bending = LENGTH**3 / (3.0 * E * side**4 * np.sqrt(3.0) / 96.0) * DISCRETE
    area = 0.25 * np.sqrt(3.0) * side**2
    np.testing.assert_allclose(found[1:3], (bending + 1.3 * LENGTH / (G * area)) * LOAD * load[1:], rtol=1e-6)
    assert abs(found[3]) < 1e-9 * LOAD


def laminate(coupling=60.0, **more):
    """Bends as it is twisted."""
    stiffness = np.diag([3e7, 4e6, 3e6, 150.0, 400.0, 900.0])
    stiffness[3, 4] = stiffness[4, 3] = coupling
    return CompositeSection(stiffness.tolist(), 0.8, 2e-4, 1e-4, 1.2e-4, name="laminate", **more)


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_a_laminate_twists_as_it_bends(elements):
    torsion, bending, coupling = 150.0, 400.0, 60.0
    determinant = torsion * bending - coupling**2
    moment = PointMoment("turn", "beam", (LENGTH, 0, 0), moment=(LOAD, 0, 0), axes="link")
    by_moment = np.asarray(tip(clamped(laminate(), [moment], None, elements=elements)))
    expected = LOAD * LENGTH * np.array([bending, -coupling, 0.0]) / determinant
    np.testing.assert_allclose(by_moment[3:], expected, rtol=1e-6, atol=1e-11)
    push = PointForce("push", "beam", (LENGTH, 0, 0), force=(0.0, 0.0, LOAD))
    by_force = np.asarray(tip(clamped(laminate(), [push], None, elements=elements)))
    assert by_force[3] == pytest.approx(LOAD * LENGTH**2 / 2.0 * coupling / determinant, rel=1e-6)
    expected = LOAD * LENGTH**3 / 3.0 * torsion / determinant * DISCRETE + LOAD * LENGTH / 3e6
    assert by_force[2] == pytest.approx(expected, rel=1e-6)


def test_masses_of_a_section_whose_centre_is_off_its_axis():
    section = laminate(mass_offset_y=0.002, mass_offset_z=-0.003, rotary_inertia_yz=2e-5)
    link, joint = Link("beam", LENGTH, section, rigid=True), Joint("A", "base", "beam")
    slender = 0.8 * LENGTH**3 / 12.0
    expected = np.array([[2e-4, 0.0, 0.0], [0.0, 1e-4, 2e-5], [0.0, 2e-5, 1.2e-4]]) * LENGTH
    expected = expected + np.diag([0.0, slender, slender])
    for plane, turn in (("xz", np.eye(3)), ("xy", np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))):
        model = discretise(Mechanism([link], [joint], driven_joint="A", plane=plane))
        actual = apply_errors(model, assembly_errors(model))
        assert float(actual.mass[0]) == pytest.approx(0.8 * LENGTH, rel=1e-12)
        np.testing.assert_allclose(actual.centre[:, 0], turn @ [LENGTH / 2.0, 0.002, -0.003], atol=1e-15)
        np.testing.assert_allclose(actual.inertia[:, :, 0], turn @ expected @ turn.T, atol=1e-15)


def test_in_the_other_plane_a_section_is_turned_with_its_axes():
    """y of a section lies along the hinges, which are along z of the links there."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    direction = np.array([0.0, 0.3, 1.0])
    one = np.asarray(tip(clamped(ANGLE, force_at(ANGLE, False, tuple(direction)))))
    other = np.asarray(tip(clamped(ANGLE, force_at(ANGLE, False, tuple(turn @ direction)), plane="xy")))
    scale = np.abs(one[:3]).max()
    np.testing.assert_allclose(other[:3], turn @ one[:3], atol=1e-7 * scale)
    np.testing.assert_allclose(other[3:], turn @ one[3:], atol=1e-7 * np.abs(one[3:]).max())


def test_a_tapered_channel_is_twisted_as_the_integral_over_it():
    last = ChannelSection(0.02, 0.03, 0.002, 0.003)
    turn = PointMoment("turn", "beam", (LENGTH, 0, 0), moment=(LOAD, 0, 0), axes="link")
    found = np.asarray(tip(clamped(CHANNEL, [turn], stations=[Station(section=last)])))
    x, weight = np.polynomial.legendre.leggauss(20)
    share = 0.5 * (1.0 + x)
    constants = [ChannelSection(0.03 - 0.01 * s, 0.04 - 0.01 * s, 0.002, 0.003).torsion_constant for s in share]
    expected = LOAD / G * np.sum(0.5 * LENGTH * weight / np.array(constants))
    assert found[3] == pytest.approx(expected, rel=1e-7)


def test_stresses_of_an_angle_are_those_of_its_principal_axes():
    """sigma = M_1 eta_2 / I_1 - M_2 eta_1 / I_2, and the torque about the shear centre."""
    found = static_loads(clamped(ANGLE, force_at(ANGLE, False)), record=("beam.sections",))
    y0, z0 = ANGLE.centroid
    corners = np.array([(y - y0, z - z0) for y, z, _ in ANGLE.edge])
    tensor = np.array([
        [ANGLE.second_moment_z, ANGLE.product_of_inertia], [ANGLE.product_of_inertia, ANGLE.second_moment_y]
    ])  # fmt: skip
    principal, axes = np.linalg.eigh(tensor)  # integrals of squared distances along both axes
    moment = -LOAD * LENGTH  # of a force along z: stresses fall with z
    sigma = sum(moment * axes[1, k] * (corners @ axes[:, k]) / principal[k] for k in range(2))
    tau = ANGLE.shear_centre[0] * LOAD * ANGLE.wall / ANGLE.torsion_constant
    expected = np.sqrt(np.max(sigma**2) + 3.0 * tau**2)
    assert np.asarray(found.stress["beam"]).item() == pytest.approx(expected, rel=1e-6)
    with pytest.raises(InputError, match="must be of a section with sides whose middles are known"):
        found.recorded["beam.sections"].strain("y")


@pytest.mark.parametrize(("section", "across"), [(CHANNEL, "zero"), (ANGLE, "least_norm")])
def test_an_angle_in_motion_has_loads_across_the_plane(section, across):
    """Its product of inertia does not let a planar mechanism of rigid links be its own mirror image."""
    links = [Link(name, length, section, STEEL, rigid=True) for name, length in (("a", 0.1), ("b", 0.3), ("c", 0.3))]
    far = (0.3, 0.0, 0.0)
    joints = [Joint("A", "base", "a"), Joint("B", "a", "b", angle=1.2), Joint("D", "base", "c", position=far)]
    joints.append(Joint("C", "b", "c", cut=True, child_position=far))
    assert discretise(Mechanism(links, joints, driven_joint="A")).topology.across == across


@pytest.mark.long
def test_derivatives_by_sizes_and_stiffnesses():
    """Of two cantilevers at once: sizes of an angle, and a coupling of a laminate."""
    links = [Link("beam", LENGTH, ANGLE, STEEL, rfes=2), Link("spar", LENGTH, laminate(), rfes=2)]
    joints = [Joint(name, "base", name, kind="fixed") for name in ("beam", "spar")]
    forces = [PointForce(f"on_{one.name}", one.name, (LENGTH, 0, 0), force=(0.0, 0.0, 100.0)) for one in links]
    model = discretise(Mechanism(links, joints, forces=forces, gravity=NOTHING))
    names, sizes = ("angle.width", "angle.wall", "laminate.stiffness.45"), np.array([0.04, 0.003, 60.0])

    def deflections(shares):
        errors = dict(zip(names, sizes * shares, strict=True))
        made = designed(model, None, errors)
        elastic = assemble(made.model, made.errors).state.position.elastic
        return 1e3 * jnp.concatenate([elastic[1:4, 0], elastic[1:4, 1]])

    check_derivatives(deflections, np.zeros(3), np.full(3, 1e-5), reverse=1e-8, differences=1e-5, floor=1e-2)


def test_wrong_matrices_are_refused():
    good = np.diag([3e7, 4e6, 3e6, 150.0, 400.0, 900.0])

    def of(matrix):
        return CompositeSection(matrix, 0.8, 2e-4, 1e-4, 1.2e-4)

    skew, indefinite = good.copy(), good.copy()
    skew[3, 4] = 20.0
    indefinite[3, 4] = indefinite[4, 3] = 300.0
    for matrix, words in (
        (skew.tolist(), "must be symmetric, but has 20 in row 4 and column 5"),
        (indefinite.tolist(), "must be positive definite"),
        (good[:5].tolist(), "must be six rows of six numbers"),
        ((-good).tolist(), "row 1, column 1"),
    ):
        with pytest.raises(InputError, match=words):
            of(matrix)
    with pytest.raises(InputError, match="`rotary_inertia_yz` of CompositeSection"):
        CompositeSection(good.tolist(), 0.8, 2e-4, 1e-4, 1.2e-4, rotary_inertia_yz=2e-4)
