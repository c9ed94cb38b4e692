"""Functions in parts, each of them a program of its own.

Place in the pipeline: simulation and tolerancing make functions of several `Program`s with `ProgramInParts`.

Parts compile side by side, and each as quickly as its use asks.  Values, derivatives in forward mode and batches are
computed part by part; a part is differentiated by, and has a batch axis in, what depends on such arguments, and no
more.  The whole is one program in reverse mode, on devices that the user chose, and within another program.

    ProgramInParts    the function, called like a `Program`
    CallInParts       as `call.Call`, for arguments of one structure
    _Plan             for arrays of known shapes: the parts' executables, and where their arrays come from

An array is known by a name: ("argument", i), ("result", part, i), or ("tangent", level, name), the tangent that a step
of differentiation adds.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
from jax import Array
from jax.typing import ArrayLike

from rfem_jax.compilation.call import Call, Pending, call_of, kind
from rfem_jax.compilation.executable import Place
from rfem_jax.compilation.program import Program
from rfem_jax.compilation.transformations import Transformable

Name = tuple


class ProgramInParts(Program):
    """A pure function of pytrees that is a sequence of programs.

    **Arguments:** `sequence`: (run, *arguments) -> results, which calls programs by `run(program, *arguments)` and does
    nothing else with arrays than to take trees apart and to put them together; `nameless`: as of `Program`.
    """

    def __init__(self, sequence: Callable, nameless: bool = False):
        super().__init__(_Whole(sequence), nameless=nameless)
        functools.update_wrapper(self, sequence)
        self.sequence = sequence

    def _call_of(self, tree, static) -> Transformable:
        whole = call_of(self.function, tree, static, self.quick)
        return CallInParts(self.sequence, jax.tree.unflatten(tree, static)[0], whole)


@dataclass(eq=False)
class _Whole:
    """A sequence as one function, whose content is that of the sequence."""

    sequence: Callable

    def __post_init__(self):
        self.__name__, self.__qualname__ = self.sequence.__name__, self.sequence.__qualname__

    def __call__(self, *arguments):
        return self.sequence(_run_plainly, *arguments)


def _run_plainly(program: Program, *arguments):
    return program.function(*arguments)


def in_parts(run: Callable[..., Any]) -> bool:
    """Whether a sequence's `run` makes parts, which reverse mode never takes."""
    return run is not _run_plainly


@dataclass(frozen=True)
class _Named:
    """Stands for an array in the trees of a sequence."""

    name: Name


class CallInParts:
    """As `Call`, for a sequence of programs.

    **Arguments:** `arguments`: of the sequence, with a `Place` for each array; `whole`: the sequence as one program,
    transformed like this one; `before`, `step`: as `Call`.
    """

    def __init__(
        self,
        sequence: Callable,
        arguments: tuple,
        whole: Call,
        before: "CallInParts | None" = None,
        step: tuple | None = None,
    ):
        self.sequence, self.arguments, self.whole, self.before, self.step = sequence, arguments, whole, before, step
        self.function, self.name = whole.function, whole.name
        self.facts: Any = None
        self._next: dict[tuple, CallInParts] = {}
        self._plans: dict[tuple, _Plan] = {}

    def then(self, step: tuple) -> "CallInParts | Call":
        """This call transformed; in one program where reverse mode is taken."""
        if step[0] == "linear":
            return self.whole.then(step)
        if step not in self._next:
            self._next[step] = CallInParts(self.sequence, self.arguments, self.whole.then(step), self, step)
        return self._next[step]

    def run(self, arrays: Sequence[ArrayLike]) -> list[Array]:
        """Results for concrete arrays."""
        if _on_chosen_devices(arrays):
            return self._of_whole(self.whole.run(arrays))
        return self._planned(arrays).run(arrays)

    def ahead(self, arrays: Sequence[ArrayLike | jax.ShapeDtypeStruct]) -> list:
        """Start to compile or load in the background what `run` will need; returns the results without values."""
        if _on_chosen_devices(arrays):
            return self._of_whole(self.whole.ahead(arrays))
        plan = self._planned(arrays)
        return [plan.forms[name] for name in plan.results]

    def chain(self) -> "list[CallInParts]":
        """This call and those that it transforms, one after the other."""
        return [self] if self.before is None else [self, *self.before.chain()]

    def _of_whole(self, results: list) -> list:
        """Results of the whole as one program, which knows the facts."""
        for call, whole in zip(self.chain(), self.whole.chain(), strict=True):
            call.facts = whole.facts
        return results

    def _planned(self, arrays) -> "_Plan":
        kinds = tuple(map(kind, arrays))
        if kinds not in self._plans:
            calls = self.chain()[::-1]
            plan = _Plan(self.sequence, self.arguments, [call.step for call in calls if call.step], arrays)
            for call, facts in zip(calls, plan.facts, strict=True):
                call.facts = facts
            self._plans[kinds] = plan
        return self._plans[kinds]


@dataclass
class _Level:
    """A transformation, and what it means for arrays by their names: the batch axis, or whether there is a tangent."""

    number: int
    kind: str
    size: int = 0
    of: dict[Name, Any] = field(default_factory=dict)

    def step(self, names: Sequence[Name]) -> tuple | None:
        """The step of a call with these arguments; None if it has no part in the transformation."""
        known = tuple(self.of[name] for name in names)
        if self.kind == "vmap":
            return ("vmap", self.size, known) if any(axis is not None for axis in known) else None
        return ("jvp", known) if any(known) else None

    def added(self, names: Sequence[Name]) -> list[Name]:
        """Names of the arrays that it adds to these."""
        return [("tangent", self.number, name) for name in names if self.of[name]] if self.kind == "jvp" else []


class _Plan:
    """The parts' executables for arguments of known shapes; makes them, side by side.

    Attributes: results: names of the results; forms: {name: array or shape}; facts: those of the calls that the
    transformations make, the first one's first.
    """

    def __init__(self, sequence: Callable, arguments: tuple, steps: Sequence[tuple], arrays: Sequence):
        leaves, tree = jax.tree.flatten(arguments)
        count = sum(isinstance(leaf, Place) for leaf in leaves)
        self.given: list[Name] = [("argument", i) for i in range(count)]
        self.levels: list[_Level] = []
        for number, step in enumerate(steps):
            level = _Level(number, step[0], step[1] if step[0] == "vmap" else 0)
            level.of = dict(zip(self.given, step[-1], strict=True))
            self.levels.append(level)
            self.given += level.added(self.given)
        self.forms: dict[Name, Any] = dict(zip(self.given, arrays, strict=True))
        self.parts: list[tuple[Pending, list[Name], list[Name]]] = []

        named = (_Named(("argument", i)) for i in range(count))
        arguments = jax.tree.unflatten(tree, [next(named) if isinstance(leaf, Place) else leaf for leaf in leaves])
        returned = sequence(self._add, *arguments)
        leaves, tree = jax.tree.flatten(returned)
        names = [leaf.name for leaf in leaves if isinstance(leaf, _Named)]
        places = [Place() if isinstance(leaf, _Named) else leaf for leaf in leaves]
        self.facts: list[Any] = [jax.tree.unflatten(tree, places)]
        for level in self.levels:
            known = (level.of[name] for name in names)
            self.facts.append(tuple(one is not None if level.kind == "vmap" else one for one in known))
            names += level.added(names)
        self.results: list[Name] = names

    def run(self, arrays: Sequence[ArrayLike]) -> list[Array]:
        """Results for arrays."""
        values: dict[Name, Any] = dict(zip(self.given, arrays, strict=True))
        for pending, taken, made in self.parts:
            values.update(zip(made, pending.get()([values[name] for name in taken]), strict=True))
        return [values[name] for name in self.results]

    def _add(self, program: Program, *arguments: Any) -> Any:
        """Take a program as the next part; returns its results as names."""
        leaves, tree = jax.tree.flatten((arguments, {}))
        static = tuple(Place() if isinstance(leaf, _Named) else leaf for leaf in leaves)
        taken: list[Name] = [leaf.name for leaf in leaves if isinstance(leaf, _Named)]
        base = call = program.call(tree, static, tuple(kind(self.forms[name]) for name in taken))
        assert isinstance(call, Call)  # a part has no parts
        steps = []
        for level in self.levels:
            step = level.step(taken)
            steps.append(step)
            if step is not None:
                call = call.then(step)
                taken = taken + level.added(taken)
        pending = call.pending([self.forms[name] for name in taken])
        pending.begin()
        number = len(self.parts)
        facts = (one.facts for one in call.chain()[-2::-1])
        made: list[Name] = [("result", number, i) for i in range(_count(base.facts))]
        results = iter([_Named(name) for name in made])
        for level, step in zip(self.levels, steps, strict=True):
            unchanged = None if level.kind == "vmap" else False
            of_results = (unchanged,) * len(made) if step is None else next(facts)
            if level.kind == "vmap":
                of_results = tuple(0 if has_axis else None for has_axis in of_results)
            level.of.update(zip(made, of_results, strict=True))
            made = made + level.added(made)
        self.forms.update(zip(made, pending.head.shapes(), strict=True))
        self.parts.append((pending, taken, made))
        return jax.tree.map(lambda x: next(results) if isinstance(x, Place) else x, base.facts)


def _on_chosen_devices(arrays: Sequence) -> bool:
    """Whether the user has put arrays on devices: where a part's results will be is then not known ahead."""
    return any(kind(array)[-1] is not None for array in arrays)


def _count(tree: Any) -> int:
    return sum(isinstance(leaf, Place) for leaf in jax.tree.leaves(tree))
