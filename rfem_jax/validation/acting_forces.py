"""Forces along joints and at points: a gas force over the slide; a spring, a follower force and a constant one.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/acting_forces.json`.
"""

import numpy as np

from rfem_jax.description import Joint, JointForceTable, Mechanism, PointForce, PointSpring, RungeKutta4
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation import rigid_links
from rfem_jax.validation.joint_cases import Shares, checked
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body

REFERENCE = read_reference("acting_forces")
SHARES = Shares(rms=1e-7, instant=1e-6, motion=1e-8)
ENERGY = 1e-7  # J
RATE = 60.0  # rad/s, of the crank
ANGLE = float(np.radians(20.0))  # of the pendulum at the start


def slider_crank() -> Mechanism:
    """Rigid links; the guide's point on the piston is where the gas acts, 20 mm before the wrist pin and 8 mm above."""
    guide = Joint("G", "base", "piston", kind="prismatic", position=(0, 0, 0.018), child_position=(0.02, 0, 0.008),
                  displacement=0.28)  # fmt: skip
    gas = JointForceTable("gas", "G", [0.16, 0.19, 0.22, 0.25, 0.28], [-900, -400, -150, 0, 0])
    return rigid_links.slider_crank(guide, (gas,))


def pendulum() -> Mechanism:
    """A rod on a hinge, pulled off the plane of its motion by a damped spring, a follower force and a constant one."""
    rod = body("rod", 0.3, 0.8, (0.15, 0.02, 0.01), (0.001, 0.007, 0.0065))
    forces = (
        PointSpring("coil", ("base", "rod"), ((0.1, 0.05, 0.3), (0.25, -0.03, 0.02)), 250.0, 2.0, 0.28),
        PointForce("follower", "rod", (0.3, 0.01, 0.0), (0.5, 0.8, 1.2), axes="link"),
        PointForce("constant", "rod", (0.2, 0.0, 0.03), (1.0, -0.6, 0.4)),
    )
    return Mechanism((rod,), (Joint("A", "base", "rod", angle=ANGLE),), forces=forces)


def run_gas() -> Run:
    """One turn at a constant rate."""
    return rigid_links.one_turn(slider_crank(), RATE, 2000)


def run_pendulum() -> Run:
    """A second, let go from rest."""
    model = discretise(pendulum())
    start = static_state(model.topology, model.start_coordinates())
    method = RungeKutta4(step=5e-4)
    return simulate(Simulation(model, drive=None, duration=1.0, method=method, save_every=0.1, start=start))


def gas_lines(run: Run) -> list[Line]:
    """Loads of the slider-crank."""
    return checked(REFERENCE, "gas", "Slider-crank, gas force", run, SHARES)


def pendulum_lines(run: Run) -> list[Line]:
    """Loads, angle and energies of the pendulum."""
    group = "Pendulum, spring and forces at points"
    lines = checked(REFERENCE, "pendulum", group, run, SHARES)
    for name, found in (("elastic", run.energy.elastic), ("work", run.energy.work)):
        quantity, times = REFERENCE.quantities[name], np.asarray(run.times)
        for time, known in quantity.values["pendulum"].items():
            ours = float(found[int(np.argmin(np.abs(times - float(time))))])
            title = f"{'energy of the spring' if name == 'elastic' else 'work of the forces'} at {time} s"
            lines.append(absolute(group, title, ours, known, ENERGY, quantity.label, quantity.unit))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """Both."""
    del full
    lines = gas_lines(run_gas())
    progress(0.6)
    lines += pendulum_lines(run_pendulum())
    progress(1.0)
    return Outcome(lines)
