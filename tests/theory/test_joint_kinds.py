"""Mechanisms with joints of other kinds than revolute: balances, methods, derivatives, statics.

Their loads are compared with independent values by the validation (`rfem_jax.validation.slider_cranks`,
`spatial_linkages`), whose mechanisms these are; tests/validation computes its lines.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Explicit,
    GeneralisedAlpha,
    Joint,
    Leapfrog,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    PrescribedRate,
    Rectangle,
    RungeKutta4,
    Simulation,
    State,
    assemble,
    assembly_errors,
    describe,
    discretise,
    simulate,
)
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.settling import equilibrium
from rfem_jax.validation import slider_cranks, spatial_linkages
from rfem_jax.validation.joint_cases import preload_lines
from rfem_jax.validation.lines import PASS
from tests.derivatives import check_derivatives, jacobians
from tests.mechanisms import BAR, STEEL, link, loop_cut_by, random_state


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

    @pytest.mark.long
    def test_derivatives_in_both_modes(self):
        model = slider_crank()
        names = ("G.delta_y", "G.d_z", "rod.length", "C.child.delta_x")

        def loads(values):
            errors = assembly_errors(model, {name: values[i] for i, name in enumerate(names)})
            run = simulate(
                Simulation(
                    model,
                    drive=PrescribedRate("A", 60.0),
                    duration=2e-3,
                    method=RungeKutta4(step=1e-4),
                    save_every=1e-3,
                ),
                errors,
            )
            return jnp.stack([run.metrics.mean_square_force["G"], run.metrics.mean_square_moment["C"]])

        check_derivatives(loads, [2e-3, 1e-4, -2e-4, 3e-3], 1e-5, reverse=1e-9, differences=1e-5, floor=1.0)

    @pytest.mark.slow
    @pytest.mark.parametrize("method", [Leapfrog(step=2e-5), Explicit("tsit5", rtol=1e-9, atol=1e-11),
                                        GeneralisedAlpha(step=1e-4, tolerance=1e-10)],
                             ids=lambda method: method.name)  # fmt: skip
    def test_every_method_follows_the_same_motion(self, method):
        """Under a moment; against Runge and Kutta's with a small step."""
        model, drive = slider_crank(), MomentRamp("A", 2.0, 0.02)

        def end(method):
            run = simulate(Simulation(model, drive=drive, duration=0.02, method=method, save_every=0.005))
            assert int(run.status) == 0
            return float(run.motion.displacements["G"][-1]), float(run.checks.energy_balance_error)

        (slide, _), (found, balance) = end(RungeKutta4(step=5e-5)), end(method)
        assert abs(slide - 0.2597498) > 1e-3
        np.testing.assert_allclose(found, slide, rtol=0, atol=2e-7)
        assert balance < 1e-3


class TestChain:
    """Universal, planar, fixed and spherical joints one behind the other, let go with random rates."""

    METHODS = (
        RungeKutta4(step=1e-4),
        Leapfrog(step=1e-5),
        Explicit("tsit5", rtol=1e-9, atol=1e-11),
        GeneralisedAlpha(step=5e-5, tolerance=1e-10),
    )

    @pytest.mark.long
    def test_every_method_follows_the_same_motion(self):
        kinds = ("universal", "planar", "fixed", "spherical")
        links = [link(kind, 0.1 + 0.02 * n) for n, kind in enumerate(kinds)]
        parents = ("base", *kinds)
        joints = [Joint(f"J{n}", parents[n], kind, kind=kind) for n, kind in enumerate(kinds)]
        model = discretise(Mechanism(links, joints))
        start = State(model.start_coordinates(), random_state(model, np.random.default_rng(3)).velocity)
        runs = [
            simulate(Simulation(model, start=start, drive=None, duration=5e-3, method=method, save_every=5e-3))
            for method in self.METHODS
        ]
        assert [int(run.status) for run in runs] == [0, 0, 0, 0]
        assert max(float(run.checks.energy_balance_error) for run in runs) < 1e-4
        first, *others = [np.asarray(run.motion.positions.joints)[-1] for run in runs]
        assert np.abs(first - np.asarray(start.position.joints)).max() > 1e-2
        for run, found in zip(runs[1:], others, strict=True):
            np.testing.assert_allclose(found, first, rtol=0, atol=1e-6)
            for joint in ("J0", "J2"):
                force = np.asarray(runs[0].loads[joint].force)[-1]
                np.testing.assert_allclose(run.loads[joint].force[-1], force, rtol=0, atol=1e-3 * np.abs(force).max())


PLATE, BLOCK, WEIGHT, SLID = 0.2, 0.1, (2.0, -9.0, 3.0), 0.04  # m, m, N/kg, s
PLACE, OF_PLATE, OF_BLOCK = (0.1, 0.2, -0.1), (0.12, 0.01, 0.03), (0.02, 0.005, -0.01)  # of the joints


def rotated(x, y, z):
    """R_z R_y R_x."""
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(jnp.stack([x, y, z])), jnp.sin(jnp.stack([x, y, z]))
    none, one = jnp.zeros_like(x), jnp.ones_like(x)
    about_x = jnp.array([[one, none, none], [none, cx, -sx], [none, sx, cx]])
    about_y = jnp.array([[cy, none, sy], [none, one, none], [-sy, none, cy]])
    return jnp.array([[cz, -sz, none], [sz, cz, none], [none, none, one]]) @ about_y @ about_x


def block_on_a_plate(errors):
    """Closed form: how far a block slid from rest, its load in the axes of the plane, the plate's in those of its seat.

    A plane pushes only across itself, so that the block does not turn; `errors` are values by name."""

    def side(name):
        shift, turn = ([errors.get(f"{name}.{kind}_{axis}", 0.0) for axis in "xyz"] for kind in ("d", "delta"))
        return jnp.stack([jnp.asarray(x) for x in shift]), rotated(*(jnp.asarray(x) for x in turn))

    (_, seat), (of_plate, bore), (raised, plane), (of_block, held) = map(side, ("F", "F.child", "L", "L.child"))
    density = BAR.area * STEEL.density
    weights = [density * length * jnp.asarray(WEIGHT) for length in (PLATE, BLOCK)]
    slope = seat @ bore.T @ plane
    along = slope.T @ weights[1]
    moved = 0.5 * SLID**2 * along / (density * BLOCK) * jnp.array([1.0, 0.0, 1.0])
    force = -along * jnp.array([0.0, 1.0, 0.0])
    moment = jnp.cross(held.T @ (jnp.array([BLOCK / 2.0, 0.0, 0.0]) - jnp.asarray(OF_BLOCK) - of_block), force)
    on_plate = bore.T @ plane @ jnp.stack([force, moment])[..., None]
    place = bore.T @ (jnp.asarray(OF_PLATE) + raised + plane @ moved - of_plate)
    middle = bore.T @ (jnp.array([PLATE / 2.0, 0.0, 0.0]) - of_plate)
    weight = seat.T @ weights[0]
    return jnp.stack([
        moved[0], moved[2], *force, *moment, *(on_plate[0, :, 0] - weight),
        *(jnp.cross(place, on_plate[0, :, 0]) + on_plate[1, :, 0] - jnp.cross(middle, weight)),
    ])  # fmt: skip


class TestPlanarAndFixed:
    """These two kinds in the tree and cut: derivatives by their errors, in both modes."""

    @pytest.mark.long
    def test_a_block_that_slides_on_a_plate(self):
        joints = [
            Joint("F", "base", "plate", kind="fixed", position=PLACE),
            Joint("L", "plate", "block", kind="planar", position=OF_PLATE, child_position=OF_BLOCK),
        ]
        model = discretise(Mechanism([link("plate", PLATE), link("block", BLOCK)], joints, gravity=WEIGHT))
        names = [name for name in model.topology.error_names if name[0] in "FL"]
        at = jnp.asarray(np.random.default_rng(5).uniform(-0.1, 0.1, len(names)))
        start = static_state(model.topology, model.start_coordinates())

        def ends(values):
            errors = assembly_errors(model, dict(zip(names, values)))
            run = simulate(
                Simulation(
                    model, drive=None, duration=SLID, method=RungeKutta4(step=SLID / 2.0), save_every=SLID, start=start
                ),
                errors,
            )
            loads = [getattr(run.loads[joint], key)[-1] for joint in "LF" for key in ("force", "moment")]
            found = jnp.concatenate([run.motion.displacements["L"][-1], *loads])
            return found, found

        def known(values):
            return block_on_a_plate(dict(zip(names, values)))

        (forward, found), backward = jax.jacfwd(ends, has_aux=True)(at), jax.jacrev(ends, has_aux=True)(at)[0]
        expected = jax.jacfwd(known)(at)
        assert len(names) == 18
        np.testing.assert_allclose(found, known(at), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(forward, expected, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(backward, expected, rtol=1e-9, atol=1e-11)
        # Each counts but shifts of the seat on the base, which move everything alike.
        counted = np.abs(expected).max(axis=0) > 1e-6
        assert [name for name, one in zip(names, counted) if not one] == ["F.d_x", "F.d_y", "F.d_z"]

    @pytest.mark.long
    def test_preload_of_loops_that_they_cut(self):
        loop = loop_cut_by("planar")
        joints = [
            *loop.joints,
            Joint("E", "base", "prop", position=(0.2, 0.0, 0.2), angle=np.pi / 2),
            Joint("F", "left", "prop", cut=True, kind="fixed", position=(0.2, 0.0, 0.0),
                  child_orientation=(0.0, -np.pi / 2, 0.0)),
        ]  # fmt: skip
        model = discretise(Mechanism([*loop.links, link("prop", 0.2)], joints))
        names = ("C.delta_x", "C.child.d_y", "F.delta_y", "F.d_x", "F.child.delta_z")

        def preload(values):
            found = assemble(model, assembly_errors(model, dict(zip(names, values)))).preload
            return jnp.concatenate([found["C"].force, found["F"].moment])

        _, forward, backward, differences = jacobians(preload, [2e-3, 1e-4, -1e-3, 2e-4, -3e-3], 1e-6)
        largest = np.abs(forward).max(axis=0)
        assert np.all(largest > 1.0)
        np.testing.assert_allclose(backward / largest, forward / largest, rtol=0, atol=1e-8)
        np.testing.assert_allclose(differences / largest, forward / largest, rtol=0, atol=1e-6)


class TestUniversal:
    """Revolute, spherical, universal, revolute with a moment ramp from rest."""

    @pytest.mark.slow
    def test_preload_of_a_flexible_coupler_on_a_spherical_joint_of_the_tree(self):
        model = discretise(spatial_linkages.rsur_flexible())
        assert_preload(spatial_linkages.REFERENCE, "RSUR flexible", assemble(model, assembly_errors(model)))

    @pytest.mark.long
    def test_derivatives_of_an_implicit_run_with_a_quaternion(self):
        mechanism = spatial_linkages.rsur_flexible(rfes=2)
        model = discretise(mechanism, elements="linear")
        names = ("B.d_y", "C.child.delta_y", "coupler.length")

        def load(values):
            errors = assembly_errors(model, {name: values[i] for i, name in enumerate(names)})
            method = GeneralisedAlpha(step=1e-3, tolerance=1e-8)
            run = simulate(
                Simulation(model, drive=PrescribedRate("A", 25.0), duration=5e-3, method=method, save_every=5e-3),
                errors,
            )
            return run.metrics.mean_square_force["D"]

        check_derivatives(load, [2e-4, 3e-3, -1e-4], 1e-6, reverse=1e-8, differences=1e-4, floor=0.01)


class TestTwoSphericalJoints:
    """Revolute, spherical, spherical, revolute at a constant rate: the coupler's spin about its axis is idle."""

    def test_the_coupler_is_idle(self):
        structure = describe(discretise(spatial_linkages.rssr()))
        assert structure.idle == ("coupler",) and structure.mobility == 2

    @pytest.mark.long
    @pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
    def test_statics_holds_the_idle_freedom_of_a_flexible_coupler(self, elements):
        mechanism = spatial_linkages.rssr(flexible_coupler(rfes=2))
        model = discretise(mechanism, elements=elements)
        assert [model.topology.link_of_freedom[k] for k in model.topology.idle] == [model.link_names.index("coupler")]

        def preload(longer):
            assembled = assemble(model, assembly_errors(model, {"coupler.length": longer}))
            return assembled.preload["A"].moment, assembled

        with_slope = jax.jit(lambda longer: jax.jvp(preload, (longer,), (1.0,), has_aux=True))
        _, forward, assembled = with_slope(1e-4)
        assert int(assembled.status) == 0
        # What holds it against the weight of the bent rod, which is off the line of the balls by micrometres.
        assert np.abs(assembled.preload["B"].moment).max() < 1e-4 * np.abs(assembled.preload["A"].moment).max()
        ahead, behind = with_slope(1e-4 + 1e-6)[0], with_slope(1e-4 - 1e-6)[0]
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

    @pytest.mark.long
    def test_derivative_of_the_preload(self, model):
        def preload(value):
            errors = assembly_errors(model, {**slider_cranks.ERRORS, "G.delta_y": value})
            return assemble(model, errors).preload["G"].moment

        check_derivatives(preload, 1e-3, 1e-5, reverse=1e-8, differences=1e-5, floor=1.0)

    @pytest.mark.slow
    def test_a_slide_that_is_held_stays_where_it_is(self, model):
        actual = apply_errors(model, assembly_errors(model))
        k = model.topology.coordinates[model.link_names.index("piston")][0]
        position, _, status = jax.jit(lambda x: equilibrium(model, actual, {k: x}))(jnp.asarray(0.272))
        assert int(status) == 0
        np.testing.assert_allclose(position.joints[k], 0.272, rtol=0, atol=1e-14)
        crank = float(position.joints[0])
        rigid = 0.06 * np.cos(crank) + np.sqrt(0.25**2 - (0.06 * np.sin(crank)) ** 2)
        np.testing.assert_allclose(rigid, 0.272, rtol=0, atol=1e-6)
