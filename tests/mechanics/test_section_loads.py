"""Internal loads of moving links: of springs, and from the links' ends, equal to the sum of all that acts beyond."""

import dataclasses
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Circle, DistributedForce, PointForce, PointMass, Rectangle, Station, discretise
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics import energy_and_momentum, loads
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.dynamics.section_loads import loads_of_sections
from rfem_jax.mechanics.kinematics.motion import all_frames
from rfem_jax.mechanics.laws.frame_forces import Time
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation.outcome.observation import solved_instant
from tests.mechanics.test_formulations import close
from tests.mechanisms import random_state, slender, some_errors, two_loop_six_bar, with_stations

LINKS = {"rocker": 4, "arm": 3, "output": 1}  # with their rfes
STEP = 1e-10  # m
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(4)


def six_bar():
    """A joint and a force in the middle of the rocker, point masses beside its axis and on the rigid output link."""
    mechanism = two_loop_six_bar()
    mass = PointMass(0.3, (0.21, 0.01, -0.02), (1e-5, 2e-5, 3e-5))
    heavy = {"rocker": (mass,), "output": (dataclasses.replace(mass, position=(0.1, 0.02, 0.01)),)}
    links = [dataclasses.replace(one, point_masses=heavy.get(one.name, ())) for one in mechanism.links]
    push = PointForce("push", "rocker", (0.17, 0.005, 0.0), force=(11.0, -7.0, 5.0))
    lines = [
        DistributedForce("wind", "rocker", (900.0, -300.0, 500.0), (-100.0, 700.0, 200.0), begin=0.02, axes="link"),
        DistributedForce("snow", "rocker", (50.0, 30.0, -800.0), end=0.17),
        DistributedForce("water", "output", (0.0, 200.0, -300.0), (0.0, 0.0, 500.0), begin=0.03, end=0.09),
    ]
    return dataclasses.replace(mechanism, links=tuple(links), forces=(push, *lines))


BAR_MASS, THIN = 7850.0, Rectangle(0.004, 0.007)
STATIONS = {
    "uniform": {},
    "tapered": {
        "rocker": [Station(0.12, THIN, after=Circle(0.009)), Station(0.21, after=THIN)],
        "output": [Station(0.1, THIN), Station(section=Rectangle(0.01, 0.005))],
    },
}


def along(shape, name, x):
    """Line density [kg/m] and rotary inertias (3,) [kg m] of a link at a place of its description, bars of the tests
    and sections of their stations by hand."""
    width, height = 0.01, 0.01
    if shape == "tapered" and name == "rocker":
        if x < 0.12:
            width, height = 0.01 - 0.006 * x / 0.12, 0.01 - 0.003 * x / 0.12
        elif x < 0.21:
            second = np.pi * 0.009**4 / 64.0
            return BAR_MASS * np.pi * 0.009**2 / 4.0, BAR_MASS * second * np.array([2.0, 1.0, 1.0])
        else:
            width, height = 0.004, 0.007
    if shape == "tapered" and name == "output":
        share = x / 0.1 if x < 0.1 else (x - 0.1) / 0.15
        width = 0.01 - 0.006 * share if x < 0.1 else 0.004 + 0.006 * share
        height = 0.01 - 0.003 * share if x < 0.1 else 0.007 - 0.002 * share
    y, z = width * height**3 / 12.0, height * width**3 / 12.0
    return BAR_MASS * width * height, BAR_MASS * np.array([y + z, y, z])


@pytest.fixture(scope="module", params=[*STATIONS, "slender"])
def moving(request):
    """The model, and of one random closed state: errors applied, the solved instant, and all section loads."""
    shape = "tapered" if request.param == "slender" else request.param
    mechanism = with_stations(six_bar(), **STATIONS[shape])
    if request.param == "slender":
        mechanism = slender(mechanism)
    model = discretise(mechanism, elements="geometrically_exact")
    rng = np.random.default_rng(3)
    errors, state = some_errors(model, rng), random_state(model, rng, 0.3)
    # Joints at the ends of links stay at these.
    along = model.topology.error_components.index("d_x")
    errors = eqx.tree_at(
        lambda e: (e.seat, e.bore), errors, tuple(e.at[along].set(0.0) for e in (errors.seat, errors.bore))
    )

    def solved(errors, state):
        actual = apply_errors(model, errors)
        drive = DriveInput({model.topology.driven_coordinate: jnp.asarray(1.7)}, {}, Time(0.2, 0.1))
        state = close(actual, impose(model.topology, state, drive))
        result = accelerations(actual, state, drive, Stabilisation(3.0, 7.0, 0.3))
        now = solved_instant(actual, result, drive, jnp.asarray(0.3))
        inertial = loads.inertial_loads(actual, now.motion, now.angular, now.linear)
        frames = all_frames(model.topology, now.motion), energy_and_momentum.velocities(actual, now.motion)[3]
        names = {name: model.topology.links.index(name) for name in LINKS}
        sections = {name: loads_of_sections(model, actual, state, now, l) for name, l in names.items()}
        return actual, now, inertial, frames, sections

    return model, kernel(solved)(errors, state), shape


def wrench(moment, force, place):
    return np.concatenate([moment + np.cross(place, force), force])


def beyond(model, out, name, x, shape):
    """Wrench at the global origin that the part beyond x of a link exerts on the rest: loads there less its inertia."""
    actual, now, (force, moment), ((rotation, point), spin), _ = out
    topology, l = model.topology, model.topology.links.index(name)
    n, (a, _) = LINKS[name], topology.ranges[l]
    axes = rotation[:, :, l]
    length = float(actual.beam_middle[l]) * (2 if n == 1 else 4 * (n - 1))
    edges = np.concatenate([[0.0], (np.arange(n - 1) + 0.5) / max(n - 1, 1), [1.0]]) * length
    middles = np.concatenate([[0.0], 0.5 * (edges[1:-1] + edges[2:])])  # reference points
    total = np.zeros(6)
    for i in range(n):
        node = l if i == 0 else topology.n_links + a + i - 1
        if edges[i] >= x:  # the whole rfe, with its point masses
            total += wrench(axes @ moment[:, node], axes @ force[:, node], point[:, node])
        elif edges[i + 1] > x:  # a part of it: by quadrature along the axis
            alpha, linear, w = axes @ now.angular[:, node], axes @ now.linear[:, node], spin[:, node]
            R = rotation[:, :, node]

            def momentum(mass, centre, inertia):
                arm = R @ centre
                acceleration = linear + np.cross(alpha, arm) + np.cross(w, np.cross(w, arm))
                turned = R @ inertia @ R.T
                couple = turned @ alpha + np.cross(w, turned @ w)
                return wrench(couple, mass * (acceleration - actual.gravity), point[:, node] + arm)

            scale = length / float(model.length[l])
            steps = [place * scale for place in (0.1, 0.12, 0.21) if x < place * scale < edges[i + 1]]
            for low, high in pairwise([x, *steps, edges[i + 1]]):
                half = 0.5 * (high - low)
                for s, weight in zip(low + half * (1 + POINTS), half * WEIGHTS):
                    density, rotary = along(shape, name, s / scale)
                    total += momentum(weight * density, np.array([s - middles[i], 0, 0]), np.diag(rotary) * weight)
            for k, holder in enumerate(topology.masses):
                place = np.asarray(model.point_position[:, k]) * [length / model.length[l], 1, 1]
                if holder == node and middles[i] + place[0] > x:
                    total += momentum(model.point_mass[k], place, np.diag(model.point_inertia[:, k]))
    for j, one in enumerate(now.wrenches):
        for node, place, sign in (
            (topology.parents[j], actual.seat_position, -1.0),
            (topology.children[j], actual.bore_position, 1.0),
        ):
            total -= sign * one * is_beyond(topology, l, node, place[0, j], middles, a, x)
    for key, element in actual.frame_forces.elements.items():
        exerted = now.frame_loads.exerted[key]
        on = is_beyond(topology, l, element.child.node, element.child.position[0], middles, a, x)
        total -= wrench(exerted.moment, exerted.force, exerted.place) * on
    for one in six_bar().forces:
        if isinstance(one, DistributedForce) and one.link == name:
            nodes = [l, *(topology.n_links + a + i for i in range(n - 1))]
            total -= of_line(one, x, length / float(model.length[l]), (edges, middles), (rotation, point, nodes))
    return -total


def of_line(one, x, scale, along, placed):
    """Wrench at the global origin of the part of a described load beyond x, by quadrature over each rfe."""
    (edges, middles), (rotation, point, nodes) = along, placed
    begin = scale * (one.begin or 0.0)
    end = edges[-1] if one.end is None else scale * one.end
    total, last = np.zeros(6), one.load if one.end_load is None else one.end_load
    for i, (low, high) in enumerate(pairwise(edges)):
        node = nodes[i]
        low, high = np.clip([max(low, x), high], begin, end)
        half = 0.5 * max(high - low, 0.0)
        for s, weight in zip(low + half * (1 + POINTS), half * WEIGHTS):
            share = (s - begin) / (end - begin)
            force = weight * ((1.0 - share) * np.array(one.load) + share * np.array(last))
            force = rotation[:, :, node] @ force if one.axes == "link" else force
            total += wrench(0.0, force, point[:, node] + (s - middles[i]) * rotation[:, 0, node])
    return total


def is_beyond(topology, l, node, place, middles, a, x):
    if node < 0 or topology.link_of(node) != l:
        return 0.0
    i = 0 if node < topology.n_links else node - topology.n_links - a + 1
    return 1.0 if middles[i] + place > x else 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", LINKS)
def test_loads_of_sections_are_what_the_rest_of_the_link_exerts(moving, name):
    model, out, shape = moving
    actual, _, _, ((rotation, point), _), sections = out
    place, found = sections[name]
    n, l = LINKS[name], model.topology.links.index(name)
    first = model.topology.n_links + model.topology.ranges[l][0]
    free = first - model.topology.n_links
    scale, matched = np.abs(found).max(axis=1) + np.abs(found).max() * 1e-3, []
    assert len(place) > n + 2
    for s, x in enumerate(place):
        if s < n - 1:  # a sde, midway between the faces of two rfes: resultants of any axes
            sides = [l if s == 0 else first + s - 1, first + s]
            levers = [
                actual.lever_left[s + free] + (actual.beam_middle[l] if s == 0 else 0.0),
                actual.lever_right[s + free],
            ]
            at = np.mean([point[:, k] + rotation[:, 0, k] * v for k, v in zip(sides, levers)], axis=0)
            expected = beyond(model, out, name, x, shape)
            force, moment = expected[3:], expected[:3] - np.cross(at, expected[3:])
            for found_part, part in ((found[:3, s], force), (found[3:, s], moment)):
                assert np.linalg.norm(found_part) == pytest.approx(np.linalg.norm(part), rel=1e-7)
            continue
        # Just before or just behind what acts there; two of these are neighbours in the list.
        i = min(range(n), key=lambda i: abs(x - (0 if i == 0 else actual.rest[free + i - 1])))
        node, middle = (l, 0.0) if i == 0 else (first + i - 1, actual.rest[free + i - 1])
        at = point[:, node] + rotation[:, 0, node] * (x - middle)
        errors = []
        for side in (-STEP, STEP):
            expected = beyond(model, out, name, x + side, shape)
            force, moment = expected[3:], expected[:3] - np.cross(at, expected[3:])
            turned = np.concatenate([rotation[:, :, node].T @ force, rotation[:, :, node].T @ moment])
            errors.append(np.abs((found[:, s] - turned) / scale).max())
        matched.append(int(np.argmin(errors)))
        assert min(errors) < 1e-6
    if shape == "tapered":
        return  # places tell already on which side of a step they are
    # Both sides of everything that acts, in pairs.
    pairs = matched[: len(matched) - (7 if n == 1 else 0)]
    assert all({a, b} == {0, 1} for a, b in zip(pairs[::2], pairs[1::2]))
