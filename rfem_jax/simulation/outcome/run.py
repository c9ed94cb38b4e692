"""What a simulation returns: `Run`, with its metrics and balances.

Place in the pipeline: integration -> **run** -> tolerancing, report.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from rfem_jax.description.metrics.path_metrics import angles_of_rotation
from rfem_jax.labelled_data import DataFrame, Dataset
from rfem_jax.mechanics.dynamics.point_paths import PointMotion
from rfem_jax.mechanics.forces.bush_contacts import ContactState
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.model import Coordinates, Model
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.mechanics.statics.assembly import Load
from rfem_jax.mechanics.statics.equilibrium_stability import Stability
from rfem_jax.simulation.outcome.remarks import remarks_on
from rfem_jax.simulation.system.equations import Numbers, Scalar, safe_sqrt

RESIDUAL_LIMIT = 0.05  # of the largest joint force: with a larger residual the equations of motion are not solved


class Energy(eqx.Module):
    """Energies [J] at the saved times: kinetic, elastic, gravity (zero level: the first base joint's nominal
    position); work of the drives and dissipated energy since the start."""

    kinetic: Float[Numbers, "*times"]
    elastic: Float[Numbers, "*times"]
    gravity: Float[Numbers, "*times"]
    work: Float[Numbers, "*times"]
    dissipation: Float[Numbers, "*times"]

    @property
    def total(self) -> Float[Numbers, "*times"]:
        """Mechanical energy [J]."""
        return self.kinetic + self.elastic + self.gravity

    @property
    def exchanged(self) -> Float[Numbers, "*batch"]:
        """The largest energy [J] that moves in one of its forms: kinetic energy, or the range of elastic energy, of
        gravity energy, of work, or of dissipated energy. Zero levels, and the energy of links bent to fit, do not
        count."""

        def change(values):
            return jnp.max(values, axis=-1) - jnp.min(values, axis=-1)

        others = (change(part) for part in (self.elastic, self.gravity, self.work, self.dissipation))
        return reduce(jnp.maximum, others, jnp.max(self.kinetic, axis=-1))


class Metrics(eqx.Module):
    """Scalars by the names of the joints: mean squares and RMS over the whole duration of the
    resultant force and moment; maxima over the whole duration of the absolute axial force and of the normal force (NaN
    for a joint without an axis), of the resultant force and of the resultant moment [N, N m]."""

    mean_square_force: dict[str, Float[Numbers, ""]]
    mean_square_moment: dict[str, Float[Numbers, ""]]
    rms_force: dict[str, Float[Numbers, ""]]
    rms_moment: dict[str, Float[Numbers, ""]]
    max_axial_force: dict[str, Float[Numbers, ""]]
    max_normal_force: dict[str, Float[Numbers, ""]]
    max_force: dict[str, Float[Numbers, ""]]
    max_moment: dict[str, Float[Numbers, ""]]


class LoadIntegrals(eqx.Module):
    """Integrals from 0 to the saved times of the squared resultant force [N^2 s] and moment [(N m)^2 s], by
    joint."""

    force_square: dict[str, Float[Numbers, " times"]]
    moment_square: dict[str, Float[Numbers, " times"]]


class WindowLoads(eqx.Module):
    """Mean squares and RMS of the resultant force and moment over a window of time, by joint."""

    mean_square_force: dict[str, Float[Numbers, ""]]
    mean_square_moment: dict[str, Float[Numbers, ""]]

    @property
    def rms_force(self) -> dict[str, Float[Numbers, ""]]:
        """RMS force [N] by joint."""
        return {name: safe_sqrt(value) for name, value in self.mean_square_force.items()}

    @property
    def rms_moment(self) -> dict[str, Float[Numbers, ""]]:
        """RMS moment [N m] by joint."""
        return {name: safe_sqrt(value) for name, value in self.mean_square_moment.items()}


@jax.tree_util.register_pytree_with_keys_class
class Loads(dict[str, Load]):
    """Loads by joint, `loads["A"].force` (times, 3), and those of all joints in one array with a joint axis.

    Joints are in the order of their names, as in every dict that has been through JAX.
    """

    def tree_flatten_with_keys(self):
        """As JAX has it for dicts: sorted by name."""
        names = tuple(sorted(self))
        return tuple((jax.tree_util.DictKey(name), self[name]) for name in names), names

    @classmethod
    def tree_unflatten(cls, names, loads):
        """The loads of these joints."""
        return cls(zip(names, loads, strict=True))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names along the joint axis."""
        return tuple(self)

    @property
    def force(self) -> Float[Numbers, "*batch times joints 3"]:
        """Forces [N] of all joints, each in its frame H."""
        return jnp.stack([jnp.asarray(one.force) for one in self.values()], axis=-2)

    @property
    def moment(self) -> Float[Numbers, "*batch times joints 3"]:
        """Moments [N m] of all joints, each in its frame H."""
        return jnp.stack([jnp.asarray(one.moment) for one in self.values()], axis=-2)


class DriveHistory(eqx.Module):
    """A driven coordinate at the saved times: position [rad, m], rate [rad/s, m/s], and the moment [N m] or force [N]
    of its drive, given or that which enforces the motion (zero without a drive)."""

    position: Float[Numbers, "*times"]
    rate: Float[Numbers, "*times"]
    force: Float[Numbers, "*times"]


class Motion(eqx.Module):
    """Where a run's mechanism is at the saved times.

    drives: `DriveHistory` of every driven coordinate, by joint ("A") or joint and motion ("C.T_y"); angle, rate,
    drive_moment: those of the first one [rad, rad/s, N m; m, m/s, N]; angles [rad], displacements [m]: coordinates of
    the tree joints that have any, (times, k) where a joint has k > 1; ends: positions (times, 3) [m] of the far ends of
    the links, in global axes.

    branch: assembly mode (times,) of every cut joint, +1 or -1 (0 where the joints' kinds tell none); a change of sign
    is a passage through a change point (theory (5.13)), after which derivatives, and averages with runs on the other
    branch, have no meaning.

    centre_lines, nominal_lines: points (points, 3) [m] along the links as assembled, and of the perfect mechanism;
    positions: all coordinates.
    """

    angle: Float[Numbers, " times"]
    rate: Float[Numbers, " times"]
    drive_moment: Float[Numbers, " times"]
    drives: dict[str, DriveHistory]
    angles: dict[str, Float[Numbers, " times ..."]]
    displacements: dict[str, Float[Numbers, " times ..."]]
    ends: dict[str, Float[Numbers, "times 3"]]
    branch: dict[str, Float[Numbers, " times"]]
    centre_lines: dict[str, Float[Numbers, "_ 3"]]
    nominal_lines: dict[str, Float[Numbers, "_ 3"]]
    positions: Coordinates | None = None

    @property
    def angle_end(self) -> Float[Numbers, ""]:
        """The first driven coordinate at the end [rad, m]."""
        return self.angle[..., -1]

    @property
    def rate_end(self) -> Float[Numbers, ""]:
        """Its rate at the end [rad/s, m/s]."""
        return self.rate[..., -1]


class Checks(eqx.Module):
    """How well a run keeps the laws of mechanics; each of these can fail.  Only `equation_residual` and `design_gap`
    have derivatives.

    energy_balance_error: relative to the energy that is exchanged (`Energy.exchanged`, at least a thousandth of the
    largest joint force times the longest link); closure_drift [m], closure_drift_angle [rad]; momentum_balance_error
    and hinge_moment_error, relative to the largest load; stabilisation_share, largest stabilising multiplier over the
    largest multiplier; solution_residual, largest residual of an implicit step as a force over the largest joint force,
    0 for explicit methods; linear_error, estimated error of linear elements, relative to the deflections of the link
    that is worst (theory (1.16)).

    equation_residual [N]: residual of the equations of motion at the saved times as forces (n = 0 for explicit
    methods); its derivative says how accurate derivatives are, see `derivative_residual`. design_gap [m]: what the
    loops of a design stay open by at the start; None without one. start_stability: how fast the static equilibrium of
    the start is left, what is held there held; None of a given start.
    """

    energy_balance_error: Float[Numbers, ""]
    closure_drift: Float[Numbers, ""]
    closure_drift_angle: Float[Numbers, ""]
    momentum_balance_error: Float[Numbers, ""]
    hinge_moment_error: Float[Numbers, ""]
    stabilisation_share: Float[Numbers, ""]
    solution_residual: Float[Numbers, ""]
    linear_error: Float[Numbers, ""]
    equation_residual: Float[Numbers, "times n"]
    design_gap: Float[Numbers, ""] | None = None
    start_stability: Stability | None = None


# Former names of what is in groups now, for one version; `driven_joint` had the ends of angle and rate.
_GROUP_OF = {field.name: "motion" for field in dataclasses.fields(Motion)}
_GROUP_OF |= {field.name: "checks" for field in dataclasses.fields(Checks)}


class PointHistory(eqx.Module):
    """A force between two points at the saved times: force [N], moment [N m] on the second one (of a force or moment at
    one point: on that), and place, first_place [m] of both (the latter then in the origin), in global axes."""

    force: Float[Numbers, "*times 3"]
    moment: Float[Numbers, "*times 3"]
    place: Float[Numbers, "*times 3"]
    first_place: Float[Numbers, "*times 3"]

    @property
    def length(self) -> Float[Numbers, "*times"]:
        """Distance of the two points [m]."""
        return jnp.linalg.norm(jnp.asarray(self.place) - self.first_place, axis=-1)

    @property
    def tension(self) -> Float[Numbers, "*times"]:
        """Force [N] that pulls the two points together."""
        apart = jnp.asarray(self.place) - self.first_place
        return -jnp.sum(self.force * apart, axis=-1) / jnp.linalg.norm(apart, axis=-1)


class CouplingHistory(eqx.Module):
    """A coupling at the saved times: loads along its two coordinates [N m about an axis, N along one], of the parent on
    the child of each joint; deflection [rad, m] of the second coordinate from where the mesh, with its errors, is
    without load."""

    loads: Float[Numbers, "*times 2"]
    deflection: Float[Numbers, "*times"]


class PointPath(eqx.Module):
    """The path of a point at the saved times: position [m], velocity [m/s], acceleration [m/s^2]; rotation of its link
    there and angular velocity [rad/s]; seen from the link that it is relative to, in that link's axes, or else in
    global axes."""

    position: Float[Numbers, "*times 3"]
    velocity: Float[Numbers, "*times 3"]
    acceleration: Float[Numbers, "*times 3"]
    rotation: Float[Numbers, "*times 3 3"]
    angular_velocity: Float[Numbers, "*times 3"]
    plane: str = eqx.field(static=True, default="xz")

    @classmethod
    def of(cls, motion: PointMotion, plane: str = "xz") -> "PointPath":
        """The path of motions at all times, of a mechanism that is described in a plane."""
        return cls(*motion, plane=plane)

    @property
    def angles(self) -> Float[Numbers, "*times 3"]:
        """Angles [rad] of the link about x, y and z, with rotation = R_y R_z R_x: about y is the turn within the plane
        of a planar mechanism, which may exceed a revolution; the other two are small where the link stays near that
        plane (theory (8.20)). In the plane of x and y it is that about z, with rotation = R_z R_-y R_x."""
        return angles_of_rotation(jnp.asarray(self.rotation), self.plane)

    def angles_where(self, good: Bool[np.ndarray, " times"]) -> Float[np.ndarray, "times 3"]:
        """The angles of one path where it is `good`, NaN elsewhere; its turns are counted over what is good."""
        angles = np.full(np.shape(self.position), np.nan)
        angles[good] = angles_of_rotation(jnp.asarray(self.rotation)[good], self.plane)
        return angles


class Run(eqx.Module):
    """One simulated case, or a batch of them with a leading axis.

    status: code of `STATUS`, 0 if all checks hold; times [s], the saved times.

    loads, preload: `Load`s by joint, in hinge frames (`loads.force` and `loads.moment`: of all joints, (times, joints,
    3)); metrics of them over the whole duration; integrals: of squared loads, for `window`; forces: `PointHistory` by
    the names of the forces at points of links and between them.

    motion, energy, checks: see `Motion`, `Energy`, `Checks`.

    friction_losses: energy (times,) [J] that every friction has dissipated, by its name. contacts: `ContactState` by
    the names of the joints with clearance; contact_losses: energy (times,) [J] that their contacts have dissipated, by
    the joints; contact_changes: how often any of them has closed or opened, None where steps did not follow them.

    points: `PointPath` of every point of the description, couplings: `CouplingHistory` of every coupling, by their
    names.

    recorded: what `simulate` was asked to record, by the names of `outcome.records`; model, errors: what was
    simulated.
    """

    times: Float[Numbers, " times"]
    loads: Loads
    preload: dict[str, Load]
    metrics: Metrics
    motion: Motion
    energy: Energy
    checks: Checks
    status: Int[Numbers, ""]
    integrals: LoadIntegrals
    forces: dict[str, PointHistory]
    friction_losses: dict[str, Float[Numbers, " times"]] = eqx.field(default_factory=dict)
    contacts: dict[str, ContactState] = eqx.field(default_factory=dict)
    contact_losses: dict[str, Float[Numbers, " times"]] = eqx.field(default_factory=dict)
    contact_changes: Float[Numbers, ""] | None = None
    points: dict[str, "PointPath"] = eqx.field(default_factory=dict)
    couplings: dict[str, CouplingHistory] = eqx.field(default_factory=dict)
    recorded: dict[str, Any] = eqx.field(default_factory=dict)
    model: Model | None = None
    errors: AssemblyErrors | None = None

    if not TYPE_CHECKING:  # a type checker shall find the former names

        def __getattr__(self, name: str) -> Any:
            group = "motion" if name == "driven_joint" else _GROUP_OF.get(name)
            if group is None:
                raise AttributeError(f"A run has no {name!r}; it has {', '.join(vars(self))}.")
            found = getattr(self, group)
            new = group if name == "driven_joint" else f"{group}.{name}"
            warnings.warn(
                f"`run.{name}` is `run.{new}` now; a later version needs that.", DeprecationWarning, stacklevel=2
            )
            return found if name == "driven_joint" else getattr(found, name)

    def window(self, start: Scalar, stop: Scalar) -> WindowLoads:
        """Loads over start <= t <= stop [s] of one run; use vmap for a batch.  Differentiable.

        Exact where start and stop are saved times; between these the integrals are interpolated linearly.
        """
        span = stop - start

        def mean(integral):
            return (_interpolated(stop, self.times, integral) - _interpolated(start, self.times, integral)) / span

        sums = self.integrals
        return WindowLoads(
            {name: mean(value) for name, value in sums.force_square.items()},
            {name: mean(value) for name, value in sums.moment_square.items()},
        )

    def loads_in(self, axes: str) -> Loads:
        """Loads of all joints in other axes: "parent" or "child", those of the link there (of a flexible one of its rfe
        that the joint is on), "global", or "joint", each in its frame H as `loads`. They stay what the parent exerts on
        the child, about the joint's centre. Of a batch, too; differentiable.

        **Raises:** `InputError` for other axes, and for a run that does not say where its mechanism is.
        """
        if axes == "joint":
            return self.loads
        return Loads(self._named(axes, preload=False))

    def preload_in(self, axes: str) -> dict[str, Load]:
        """Preload of all joints in axes as of `loads_in`."""
        return self.preload if axes == "joint" else self._named(axes, preload=True)

    def _named(self, axes: str, preload: bool) -> dict[str, Load]:
        from rfem_jax.simulation.outcome.axes_of_loads import histories_in

        force, moment = histories_in(self, axes, preload)
        assert self.model is not None, "histories_in has seen to it"
        places = {name: self.model.topology.joints.index(name) for name in self.loads}
        return {name: Load(force[..., j, :], moment[..., j, :]) for name, j in places.items()}

    def summary(self) -> str:
        """A few lines to print, of one run, not of a batch."""
        if np.ndim(self.status) != 0:
            return f"Run: a batch of {np.shape(self.status)} runs; take one to read its summary."
        lines = [
            f"status {STATUS[int(self.status)].name}, {float(self.times[-1]):g} s simulated",
            f"{'joint':<12}{'RMS force N':>14}{'RMS moment N m':>16}{'max force N':>14}{'max moment N m':>16}",
        ]
        m = self.metrics
        lines += [
            f"{name:<12}{float(m.rms_force[name]):>14.5g}{float(m.rms_moment[name]):>16.5g}"
            f"{float(m.max_force[name]):>14.5g}{float(m.max_moment[name]):>16.5g}"
            for name in m.rms_force
        ]
        lines.append(
            f"energy balance {float(self.checks.energy_balance_error):.1e}, momentum balance "
            f"{float(self.checks.momentum_balance_error):.1e}, closure drift "
            f"{float(self.checks.closure_drift):.1e} m"
        )
        return "\n".join([*lines, *(f"remark: {one}" for one in remarks_on(self))])

    def report(self, path: str | Path) -> Path:
        """Former name of `rfem_jax.report_run(run, path)`."""
        import rfem_jax  # for its lazy names: what shows a run is above this package in the pipeline

        warnings.warn(
            "`run.report(path)` is `rfem_jax.report_run(run, path)` now; a later version needs that.",
            DeprecationWarning,
            stacklevel=3,  # beyond Equinox
        )
        return rfem_jax.report_run(self, path)

    def __str__(self) -> str:
        return self.summary()

    def to_xarray(self, cases: Sequence[str] | None = None, axes: str = "joint") -> Dataset:
        """An `xarray.Dataset` of everything, with units and long names, which `to_netcdf` can write.

        **Arguments:** `cases`: the names along the dimension `case` of a batch; None numbers them; `axes` of loads and
        preloads, as of `loads_in`.

        **Raises:** `InputError` for a batch with several axes, and as `loads_in`.
        """
        from rfem_jax.simulation.outcome.labelled_runs import run_dataset

        return run_dataset(self, cases, axes)

    def to_pandas(self) -> DataFrame:
        """A `pandas.DataFrame` of one run with a row per joint: its metrics and preload.

        **Raises:** `InputError` for a batch.
        """
        from rfem_jax.simulation.outcome.labelled_runs import run_frame

        return run_frame(self)

    def _repr_html_(self) -> str:
        from rfem_jax.simulation.outcome.labelled_runs import run_html

        return run_html(self)


def derivative_residual(change: Run) -> Float[Numbers, "*directions"]:
    """How far a derivative is from solving the differentiated equations of motion.

    **Arguments:** `change`: derivative of a run along one direction, as `jax.jvp` gives it (for several: under
    vmap, or `jacfwd`'s with the direction as the last axis).

    **Returns:** for every direction the largest change of `checks.equation_residual` over the largest change of a joint
    force (theory (11.14)); zero for explicit methods.  Above `RESIDUAL_LIMIT` the derivative has not converged:
    choose a smaller tolerance of the method, or a smaller step.
    """

    def largest(values, axes):
        return jnp.max(jnp.abs(values), axis=axes, initial=0.0)

    force = jnp.stack([largest(load.force, (0, 1)) for load in change.loads.values()]).max(axis=0)
    residual = largest(change.checks.equation_residual, (0, 1))
    return residual / jnp.where(force > 0.0, force, 1.0)


def _interpolated(time, times, values):
    return jnp.interp(jnp.asarray(time, jnp.float64), jnp.asarray(times), jnp.asarray(values))


def of_model(run: Run, model: Model, errors: AssemblyErrors | None) -> Run:
    """The run with what was simulated (the model without its source): it is put in here, not by the program, which
    would only copy it."""
    model = dataclasses.replace(model, source=None)
    return eqx.tree_at(lambda run: (run.model, run.errors), run, (model, errors), is_leaf=lambda x: x is None)


def one_of(runs: Run, index: int) -> Run:
    """One run of a batch, as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x)[index], runs)
