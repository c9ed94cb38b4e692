"""EngineV6 of the Modelica library: six cylinders on a crankshaft, run up by gas forces against a brake.

Place in the pipeline: a mechanism of `published_linkages`.

The library's axes x, y, z are here y, z, x, as of its Engine1a; offsets of the cylinders along the shaft do nothing to
a rigid engine with one freedom and are left out. The planar loops have a spherical crank pin and a cylindrical wrist
pin. Gas pushes by a polynomial of the piston's place, one as it rises and another as it falls, which differ at the
upper dead centre: there the piston stands still, so that the force jumps and its power does not.
"""

import jax.numpy as jnp
import numpy as np

from rfem_jax.description import Joint, JointForceFunction, Link, Mechanism
from rfem_jax.validation.rigid_links import angles_of, body, turn_y

DENSITY, GRAVITY = 7700.0, 9.80665  # kg/m^3, m/s^2
CRANK, ROD, PISTON, TOP = 0.1, 0.2, 0.1, 0.42  # m, lengths, and the end of the cylinder above the shaft
BORE, ROD_CENTRE = 0.1, 0.09  # m, the rod's mass centre from its crank pin
VOLUME = TOP - (PISTON + ROD - CRANK)  # m, length of the cylinder's volume
PINS = np.radians([-30.0, 90.0, 210.0, 210.0, 90.0, -30.0])  # of the crank pins on the shaft
CYLINDERS = np.radians([-30.0, 30.0, -30.0, 30.0, -30.0, 30.0])  # inclinations
FLYWHEEL, BRAKE, BRAKE_RATE = 1.0, 100.0, 200.0  # kg m^2; N m at a rate in rad/s, growing with its square
ATMOSPHERE = 1e5  # Pa
RATE, DURATION, STEP = 10.0, 1.01, 2e-5  # rad/s at the start, s, s
# Pressure in atmospheres by the piston's place x (1 where it would touch the end): coefficients from x^4 down.
RISING = (177.4132, -287.2189, 151.8252, -24.9973, 2.4)
RISING_NEAR_THE_END = (2836360.0, -10569296.0, 14761814.0, -9158505.0, 2129670.0)  # from x = 0.986061
FALLING = (145.930, -131.707, 17.3438, 17.9272, 2.4)
FALLING_NEAR_THE_END = (-3929704.0, 14748765.0, -20747000.0, 12964477.0, -3036495.0)  # above x = 0.933


def gas_force(place, rate):
    """Force on a piston along its guide [N] by the place of its pin [m] above the shaft and its rate [m/s]."""
    x = 1.0 - (TOP - PISTON - place) / VOLUME

    def pressure(coefficients):
        return jnp.polyval(jnp.array(coefficients), x)

    rising = jnp.where(x < 0.986061, pressure(RISING), pressure(RISING_NEAR_THE_END))
    falling = jnp.where(x > 0.933, pressure(FALLING_NEAR_THE_END), pressure(FALLING))
    return -ATMOSPHERE * np.pi * BORE**2 / 4.0 * jnp.where(rate > 0.0, rising, falling)


def brake(angle, rate):
    """Moment on the shaft [N m]."""
    del angle
    return -BRAKE * (rate / BRAKE_RATE) ** 2


def _shaft() -> Link:
    """Journals and pins are cylinders of 0.12 m, webs boxes of 20 mm x 50 mm; the pins' weights balance each other."""
    journal, pin = (DENSITY * np.pi * radius**2 * 0.12 for radius in (0.025, 0.015))
    web = DENSITY * CRANK * 0.02 * 0.05
    of_web = web * (CRANK**2 + 0.05**2) / 12.0 + web * (CRANK / 2.0) ** 2
    inertia = journal * 0.025**2 / 2.0 + pin * 0.015**2 / 2.0 + pin * CRANK**2 + 2.0 * of_web
    about = FLYWHEEL + len(PINS) * inertia
    return body("shaft", CRANK, len(PINS) * (journal + pin + 2.0 * web), (0.0, 0.0, 0.0), (about, about, about))


def _rod(name: str) -> Link:
    """A box of 0.22 m x 60 mm x 20 mm; only its inertia across the plane counts."""
    mass = DENSITY * 0.22 * 0.06 * 0.02
    inertia = mass * (0.22**2 + 0.06**2) / 12.0
    return body(name, ROD, mass, (ROD_CENTRE, 0.0, 0.0), (inertia, inertia, inertia))


def mechanism() -> Mechanism:
    """The engine at the library's start."""
    piston = DENSITY * np.pi * BORE**2 / 4.0 * PISTON
    links, joints, forces = (
        [_shaft()],
        [Joint("A", "base", "shaft", angle=0.0)],
        [JointForceFunction("brake", "A", brake)],
    )
    cuts = []
    for number, (pin, inclination) in enumerate(zip(PINS, CYLINDERS), 1):
        across, along = CRANK * np.sin(pin - inclination), CRANK * np.cos(pin - inclination)
        links += [
            body(f"piston{number}", PISTON, piston, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01)),  # it does not turn
            _rod(f"rod{number}"),
        ]
        joints += [
            Joint(f"G{number}", "base", f"piston{number}", kind="prismatic",
                  orientation=angles_of(turn_y(inclination - np.pi / 2.0)),
                  displacement=float(along + np.sqrt(ROD**2 - across**2))),
            Joint(f"C{number}", f"piston{number}", f"rod{number}", kind="cylindrical", position=(0, 0, 0),
                  child_position=(ROD, 0, 0), angle=float(-np.arcsin(across / ROD))),
        ]  # fmt: skip
        place = (float(CRANK * np.sin(pin)), 0.0, float(CRANK * np.cos(pin)))
        cuts.append(Joint(f"B{number}", "shaft", f"rod{number}", kind="spherical", cut=True, position=place,
                          child_position=(0, 0, 0)))  # fmt: skip
        forces.append(JointForceFunction(f"gas{number}", f"G{number}", gas_force))
    return Mechanism(
        tuple(links), tuple(joints + cuts), gravity=(0.0, 0.0, -GRAVITY), driven_joint="A", forces=tuple(forces)
    )
