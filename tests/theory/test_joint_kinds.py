"""Mechanisms with joints of other kinds than revolute: balances, methods, derivatives, statics.

Their loads are compared with independent values by the validation (`rfem_jax.validation.slider_cranks`,
`spatial_linkages`), whose mechanisms these are; tests/validation computes its lines.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Joint,
    Link,
    Material,
    Mechanism,
    Method,
    MomentRamp,
    PrescribedRate,
    Rectangle,
    assemble,
    assembly_errors,
    describe,
    discretise,
    simulate,
)
from rfem_jax.mechanics.model import State
from rfem_jax.mechanics.model_with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import equilibrium
from rfem_jax.validation import slider_cranks, spatial_linkages
from rfem_jax.validation.joint_cases import preload_lines
from rfem_jax.validation.lines import PASS
from tests.mechanisms import link, random_state


def slider_crank():
    return discretise(slider_cranks.rigid())


def flexible_coupler(rfes):
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    return Link("coupler", spatial_linkages.SpatialFourBar.COUPLER, Rectangle(0.006, 0.009), steel, rfes=rfes)


def assert_preload(reference, case, assembled):
    assert int(assembled.status) == 0
    lines = preload_lines(reference, case, case, assembled.preload, 1e-8)
    assert lines and [line.name for line in lines if line.verdict != PASS] == []


class TestSliderCrank:
    """The rigid slider-crank at 60 rad/s."""

    def test_derivatives_in_both_modes(self):
        model = slider_crank()
        names = ("G.delta_y", "G.d_z", "rod.length", "C.child.delta_x")

        def loads(values):
            errors = assembly_errors(model, {name: values[i] for i, name in enumerate(names)})
            run = simulate(model, errors, drive=PrescribedRate("A", 60.0), duration=2e-3,
                           method=Method("rk4", step=1e-4), save_every=1e-3)  # fmt: skip
            return jnp.stack([run.metrics.mean_square_force["G"], run.metrics.mean_square_moment["C"]])

        at = jnp.asarray([2e-3, 1e-4, -2e-4, 3e-3])
        forward, backward = jax.jacfwd(loads)(at), jax.jacrev(loads)(at)
        np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-9 * np.abs(forward).max())
        step = 1e-5
        moved = jax.vmap(loads)(at[None] + step * jnp.concatenate([jnp.eye(4), -jnp.eye(4)]))
        differences = ((moved[:4] - moved[4:]) / (2.0 * step)).T
        np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5 * np.abs(forward).max())

    @pytest.mark.parametrize("method", [Method("leapfrog", step=2e-5), Method("tsit5", rtol=1e-9, atol=1e-11),
                                        Method("generalised_alpha", step=1e-4, tolerance=1e-10)],
                             ids=lambda method: method.name)  # fmt: skip
    def test_every_method_follows_the_same_motion(self, method):
        """Under a moment; against Runge and Kutta's with a small step."""
        model, drive = slider_crank(), MomentRamp("A", 2.0, 0.02)

        def end(method):
            run = simulate(model, drive=drive, duration=0.02, method=method, save_every=0.005)
            assert int(run.status) == 0
            return float(run.displacements["G"][-1]), float(run.energy_balance_error)

        (slide, _), (found, balance) = end(Method("rk4", step=5e-5)), end(method)
        assert abs(slide - 0.2597498) > 1e-3
        np.testing.assert_allclose(found, slide, rtol=0, atol=2e-7)
        assert balance < 1e-3


class TestChain:
    """Universal, planar, fixed and spherical joints one behind the other, let go with random rates."""

    METHODS = (
        Method("rk4", step=1e-4),
        Method("leapfrog", step=1e-5),
        Method("tsit5", rtol=1e-9, atol=1e-11),
        Method("generalised_alpha", step=5e-5, tolerance=1e-10),
    )

    def test_every_method_follows_the_same_motion(self):
        kinds = ("universal", "planar", "fixed", "spherical")
        links = [link(kind, 0.1 + 0.02 * n) for n, kind in enumerate(kinds)]
        parents = ("base", *kinds)
        joints = [Joint(f"J{n}", parents[n], kind, kind=kind) for n, kind in enumerate(kinds)]
        model = discretise(Mechanism(links, joints))
        start = State(model.start_coordinates(), random_state(model, np.random.default_rng(3)).velocity)
        runs = [
            simulate(model, start=start, drive=None, duration=5e-3, method=method, save_every=5e-3)
            for method in self.METHODS
        ]
        assert [int(run.status) for run in runs] == [0, 0, 0, 0]
        assert max(float(run.energy_balance_error) for run in runs) < 1e-4
        first, *others = [np.asarray(run.positions.joints)[-1] for run in runs]
        assert np.abs(first - np.asarray(start.position.joints)).max() > 1e-2
        for run, found in zip(runs[1:], others, strict=True):
            np.testing.assert_allclose(found, first, rtol=0, atol=1e-6)
            for joint in ("J0", "J2"):
                force = np.asarray(runs[0].loads[joint].force)[-1]
                np.testing.assert_allclose(run.loads[joint].force[-1], force, rtol=0, atol=1e-3 * np.abs(force).max())


class TestUniversal:
    """Revolute, spherical, universal, revolute with a moment ramp from rest."""

    def test_preload_of_a_flexible_coupler_on_a_spherical_joint_of_the_tree(self):
        model = discretise(spatial_linkages.rsur_flexible())
        assert_preload(spatial_linkages.REFERENCE, "RSUR flexible", assemble(model, assembly_errors(model)))

    def test_derivatives_of_an_implicit_run_with_a_quaternion(self):
        mechanism = spatial_linkages.rsur_flexible(rfes=2)
        model = discretise(mechanism, elements="linear")
        names = ("B.d_y", "C.child.delta_y", "coupler.length")

        def load(values):
            errors = assembly_errors(model, {name: values[i] for i, name in enumerate(names)})
            method = Method("generalised_alpha", step=1e-3, tolerance=1e-8)
            run = simulate(
                model, errors, drive=PrescribedRate("A", 25.0), duration=5e-3, method=method, save_every=5e-3
            )
            return run.metrics.mean_square_force["D"]

        at = jnp.asarray([2e-4, 3e-3, -1e-4])
        forward, backward = jax.jacfwd(load)(at), jax.grad(load)(at)
        largest = np.abs(forward).max()
        np.testing.assert_allclose(forward, backward, rtol=1e-8, atol=1e-9 * largest)
        step = 1e-6
        moved = jax.vmap(load)(at[None] + step * jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
        np.testing.assert_allclose(forward, (moved[:3] - moved[3:]) / (2.0 * step), rtol=1e-4, atol=1e-6 * largest)


class TestTwoSphericalJoints:
    """Revolute, spherical, spherical, revolute at a constant rate: the coupler's spin about its axis is idle."""

    def test_the_coupler_is_idle(self):
        structure = describe(discretise(spatial_linkages.rssr()))
        assert structure.idle == ("coupler",) and structure.mobility == 2

    @pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
    def test_statics_holds_the_idle_freedom_of_a_flexible_coupler(self, elements):
        mechanism = spatial_linkages.rssr(flexible_coupler(rfes=2))
        model = discretise(mechanism, elements=elements)
        assert [model.topology.link_of_freedom[k] for k in model.topology.idle] == [model.link_names.index("coupler")]

        def preload(longer):
            assembled = assemble(model, assembly_errors(model, {"coupler.length": longer}))
            return assembled.preload["A"].moment, assembled

        forward, assembled = jax.jacfwd(preload, has_aux=True)(1e-4)
        assert int(assembled.status) == 0
        # What holds it against the weight of the bent rod, which is off the line of the balls by micrometres.
        assert np.abs(assembled.preload["B"].moment).max() < 1e-4 * np.abs(assembled.preload["A"].moment).max()
        ahead, behind = preload(1e-4 + 1e-6)[0], preload(1e-4 - 1e-6)[0]
        np.testing.assert_allclose(forward, (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-8)


@pytest.fixture(scope="module")
def model():
    return discretise(slider_cranks.flexible())


class TestGuideErrors:
    """Slider-crank with a flexible rod (geometrically exact elements), guide and wrist pin tilted: assembly."""

    def test_preload(self, model):
        assembled = assemble(model, assembly_errors(model, slider_cranks.ERRORS))
        assert_preload(slider_cranks.REFERENCE, "moment", assembled)
        # The guide is free along its own, tilted axis.
        assert abs(float(assembled.preload["G"].force[0])) < 1e-9

    def test_derivative_of_the_preload(self, model):
        def preload(value):
            errors = assembly_errors(model, {**slider_cranks.ERRORS, "G.delta_y": value})
            return assemble(model, errors).preload["G"].moment

        forward, backward = jax.jacfwd(preload)(1e-3), jax.jacrev(preload)(1e-3)
        np.testing.assert_allclose(forward, backward, rtol=1e-8, atol=1e-8 * np.abs(forward).max())
        step = 1e-5
        differences = (preload(1e-3 + step) - preload(1e-3 - step)) / (2.0 * step)
        np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5 * np.abs(forward).max())

    def test_a_slide_that_is_held_stays_where_it_is(self, model):
        actual = apply_errors(model, assembly_errors(model))
        k = model.topology.coordinates[model.link_names.index("piston")][0]
        position, _, status = jax.jit(lambda x: equilibrium(model, actual, {k: x}))(jnp.asarray(0.272))
        assert int(status) == 0
        np.testing.assert_allclose(position.joints[k], 0.272, rtol=0, atol=1e-14)
        crank = float(position.joints[0])
        rigid = 0.06 * np.cos(crank) + np.sqrt(0.25**2 - (0.06 * np.sin(crank)) ** 2)
        np.testing.assert_allclose(rigid, 0.272, rtol=0, atol=1e-6)
