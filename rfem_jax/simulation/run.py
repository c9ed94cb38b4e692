"""What a simulation returns: `Run`, with its metrics and balances.

Place in the pipeline: integration -> **run** -> tolerancing, report.
"""

import equinox as eqx
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.mechanics.statics import Load
from rfem_jax.mechanics.status import STATUS


class Energy(eqx.Module):
    """Energies (times,) [J]: kinetic, elastic, gravity (zero level: the first base joint's nominal
    place); work of the drive and dissipated energy since the start."""

    kinetic: Float[Array, "times"]
    elastic: Float[Array, "times"]
    gravity: Float[Array, "times"]
    work: Float[Array, "times"]
    dissipation: Float[Array, "times"]

    @property
    def total(self) -> Array:
        """Mechanical energy [J]."""
        return self.kinetic + self.elastic + self.gravity


class Metrics(eqx.Module):
    """Scalars by the names of the joints: mean squares and RMS over the whole duration of the
    resultant force and moment; maxima of the absolute axial and of the normal force [N, N m]."""

    mean_square_force: dict[str, Array]
    mean_square_moment: dict[str, Array]
    rms_force: dict[str, Array]
    rms_moment: dict[str, Array]
    max_axial_force: dict[str, Array]
    max_normal_force: dict[str, Array]


class DrivenJoint(eqx.Module):
    """The driven joint's own coordinate at the end: angle [rad] and rate [rad/s]."""

    angle_end: Float[Array, ""]
    rate_end: Float[Array, ""]


class Run(eqx.Module):
    """One simulated case (or a batch of them, with a leading axis).

    times (T,) [s]; angle, rate (T,) of the driven joint [rad, rad/s]; drive_moment (T,) [N m]; angles:
    joint coordinate (T,) of every tree joint; loads, preload: `Load`s by joint, in hinge frames;
    energy; metrics; driven_joint.  Balances, each able to fail: energy_balance_error (relative to the
    largest energy), closure_drift [m], closure_drift_angle [rad], momentum_balance_error and
    hinge_moment_error (relative to the largest load), stabilisation_share (largest stabilising
    multiplier / largest multiplier), solution_residual (largest force that Newton's method left over in
    an implicit step / largest joint force; 0 for explicit methods).  status: code of `STATUS`.  centre_lines, nominal_lines: points
    (3 columns) [m] along the links as assembled, and of the perfect mechanism.
    """

    times: Float[Array, "times"]
    angle: Float[Array, "times"]
    rate: Float[Array, "times"]
    drive_moment: Float[Array, "times"]
    angles: dict[str, Array]
    loads: dict[str, Load]
    preload: dict[str, Load]
    energy: Energy
    metrics: Metrics
    driven_joint: DrivenJoint
    energy_balance_error: Float[Array, ""]
    closure_drift: Float[Array, ""]
    closure_drift_angle: Float[Array, ""]
    momentum_balance_error: Float[Array, ""]
    hinge_moment_error: Float[Array, ""]
    stabilisation_share: Float[Array, ""]
    solution_residual: Float[Array, ""]
    status: Int[Array, ""]
    centre_lines: dict[str, Array]
    nominal_lines: dict[str, Array]

    def summary(self) -> str:
        """A few lines for a person; one run, not a batch."""
        if np.ndim(self.status) != 0:
            return f"Run: a batch of {np.shape(self.status)} runs; take one to read its summary."
        lines = [
            f"status {STATUS[int(self.status)].name}, {float(self.times[-1]):g} s simulated",
            f"{'joint':<12}{'RMS force N':>14}{'RMS moment N m':>16}"
            f"{'max axial N':>14}{'max normal N':>14}",
        ]
        m = self.metrics
        lines += [
            f"{name:<12}{float(m.rms_force[name]):>14.5g}{float(m.rms_moment[name]):>16.5g}"
            f"{float(m.max_axial_force[name]):>14.5g}{float(m.max_normal_force[name]):>14.5g}"
            for name in m.rms_force
        ]
        lines.append(
            f"energy balance {float(self.energy_balance_error):.1e}, joint-load balance "
            f"{float(self.momentum_balance_error):.1e}, closure drift "
            f"{float(self.closure_drift):.1e} m"
        )
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()


def one_of(runs: Run, index: int) -> Run:
    """One run of a batch, as NumPy arrays."""
    import jax

    return jax.tree.map(lambda x: np.asarray(x)[index], runs)
