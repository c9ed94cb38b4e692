"""Methods of integration with their settings, a class for each.

Place in the pipeline: specified in Python or in a study; `simulation` makes the solver of a method.

    RungeKutta4, Leapfrog   explicit, with a fixed step
    GeneralisedAlpha        implicit
    Explicit                explicit solvers of diffrax, with a fixed step or with tolerances
    Automatic               `simulation.accuracy` chooses the method and its step
    named_method            the method that a study file names

Symbols: step h [s]; rtol, atol [1] relative and absolute tolerance of adaptive steps; stabilisation
[1] dimensionless Baumgarte gain; accuracy [1] relative accuracy asked of `Automatic`.
Source: theory (3.12), (3.13), (5.7), (7.1) to (7.7), (11.4).
"""

import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from numbers import Real
from typing import TYPE_CHECKING, Any, ClassVar

from rfem_jax.description.basics.calls import require_arguments
from rfem_jax.description.basics.errors import (
    ABSENT,
    Checks,
    ChecksItself,
    InputError,
    Problems,
    require_choice,
    require_name,
)
from rfem_jax.description.basics.units import non_negative_quantity, positive_quantity

MOST_COUNT = 10**9
DEFAULT_ACCURACY = 1e-3  # of `Automatic`


def _count(given: Any, dimension: str, where: str) -> int:
    del dimension
    try:
        number = float(given) if isinstance(given, Real) and not isinstance(given, bool) else 0.0
    except OverflowError:
        number = 0.0
    if not 1.0 <= number <= MOST_COUNT or not number.is_integer():
        raise InputError(f"Argument {where} must be a whole number of at least 1, but is {given}; write for example 5.")
    return int(number)


def setting(
    default: Any = None,
    dimension: str = "none",
    convert: Callable[[Any, str, str], Any] = positive_quantity,
    below_one: str = "",
) -> Any:
    """A field of a method's class: its default; the dimension of a quantity; the function that checks and converts
    it, called with (value, dimension, its name for messages); why it must be less than 1, "" where it need not be."""
    return field(default=default, metadata={"dimension": dimension, "convert": convert, "below_one": below_one})


def _converted(given: Any, of: Field[Any]) -> Any:
    """The value of a field made by `setting`."""
    value = of.metadata["convert"](given, of.metadata["dimension"], f"`{of.name}` of the method")
    reason = of.metadata["below_one"]
    if reason and value >= 1.0:
        raise InputError(f"Argument `{of.name}` must be less than 1, but is {value:g}; {reason}.")
    return value


class _MethodClass(type):
    """The type of the classes of methods: what is wrong with the names of arguments is said in a sentence."""

    if not TYPE_CHECKING:  # for whom the arguments are those of `__init__`

        def __call__(cls, *arguments: Any, **settings: Any) -> Any:
            if cls is Method or (cls is FixedStep and arguments):
                made = named_method(*arguments, **settings)
                warnings.warn(
                    f"Methods are made by their classes: write {type(made).__name__}(...) in place of "
                    f'{cls.__name__}("{made.name}", ...), which a later version refuses.',
                    DeprecationWarning,
                    stacklevel=2,
                )
                return made
            require_arguments(cls.__name__, cls.__init__, (None, *arguments), settings)
            return super().__call__(*arguments, **settings)

        @property
        def __signature__(cls) -> inspect.Signature:
            signature = inspect.signature(cls.__init__)
            return signature.replace(parameters=[*signature.parameters.values()][1:])


@dataclass(frozen=True, kw_only=True)
class Method(ChecksItself, metaclass=_MethodClass):
    """A method of integration with its settings; numbers in SI or strings with a unit.

    The base of all classes of methods. `rfem_jax.register_method` adds a class of your own program.

    Raises:
        InputError: a value out of range, or settings that do not fit the method.
    """

    # What every method may be asked for; a class that has the setting declares it again.
    step: float | None = field(default=None, init=False, repr=False)
    stabilisation: float | None = field(default=None, init=False, repr=False)

    names: ClassVar[tuple[str, ...]] = ()  # in study files
    implicit: ClassVar[bool] = False  # whether every step solves equations
    example: ClassVar[str] = ""  # of settings that must be given

    @property
    def name(self) -> str:
        """Its name in study files and results."""
        return self.names[0]

    def _check_fields(self, checks: Checks) -> None:
        for one in settings_of(type(self)):
            given = getattr(self, one.name)
            given = one.default if given is None else given
            if given is not None:
                checks.set(one.name, given, _converted, one)
        if self.example:
            checks.relation(("step",), self._require_step)

    def _require_step(self) -> None:
        if self.step is None:
            raise InputError(
                f'Argument `step` must be given for the method "{self.name}", but is missing; '
                f"add for example {self.example}."
            )

    @property
    def adaptive(self) -> bool:
        """True if the method chooses its steps from tolerances."""
        return False

    def as_table(self) -> dict[str, Any]:
        """Name and settings, as a study file has them and results tell them."""
        settings = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "solver"}
        return {"name": self.name, **settings}


@dataclass(frozen=True, kw_only=True)
class FixedStep(Method):
    """An explicit method with a fixed step: the base of such classes.

    Args:
        step: h [s], > 0; must be given.
        stabilisation: Baumgarte gain, >= 0; None = the default, 0 = none.
    """

    step: float | None = setting(dimension="time")
    stabilisation: float | None = setting(convert=non_negative_quantity)

    example: ClassVar[str] = "step = 1e-5"


@dataclass(frozen=True, kw_only=True)
class RungeKutta4(FixedStep):
    """The classical Runge-Kutta method of order 4.

    Args:
        step: h [s], > 0; must be given.
        stabilisation: Baumgarte gain, >= 0; None = the default, 0 = none.
    """

    names: ClassVar[tuple[str, ...]] = ("rk4",)


@dataclass(frozen=True, kw_only=True)
class Leapfrog(FixedStep):
    """The leapfrog method, of order 2: one evaluation a step.

    Args:
        step: h [s], > 0; must be given.
        stabilisation: Baumgarte gain, >= 0; None = the default, 0 = none.
    """

    names: ClassVar[tuple[str, ...]] = ("leapfrog",)


@dataclass(frozen=True, kw_only=True)
class GeneralisedAlpha(Method):
    """The implicit method.

    Args:
        step: h [s], > 0; must be given.
        spectral_radius: at infinite frequency, from 0 (such vibrations vanish in one step) to below 1 (they stay).
        corrections: largest number of Newton increments in a step, at least 1; where steps follow contacts one more
            is allowed.
        tolerance: largest residual allowed, as a share of the largest joint load, > 0, < 1.
        steps_per_row: number of steps between two rows of a table over time, at least; None: up to 8, as long as these
            are not more than all other steps.
        contact_tolerance: with joints with clearance, steps are divided where a contact would change its speed by more
            than this share of its depth over the length of the step (theory (15.14)), >= 0, < 1; 0 = steps stay whole,
            as reverse mode needs them.
    """

    step: float | None = setting(dimension="time")
    spectral_radius: float = setting(
        0.6,
        convert=non_negative_quantity,
        below_one="the joint loads would oscillate from step to step; the default is 0.6",
    )
    corrections: int = setting(5, convert=_count)
    tolerance: float = setting(1e-8, below_one="it is a share of the largest joint load, such as 1e-08")
    steps_per_row: int | None = setting(convert=_count)
    contact_tolerance: float = setting(
        0.02, convert=non_negative_quantity, below_one="a contact would pass within one step; the default is 0.02"
    )

    names: ClassVar[tuple[str, ...]] = ("generalised_alpha",)
    implicit: ClassVar[bool] = True
    example: ClassVar[str] = "step = 1e-3"


@dataclass(frozen=True, kw_only=True)
class Explicit(Method):
    """An explicit solver of diffrax, with a fixed step or with tolerances.

    Args:
        solver: such as `diffrax.Dopri8()`, a Runge-Kutta method of diffrax or one of your own that derives from
            `diffrax.AbstractERK`; or the lower-case name of one: "tsit5", "dopri5", "dopri8", "bosh3", "heun",
            "midpoint" or "ralston".
        step: h [s], > 0, of fixed steps; or else both tolerances.
        rtol, atol: tolerances of adaptive steps, > 0.
        stabilisation: Baumgarte gain, >= 0; None = the default, 0 = none.
    """

    solver: Any = field(kw_only=False)
    step: float | None = setting(dimension="time")
    rtol: float | None = setting(below_one="it is a relative error, such as 1e-8")
    atol: float | None = setting()
    stabilisation: float | None = setting(convert=non_negative_quantity)

    names: ClassVar[tuple[str, ...]] = ("tsit5", "dopri5", "dopri8", "bosh3", "heun", "midpoint", "ralston")

    @property
    def name(self) -> str:
        return self.solver if isinstance(self.solver, str) else type(self.solver).__name__.lower()

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("solver", _known_solver, self.names)
        super()._check_fields(checks)
        checks.relation(("solver", "step", "rtol", "atol"), self._check_steps)

    def _check_steps(self) -> None:
        tolerances = self.rtol is not None or self.atol is not None
        if self.step is not None and tolerances:
            raise InputError(
                f'Argument `step` of the method "{self.name}" must be given or else `rtol` and '
                "`atol`, but both are; keep the step for fixed steps, the tolerances for adaptive "
                "ones."
            )
        if self.step is None and (self.rtol is None or self.atol is None):
            raise InputError(
                f'Argument `step` of the method "{self.name}" must be given or else both `rtol` '
                "and `atol`, but neither is complete; add for example rtol = 1e-8 and atol = 1e-10."
            )

    @property
    def adaptive(self) -> bool:
        return self.rtol is not None


def _known_solver(solver: Any, names: tuple[str, ...]) -> Any:
    """The name of one of diffrax's solvers that is as diffrax makes it, which a study file can hold; any other solver
    as it is."""
    if isinstance(solver, str):
        return require_choice(solver, names, "`solver`")
    kind = type(solver)
    # By the names of its bases: importing diffrax takes long, and nothing else here needs it.
    if "AbstractERK" not in (base.__name__ for base in kind.__mro__):
        raise InputError(
            "Argument `solver` must be an explicit Runge-Kutta method of diffrax, but was "
            f"{solver!r}; write for example diffrax.Dopri8()."
        )
    name = kind.__name__.lower()
    own = kind.__module__.partition(".")[0] == "diffrax" and name in names and solver == kind()
    return name if own else solver


@dataclass(frozen=True, kw_only=True)
class Automatic(Method):
    """A method and a step that keep an accuracy, chosen for the mechanism.

    Args:
        accuracy: relative, of the RMS joint loads, > 0, < 1; None = 1e-3.
        stabilisation: Baumgarte gain, >= 0, if an explicit method is chosen; None = the default, 0 = none.
    """

    accuracy: float | None = setting(below_one="it is a relative error, such as 1e-4")
    stabilisation: float | None = setting(convert=non_negative_quantity)

    names: ClassVar[tuple[str, ...]] = ("auto",)


METHOD_CLASSES: dict[str, type[Method]] = {
    name: kind for kind in (RungeKutta4, Leapfrog, GeneralisedAlpha, Explicit, Automatic) for name in kind.names
}


def named_method(name: str = "rk4", **settings: Any) -> Method:
    """The method of a name in study files, with its settings.

    Args:
        name: "rk4", "leapfrog", "generalised_alpha", "auto", one of `Explicit.names`, or of a registered class.
        settings: those of the class, by their names.
    Raises:
        InputError: an unknown name, and as the class.
    """
    kind = METHOD_CLASSES[require_choice(name, tuple(METHOD_CLASSES), "`name` of the method")]
    problems = Problems()
    others = _settings_of_others(name, kind, settings, problems)
    own = {key: value for key, value in settings.items() if key not in others}
    if others:  # what is missing may be what they were meant for
        own = {one.name: ABSENT for one in settings_of(kind)} | own
    made = None
    with problems.noted():
        made = kind(name, **own) if issubclass(kind, Explicit) else kind(**own)
    problems.refuse()
    assert made is not None, "what is wrong has been noted"
    return made


def add_method_class(kind: type[Method]) -> None:
    """Make the names of a class known; its solver is said by `rfem_jax.register_method`, which calls this.

    Raises:
        InputError: no subclass with a name of its own, or a name that is known already.
    """
    if not (isinstance(kind, type) and issubclass(kind, Method) and len(kind.names) == 1):
        raise InputError(
            f"Argument `kind` must be a subclass of Method with one name in `names`, but was {kind!r}; see "
            "CONTRIBUTING.md."
        )
    for name in kind.names:
        require_name(name, "`names` of the method", reserved=tuple(METHOD_CLASSES))
    METHOD_CLASSES.update(dict.fromkeys(kind.names, kind))


def settings_of(kind: type[Method]) -> list[Any]:
    """The dataclass fields of a class that are settings of a study file, made by `setting`."""
    return [one for one in fields(kind) if one.init and "convert" in one.metadata]


def setting_names() -> list[str]:
    """Names of the settings of all methods."""
    found = dict.fromkeys(METHOD_CLASSES.values())
    return list(dict.fromkeys(one.name for kind in found for one in settings_of(kind)))


def _settings_of_others(name: str, kind: type[Method], given: Mapping[str, Any], problems: Problems) -> list[str]:
    """Settings that other methods have and this one has not; they are noted."""
    own, others = {one.name for one in settings_of(kind)}, []
    for key, value in given.items():
        having = [
            f'"{other}"'
            for other, of_other in METHOD_CLASSES.items()
            if key not in own and key in {one.name for one in settings_of(of_other)}
        ]
        if having:
            others.append(key)
        if having and value is not ABSENT:
            problems.found.append(
                f'Argument `{key}` must be left out with the method "{name}", but was given; remove it, or take a '
                f"method that has it ({', '.join(having)})."
            )
    return others
