"""A study as a script for Exudyn, whose loads can be put beside ours.

Place in the pipeline: `load_study` -> **exudyn_writer** (with `exudyn_mechanism` and the texts of the program) -> a
script.

Only numbers are shared: those of `exudyn_mechanism` at the start, which is our assembly at rest with the rates of a
prescribed motion. Kinematics, element, constraints and integration are Exudyn's.
"""

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.study_file.study import Study
from rfem_jax.exchange.exudyn_mechanism import drive_pieces, exudyn_numbers, require_translated
from rfem_jax.mechanics.model.status import OK, STATUS
from rfem_jax.mechanics.model.topology import BASE
from rfem_jax.mechanics.statics.designs import designed, model_of_study
from rfem_jax.simulation.stages.integration import prepare

NUMBERS = 'globals().get("MECHANISM", {})'  # what they stand for in the program
PARTS = ("exudyn_system", "exudyn_loads", "exudyn_program")
OWN_IMPORT = re.compile(r"^from rfem_jax\b.*\n", re.MULTILINE)
_prepared = eqx.filter_jit(prepare)


def exudyn_text(study: Study, case: str | None, source: str) -> tuple[str, tuple[str, ...]]:
    """The script of a study with the errors of a case (None: perfect), and sentences on what it does not hold.

    **Raises:** `InputError` for what such a script cannot do without, and where the mechanism cannot be assembled.
    """
    duration = study.require_duration()
    errors = {} if case is None else study.case(case).errors
    # The start of elements that are as Exudyn's, or stiff links ring along their axes at first.
    exact = replace(study, mechanism=replace(study.mechanism, elements="geometrically_exact"), statics=None)
    model = model_of_study(exact)
    made = designed(model, None, errors)
    require_translated(made.model)  # before the assembly, which takes a while
    drive = study.designed_drive
    assert not isinstance(drive, tuple), "several have been refused"
    start = _prepared(made.model, made.errors, drive, None)
    if int(start.status) != OK:
        reason = STATUS[int(start.status)].message
        raise InputError(f"The mechanism must be assembled to be exported, but is not: {reason}")
    content = exudyn_numbers(made.model, made.errors, (start.actual, start.state)) | drive_pieces(drive, duration)
    about = json.dumps(f"{source}: a script for Exudyn; SI units, rad.")
    seen = [
        f"The path of {name} as it is seen from its link: there it is in global axes."
        for name, one in (start.actual.points or {}).items()
        if one.observer != BASE
    ]
    return f"{about}\n{_program().replace(NUMBERS, _literal(content), 1)}", tuple(seen)


def _program() -> str:
    """The parts of the program in one text that needs nothing of the package."""
    folder = Path(__file__).parent
    texts = [(folder / f"{name}.py").read_text(encoding="utf-8").split('"""', 2)[2] for name in PARTS]
    return "\n".join(OWN_IMPORT.sub("", text).strip() + "\n" for text in texts)


def _literal(content: dict[str, Any]) -> str:
    """Numbers as Python reads them, one part a line."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(one) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(one) for one in value]
        return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value

    def text(value: Any) -> str:
        return json.dumps(plain(value), allow_nan=False)

    parts = []
    for key, value in content.items():
        several = isinstance(value, list) and value and isinstance(value[0], dict)
        whole = "[\n  " + ",\n  ".join(map(text, value)) + "\n ]" if several else text(value)
        parts.append(f" {text(key)}: {whole}")
    return '__import__("json").loads(r"""{\n' + ",\n".join(parts) + '\n}""")'


def verified(text: str, study: Study, case: str | None) -> dict[str, tuple[float, float, float, float]]:
    """RMS loads by joints: force by us and by Exudyn [N], moment by us and by Exudyn [N m], of a script and its study.

    **Raises:** `InputError` where `exudyn` is not installed, or fails.
    """
    names: dict[str, Any] = {"__name__": "script"}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of names that later versions have otherwise
            exec(compile(text, "the script for Exudyn", "exec"), names)
            theirs = names["move"](names["MECHANISM"]).rms
    except ImportError:
        raise InputError(
            "The package exudyn must be there to verify, but cannot be imported; install it with "
            '`pip install "rfem_jax[bench]"`.'
        ) from None
    except RuntimeError as problem:  # of Exudyn's solver
        reason = " ".join(str(problem).split())[:200]
        raise InputError(f"Exudyn must be able to run the script to verify it, but says: {reason}") from None
    from rfem_jax.simulation import run_cases

    _, runs = run_cases(replace(study, cases=(study.case(case),) if case is not None else ()))
    ours = next(iter(runs.values())).metrics
    return {
        name: (float(ours.rms_force[name]), force, float(ours.rms_moment[name]), theirs["moment"][name])
        for name, force in theirs["force"].items()
    }
