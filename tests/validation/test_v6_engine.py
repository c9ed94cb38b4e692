"""The engine of six cylinders against Lagrange's equation of its one freedom, written down here from its drawing."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Coordinates, State, assembly_errors, discretise
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.validation import v6_engine as engine
from tests.evaluation import evaluated

BOX = 7700.0 * 0.02  # kg/m^2, of boxes 20 mm wide
PISTON = 7700.0 * np.pi * 0.05**2 * 0.1
ROD, ROD_INERTIA = BOX * 0.22 * 0.06, BOX * 0.22 * 0.06 * (0.22**2 + 0.06**2) / 12.0
WEB = BOX * 0.1 * 0.05
SHAFT = 1.0 + 6.0 * (
    7700.0 * np.pi * 0.12 * (0.025**4 + 0.015**4) / 2.0
    + 7700.0 * np.pi * 0.12 * 0.015**2 * 0.1**2
    + 2.0 * (WEB * (0.1**2 + 0.05**2) / 12.0 + WEB * 0.05**2)
)


def derivatives(angle):
    """First and second derivatives by the crank's angle of piston, rod's centre along and across, rod's lean."""
    c, s = np.cos(angle), np.sin(angle)
    lean, upright = 0.5 * s, np.sqrt(1.0 - 0.25 * s**2)
    first = 0.5 * c / upright
    second = (-0.5 * s + lean * first**2) / upright
    bend = upright * first**2 + lean * second
    return (
        np.array([-0.1 * s - 0.2 * lean * first, -0.1 * s - 0.09 * lean * first, 0.055 * c, first]),
        np.array([-0.1 * c - 0.2 * bend, -0.1 * c - 0.09 * bend, -0.055 * s, second]),
    )


def lagrange(rate):
    """Acceleration of the shaft at the start [rad/s^2]."""
    firing = engine.PINS - engine.CYLINDERS
    masses = np.array([PISTON, ROD, ROD, ROD_INERTIA])
    inertia, by_angle, work = SHAFT, 0.0, -100.0 * (rate / 200.0) ** 2
    for angle, inclination in zip(firing, engine.CYLINDERS, strict=True):
        first, second = derivatives(angle)
        inertia += masses @ first**2
        by_angle += 2.0 * masses @ (first * second)
        place = 0.1 * np.cos(angle) + np.sqrt(0.2**2 - (0.1 * np.sin(angle)) ** 2)
        work += float(engine.gas_force(place, first[0] * rate)) * first[0]
        up = PISTON * first[0] + ROD * first[1]
        work -= 9.80665 * (up * np.cos(inclination) - ROD * first[2] * np.sin(inclination))
    return (work - 0.5 * by_angle * rate**2) / inertia


def placed_rates(model, rate):
    """Rates of all joints at the start, from the closed form of each cylinder."""
    values = dict.fromkeys(model.topology.joints[: model.topology.n_links], 0.0)
    values["A"] = rate
    for number, angle in enumerate(engine.PINS - engine.CYLINDERS, 1):
        first = derivatives(angle)[0]
        values[f"G{number}"] = first[0] * rate
        values[f"C{number}"] = -first[3] * rate
    found = np.zeros(model.topology.n_freedoms)
    for name, value in values.items():
        found[model.topology.coordinates[model.topology.joints.index(name)].start] = value  # rotations come first
    return jnp.asarray(found)


@pytest.mark.parametrize("rate", [10.0, 564.0])
def test_acceleration_is_that_of_lagranges_equation(rate):
    model = discretise(engine.mechanism())
    rest = model.start_coordinates()
    state = State(rest, Coordinates(placed_rates(model, rate), jnp.zeros_like(rest.elastic)))
    actual = apply_errors(model, assembly_errors(model))

    def shaft(state):
        found = accelerations(actual, state, DriveInput({}), Stabilisation(0.0, 0.0, 1.0))
        return found.coordinates.joints[model.topology.joints.index("A")]

    assert float(evaluated(shaft)(state)) == pytest.approx(lagrange(rate), rel=1e-8)
