"""Forces along links, against beam theory, gravity, and forces at many points."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    DistributedForce,
    GeneralisedAlpha,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointForce,
    PrescribedRate,
    RungeKutta4,
    assemble,
    assembly_errors,
    design,
    discretise,
    parameters,
)
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics.section_loads import loads_of_sections
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.simulation.rest.seen_at_rest import at_rest
from rfem_jax.simulation.simulating import Simulation, simulate
from tests.derivatives import check_derivatives
from tests.mechanisms import arm, body, four_bar, link, released

LENGTH, RIGIDITY, LOAD = 1.0, 1.0, 1e-5
SECTION = GivenSection(1e7, 1e7, 1e7, 1.0, RIGIDITY, RIGIDITY, 1e-9, 2e-13, 1e-13, 1e-13)


def clamped(rfes, *forces, elements="linear"):
    """A beam along x that bends only, without weight."""
    beam = Link("beam", LENGTH, SECTION, rfes=rfes)
    joint = Joint("A", "base", "beam", kind="fixed")
    return discretise(Mechanism([beam], [joint], forces=list(forces), gravity=(0, 0, 0)), elements=elements)


def tip(model, position):
    """Deflection of the end of the beam along z."""
    elastic, last = position.elastic[:, -1], 0.25 * LENGTH / model.topology.n_rfes
    return elastic[2] - last * jnp.sin(elastic[4])


@kernel
def diagrams(model):
    """Places and internal loads of the only link at rest."""
    actual = apply_errors(model, assembly_errors(model))

    def seen(model, actual, state, still, _):
        return loads_of_sections(model, actual, state, still, 0)

    return at_rest(model, actual, {}, seen)[2]


class TestCantilever:
    @pytest.mark.long
    @pytest.mark.parametrize("load, end_load, factor", [(1.0, None, 8.0), (1.0, 0.0, 30.0), (0.0, 1.0, 120.0 / 11.0)])
    def test_deflection_converges_with_the_square_of_the_rfes(self, load, end_load, factor):
        """To q L^4 / (8 E I) of a uniform load, and to that of triangular ones."""
        last = None if end_load is None else (0, 0, -end_load * LOAD)
        wind = DistributedForce("wind", "beam", (0, 0, -load * LOAD), last)
        errors = []
        for rfes in (4, 7):
            model = clamped(rfes, wind)
            assembled = assemble(model, assembly_errors(model), {})
            assert int(assembled.status) == 0
            errors.append(float(tip(model, assembled.state.position)) * factor * RIGIDITY / LOAD / LENGTH**4 + 1.0)
        assert 1e-3 < abs(errors[1]) < 0.03
        np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.02)

    def test_reactions_and_diagrams(self):
        """Of a load that rises from 0.15 to 0.75 of the length, within rfes: exact at all sections."""
        first, last, begin, end = 0.4 * LOAD, 1.3 * LOAD, 0.15, 0.75
        wind = DistributedForce("wind", "beam", (0, 2 * first, -first), (0, 2 * last, -last), begin, end)
        # Forces of no size have sections within rfes beside them.
        model = clamped(4, wind, *(PointForce(f"p{n}", "beam", x, (0, 0, 0)) for n, x in enumerate((0.1, 0.4, 0.9))))
        place, resultants = diagrams(model)
        # On the outer side of the clamp there is nothing.
        outside = (place == 0.0) & np.all(resultants == 0.0, axis=0)
        assert np.sum(outside) == 1
        place, resultants = place[~outside], resultants[:, ~outside]
        assert {0.1, 0.4, 0.9} <= {*np.round(np.asarray(place), 9).tolist()}

        def beyond(x):
            """Force and moment of the load beyond x, by quadrature that is exact."""
            nodes, weights = np.polynomial.legendre.leggauss(3)
            low, half = np.clip(x, begin, end), 0.5 * (end - np.clip(x, begin, end))
            at = low + half * (1.0 + nodes)
            load = first + (last - first) * (at - begin) / (end - begin)
            return np.sum(half * weights * load), np.sum(half * weights * load * (at - x))

        force, moment = np.array([beyond(x) for x in place]).T
        zero = np.zeros_like(force)
        # What the outer part exerts: all of it pulls by 2 along y and by -1 along z.
        expected = np.stack([zero, 2 * force, -force, zero, moment, 2 * moment])
        np.testing.assert_allclose(resultants, expected, rtol=0, atol=2e-5 * LOAD)
        at_clamp = assemble(model, assembly_errors(model), {}).preload["A"]
        force, moment = beyond(0.0)
        np.testing.assert_allclose(at_clamp.force, [0, -2 * force, force], rtol=0, atol=1e-5 * LOAD)
        np.testing.assert_allclose(at_clamp.moment, [0, -moment, -2 * moment], rtol=0, atol=1e-5 * LOAD)

    @pytest.mark.long
    def test_a_follower_in_large_deflections_is_the_sum_of_forces_at_points(self):
        """Two forces at the points of Gauss of each rfe do the same work as a linear load, also where the rfes turn."""
        first, last, elements = np.array([0.3, 0.0, -2.0]), np.array([0.0, 0.5, -4.0]), 4
        wind = DistributedForce("wind", "beam", first, last, axes="link")
        edges = np.concatenate([[0.0], (np.arange(elements) + 0.5) / elements, [1.0]]) * LENGTH
        nodes, weights = np.polynomial.legendre.leggauss(2)
        forces = []
        for i, (low, high) in enumerate(pairwise(edges)):
            for node, weight in zip(nodes, weights, strict=True):
                x = 0.5 * (low + high) + 0.5 * (high - low) * node
                force = 0.5 * (high - low) * weight * (first + x / LENGTH * (last - first))
                forces.append(PointForce(f"p{i}{node > 0}", "beam", x, force, axes="link"))
        one, many = (clamped(elements + 1, *some, elements="geometrically_exact") for some in ([wind], forces))
        along, at_points = (assemble(model, assembly_errors(model), {}) for model in (one, many))
        assert int(along.status) == int(at_points.status) == 0
        assert abs(float(along.state.position.elastic[4, -1])) > 0.3
        np.testing.assert_allclose(along.state.position.elastic, at_points.state.position.elastic, rtol=0, atol=1e-9)
        np.testing.assert_allclose(along.preload["A"].moment, at_points.preload["A"].moment, rtol=0, atol=1e-8)

    @pytest.mark.long
    def test_designs_and_derivatives(self):
        """By all numbers of a load, in both modes: places within rfes, where the derivative is that of the closed form
        of the reaction."""
        model = clamped(4, DistributedForce("wind", "beam", (0, 0, -LOAD), (0, 0, -2 * LOAD), 0.2, 0.7))
        names = ["wind.load.z", "wind.end_load.z", "wind.begin", "wind.end"]
        at = jnp.asarray([parameters(model)[name].value for name in names])
        assert parameters(model)["wind.load.z"].unit == "N/m"

        def answers(numbers):
            changed = designed(model, design(model, dict(zip(names, numbers, strict=True)))).model
            assembled = assemble(changed, assembly_errors(changed), {})
            return jnp.stack([tip(changed, assembled.state.position), assembled.preload["A"].moment[1]]) / LOAD

        steps = np.array([1e-3 * LOAD, 1e-3 * LOAD, 1e-3, 1e-3])
        found = check_derivatives(answers, at, steps, reverse=1e-7, differences=1e-5)

        def moment(numbers):
            first, last, begin, end = numbers
            extent = end - begin
            return extent * (first + last) / 2 * begin + extent**2 * (first / 6 + last / 3)

        np.testing.assert_allclose(found.forward[1] * LOAD, jax.grad(moment)(at), rtol=1e-5)

    def test_a_design_must_leave_it_on_its_link(self):
        model = clamped(3, DistributedForce("wind", "beam", (0, 0, -LOAD), begin=0.2, end=0.7))
        for change in ({"wind.begin": 0.8}, {"wind.end": 1.1}, {"beam.length": 0.6}):
            assert int(designed(model, design(model, change)).status) != 0
        assert int(designed(model, design(model, {"wind.end": 1.0})).status) == 0

    def test_a_longer_link_carries_more(self):
        """A load all along a link has its force per length on the link as it is made; ends move with the link."""
        whole = clamped(3, DistributedForce("wind", "beam", (0, 0, -LOAD)))
        part = clamped(3, DistributedForce("wind", "beam", (0, 0, -LOAD), begin=0.2, end=0.7))
        for model, begin, end in ((whole, 0.0, 1.0), (part, 0.2, 0.7)):
            moment = assemble(model, assembly_errors(model, {"beam.length": 0.1}), {}).preload["A"].moment[1]
            np.testing.assert_allclose(moment, -0.5 * LOAD * 1.1**2 * (end**2 - begin**2), rtol=1e-5)


class TestRigidLinks:
    def test_the_resultant_is_exact(self):
        """On a rigid arm: force and moment of a load that changes its direction along it."""
        first, last, begin, end = np.array([1.0, -2.0, 5.0]), np.array([-3.0, 4.0, 1.0]), 0.05, 0.2
        wind = DistributedForce("wind", "arm", first, last, begin, end)
        joint = Joint("A", "base", "arm", kind="fixed", orientation=(0.1, 0.5, -0.3))
        model = discretise(Mechanism([link("arm", 0.3)], [joint], forces=[wind], gravity=(0, 0, 0)))
        preload = assemble(model, assembly_errors(model), {}).preload["A"]
        force, extent = 0.5 * (first + last) * (end - begin), end - begin
        lever = extent * (0.5 * (first + last) * begin + extent * (first / 6.0 + last / 3.0))
        axes = np.asarray(model.parent_rotation[:, :, 0])
        np.testing.assert_allclose(axes @ preload.force, -force, rtol=0, atol=1e-12)
        np.testing.assert_allclose(axes @ preload.moment, -np.cross(axes[:, 0], lever), rtol=0, atol=1e-12)

    def test_work_of_a_follower(self):
        """q L^2 / 2 times the angle: it is work from outside, and the balance of energies knows it."""
        model = discretise(arm(forces=[DistributedForce("jet", "arm", (0, 0, -30.0), axes="link")], gravity=(0, 0, 0)))
        run = simulate(
            Simulation(
                model=model, drive=PrescribedRate("A", 5.0), duration=0.2, method=RungeKutta4(step=1e-3), save_every=0.1
            )
        )
        done = 30.0 * 0.3**2 / 2.0 * 5.0 * np.asarray(run.times)
        # The drive holds against it: together they do no work on the arm at its constant rate.
        np.testing.assert_allclose(run.forces["jet"].force[-1], 9.0 * np.asarray(across(run)), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(run.motion.drives["A"].force, -30.0 * 0.3**2 / 2.0, rtol=1e-9)
        np.testing.assert_allclose(run.energy.work, 0.0 * done, rtol=0, atol=1e-9)
        assert float(run.checks.energy_balance_error) < 1e-6

    @pytest.mark.parametrize("method", [RungeKutta4(step=2e-4), GeneralisedAlpha(step=1e-4)], ids=lambda one: one.name)
    def test_a_table_with_a_jump_pushes_a_block(self, method):
        """The motion under what is the integral of the load, which begins to push sideways at the jump."""
        rows = [(0, 0, 0), (20, 0, 0), (-10, 50, 0), (-10, 0, 0)]
        push = DistributedForce("push", "one", rows, times=[0.0, 0.1, 0.1, 0.3], begin=0.02)
        joint = Joint("G", "base", "one", kind="prismatic")
        model = discretise(Mechanism([body("one", 0.5)], [joint], forces=[push], gravity=(0, 0, 0)))
        run = released(model, duration=0.2, method=method, save_every=0.05)
        t = np.asarray(run.times)
        rising = 200.0 * 0.08 * t**3 / 6.0
        at, rate = 200.0 * 0.08 * 0.1**3 / 6.0, 200.0 * 0.08 * 0.1**2 / 2.0
        after = at + rate * (t - 0.1) - 0.8 * np.maximum(t - 0.1, 0.0) ** 2 / 2.0
        np.testing.assert_allclose(run.motion.displacements["G"], np.where(t < 0.1, rising, after) / 0.5, atol=2e-8)
        across = 4.0 * (0.3 - t[-2]) / 0.2
        np.testing.assert_allclose(run.loads["G"].force[-2, 1], -across, rtol=1e-6)
        np.testing.assert_allclose(run.forces["push"].force[-2], [-0.8, across, 0.0], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(run.forces["push"].place[:, 0], run.motion.displacements["G"] + 0.06, atol=1e-9)
        assert float(run.checks.energy_balance_error) < 1e-6


def across(run):
    """The direction of -z of the arm at the end of a run, in global axes."""
    angle = float(run.motion.angle[-1])
    return np.array([-np.sin(angle), 0.0, -np.cos(angle)])


@pytest.mark.long
@pytest.mark.parametrize("method", [RungeKutta4(step=1e-5), GeneralisedAlpha(step=1e-3)], ids=lambda one: one.name)
def test_the_weight_of_links_as_a_load_along_them(method):
    """A load of m g per length is gravity: the same motion and loads, and its work is what gravity's energy loses."""
    heavy = four_bar(2)
    density = heavy.links[0].properties.line_density
    weights = [DistributedForce(f"of_{one.name}", one.name, (0, 0, -9.81 * density)) for one in heavy.links]
    light = replace(heavy, gravity=(0.0, 0.0, 0.0), forces=weights)
    settings = {"duration": 0.02, "method": method, "save_every": 0.01}
    one, other = (simulate(Simulation(model=discretise(made), drive=None, **settings)) for made in (heavy, light))
    assert int(one.status) == int(other.status) == 0
    np.testing.assert_allclose(other.motion.angles["A"], one.motion.angles["A"], rtol=0, atol=1e-9)
    for name in one.loads:
        np.testing.assert_allclose(other.loads[name].force, one.loads[name].force, rtol=0, atol=1e-6)
    lost = np.asarray(one.energy.gravity - one.energy.gravity[0])
    assert abs(lost[-1]) > 5e-5
    np.testing.assert_allclose(other.energy.work, -lost, rtol=0, atol=1e-3 * abs(lost[-1]))
    assert float(other.checks.energy_balance_error) < 1e-3
    assert float(other.checks.momentum_balance_error) < 1e-6
