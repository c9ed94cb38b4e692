"""What is simulated: a mechanism under its drives over a time, and the method of integration.

Place in the pipeline: model, drive, method -> **Simulation** -> simulate, steady_cycle, Problem.
"""

import warnings
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from rfem_jax.description.basics.calls import with_known_arguments
from rfem_jax.description.basics.errors import InputError, Problems, suggestion
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.basics.units import positive_quantity
from rfem_jax.description.drives.driven_motions import Drive
from rfem_jax.description.methods import Automatic, Method
from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.status import OK
from rfem_jax.mechanics.statics.assembly import with_start
from rfem_jax.mechanics.statics.designs import Design, designed, model_of_study, parameters
from rfem_jax.simulation.accuracy import choose_method
from rfem_jax.simulation.system.driving import drive_of_design, require_driven


class Simulation(eqx.Module):
    """A mechanism under its drives over a time, with a method of integration.

        simulation = Simulation(model, drive=MomentRamp("A", 1.0, 0.1), duration=0.5)
        run = simulate(simulation, assembly_errors(model, {"D.delta_x": 1e-3}))

    `dataclasses.replace(simulation, duration=1.0)` makes another one, for which `Automatic` chooses anew. Numbers of
    the model, of the drives, of the start and of the design may be traced, with a method whose step is given.

    Args:
        model: from `discretise`.
        drive: a moment or force on the model's driven joint, its prescribed motion, a list of such drives on as many
            driven motions, or None.
        duration: [s], or a string with a unit; None for a steady cycle, which lasts a revolution.
        method: `Automatic` (the default), which chooses a method and a step that keep its accuracy, or another one
            with its step: `GeneralisedAlpha`, `RungeKutta4`, `Leapfrog`, `Explicit`. `chosen` is the one that is used.
        save_every: [s], or a string with a unit: interval of saved times (None: 500 intervals).
        start: "as_given", with all freedoms at the start values of the joints and at their initial rates, flexible
            links settled, or "equilibrium", in which freedoms that no drive holds have settled, too (None: as the
            mechanism says, "as_given" unless it says another); or a `State`, which replaces the static assembly (the
            preload is then unknown, NaN).
        design: from `rfem_jax.design`, other values for numbers of the model and its drives.
        trials: {error name: its values (n,)} of n assemblies by which `Automatic` chooses the step, such as
            `first_samples` gives; None, or where none of its steps is accurate for these: the perfect one, to whose
            small loads errors are largest, and one with all joints tilted and shifted.
    Raises:
        InputError: arguments that cannot be used, such as a drive of another joint than the driven one.
    """

    model: Model
    drive: Drive
    duration: float | None = eqx.field(static=True)
    method: Method = eqx.field(static=True)
    save_every: float | None = eqx.field(static=True)
    start: State | None
    design: Design | None
    trials: Mapping[str, ArrayLike] | None
    chosen: Method = eqx.field(static=True, init=False)

    @with_known_arguments("Simulation")
    def __init__(
        self,
        model: Model,
        *,
        drive: Drive,
        duration: float | int | str | None = None,
        method: Method | None = None,
        save_every: float | int | str | None = None,
        start: State | str | None = None,
        design: Design | None = None,
        trials: Mapping[str, ArrayLike] | None = None,
    ):
        require_float64()
        method = Automatic() if method is None else method
        _require_kinds(model, method, start, design)
        require_driven(model, drive)
        if isinstance(start, str):
            model, start = with_start(model, start), None
        self.model, self.drive, self.start, self.design, self.method = model, drive, start, design, method
        self.duration = None if duration is None else positive_quantity(duration, "time", "duration")
        self.save_every = None if save_every is None else positive_quantity(save_every, "time", "save_every")
        self.trials = None if trials is None else _checked_trials(model, trials)
        self.chosen = self._choose()

    def _choose(self) -> Method:
        """The method itself, or the one that `Automatic` stands for on this mechanism with its design."""
        if not isinstance(self.method, Automatic):
            return self.method
        numbers = jax.tree.leaves((self.model, self.drive, self.design, jnp.add(0.0, 0.0)))
        if any(isinstance(x, Tracer) for x in numbers):  # the sum is traced within jax.jit
            raise InputError(
                "Argument `method` of a simulation must have a step within jax.jit and where numbers of its model, "
                "drive or design are traced, but is Automatic, which tries steps; give `method=simulation.chosen` of "
                "one that was made outside."
            )
        model, drive = self.model, self.drive
        if self.design is not None:
            made = designed(model, self.design, assembly_errors(model))
            drive = drive_of_design(model, drive, self.design)
            model = made.model if made.status is None or int(made.status) == OK else model
        return choose_method(model, self.method, drive, self.duration, self.trials, self.save_every)

    @classmethod
    def of(cls, study: Study, **changes: Any) -> "Simulation":
        """The simulation of a study, without the errors of its cases.

        **Arguments:** `changes`: arguments that take the place of the study's, such as `method=`, `duration=`.

        **Raises:** `InputError` as the class.
        """
        settings = {
            "drive": study.designed_drive,
            "duration": study.duration,
            "method": study.method,
            "save_every": study.save_every,
        }
        return cls(changes.pop("model", None) or model_of_study(study), **(settings | changes))

    def require_duration(self) -> float:
        """The duration [s]. Raises InputError if it was not given."""
        if self.duration is None:
            raise InputError(
                "Argument `duration` of a simulation must be given, but is missing; add the time to simulate [s]."
            )
        return self.duration

    # Short: JAX shows it in messages, and all of a model takes longer than a simulation.
    def __repr__(self) -> str:
        step = "" if self.chosen.step is None else f" with steps of {self.chosen.step:g} s"
        time = "" if self.duration is None else f" over {self.duration:g} s"
        return f"<Simulation of {', '.join(self.model.topology.links)}{time} by {self.chosen.name}{step}>"


def _require_kinds(model: Any, method: Any, start: Any, design: Any) -> None:
    """Raise InputError for arguments of a simulation that are something else."""
    method_fix = "write for example RungeKutta4(step=1e-5), or Explicit(diffrax.Dopri8(), rtol=1e-8, atol=1e-10)"
    start_fix = 'give "as_given", "equilibrium" or the `state` of an assembly'
    wanted = (
        ("model", model, Model, "a Model", "make it by discretise(mechanism)"),
        ("method", method, Method, "an object of a method", method_fix),
        ("start", start, (State, str, type(None)), "a State or a word", start_fix),
        ("design", design, (Design, type(None)), "a Design", "make it by rfem_jax.design(model, {...})"),
    )
    problems = Problems()
    for name, given, kinds, what, fix in wanted:
        with problems.noted():
            if not isinstance(given, kinds):
                shown = repr(given) if isinstance(given, str | int | float | type) else type(given).__name__
                raise InputError(f"Argument `{name}` of a simulation must be {what}, but is {shown}; {fix}.")
    problems.refuse()


def _checked_trials(model: Model, trials: Any) -> dict[str, ArrayLike]:
    """Trial errors by names that the model or its drives have, of finite numbers."""
    if not isinstance(trials, Mapping):
        raise InputError(
            f"Argument `trials` of a simulation must be {{error name: values}}, but is {type(trials).__name__}; give "
            "for example first_samples(tolerances, key)."
        )
    known = [*model.topology.error_names, *(() if model.source is None else parameters(model))]
    for name, values in trials.items():
        if name not in known and not str(name).startswith("drive."):
            raise InputError(
                f"Argument `trials` must name errors, but {name!r} is not an error; {suggestion(name, known)}"
            )
        numbers = np.asarray(values)
        if numbers.ndim != 1 or numbers.dtype.kind not in "fiu" or not np.isfinite(numbers).all():
            raise InputError(
                f"Argument `trials` must have finite numbers, one for each assembly, but those of {name!r} are not; "
                "give arrays (n,) in SI units."
            )
    return dict(trials)


def simulation_of_call(function: str, given: Simulation | Model | None, former: dict[str, Any]) -> Simulation:
    """The simulation that a function was given; of a model with the arguments of an earlier version, which warns.

    **Arguments:** `former`: arguments by names that the function does not have, `model` among them in the place of
    what was `given`.

    **Raises:** `InputError` for names that are not known, or of a simulation beside one.
    """
    of_simulation = ("drive", "duration", "method", "save_every", "start", "design", "trials")
    if given is None and "model" in former:
        given, former = former["model"], {name: value for name, value in former.items() if name != "model"}
    if isinstance(given, Model) and former and set(former) <= set(of_simulation):
        arguments = ", ".join(f"{name}=..." for name in former)
        warnings.warn(
            f"`{function}` takes a simulation: write {function}(Simulation(model, {arguments}), ...), which a later "
            "version needs.",
            DeprecationWarning,
            stacklevel=3,
        )
        return Simulation(given, **former)
    for name in former:
        raise InputError(
            f"Argument `{name}` must be left out, but was given to `{function}`, which does not know it; "
            + ("give it to `Simulation`." if name in of_simulation else suggestion(name, of_simulation))
        )
    if not isinstance(given, Simulation):
        raise InputError(
            f"Argument `simulation` of `{function}` must be a Simulation, but is "
            f"{'missing' if given is None else type(given).__name__}; make it by Simulation(model, drive=..., "
            "duration=...)."
        )
    return given
