"""The motion of a file in MuJoCo beside that of the study from which it was made.

Place in the pipeline: the text of `mjcf_writer` and its study -> **mujoco_motion** -> `rfem-jax export --verify`.

Both let the mechanism of rigid links go where the file has it, for a fifth of a second. Open chains are integrated by
methods of fourth order in both. Loops are held by soft constraints in MuJoCo, whose gaps decay with the time constant
of the file: motions are compared, loads are not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.methods import Automatic
from rfem_jax.description.study_file.study import Study
from rfem_jax.exchange.layout import Layout
from rfem_jax.exchange.mjcf_writer import left_out
from rfem_jax.exchange.study_layout import with_rigid_links

SPAN = 0.2  # s, at most
INSTANTS = 4  # of the span at which motions are compared, the last one its end
STEP = 2e-4  # s of MuJoCo's Runge-Kutta method
OPEN, CLOSED = 1e-4, 5e-3  # of the longest way: what open chains and soft loops may differ by


@dataclass(frozen=True)
class ComparedMotion:
    """Coordinates of joints with one motion [rad, m] at `times` (T,) [s]: ours and MuJoCo's, (T,) each, by names;
    `tolerance`: how much of the longest way of its dimension they may differ by."""

    times: Float[np.ndarray, " T"]
    units: dict[str, str]
    ours: dict[str, Float[np.ndarray, " T"]]
    theirs: dict[str, Float[np.ndarray, " T"]]
    tolerance: float

    def largest(self) -> float:
        """The largest difference over the longest way of coordinates of its dimension."""
        found = 0.0
        for unit in set(self.units.values()):
            names = [name for name, one in self.units.items() if one == unit]
            way = max(float(np.ptp(self.ours[name])) for name in names)
            apart = max(float(np.abs(self.ours[name] - self.theirs[name]).max()) for name in names)
            found = max(found, apart / way if way > 0.0 else float(np.inf if apart > 0.0 else 0.0))
        return found


def rigid_study(study: Study, case: str | None, layout: Layout) -> Study:
    """What the file of a layout has, as a study: rigid links, no drive, the errors of a case, the first instants.

    **Raises:** `InputError` where the file holds less, so that motions would be others.
    """
    missing = [*left_out(layout), *(one for one in layout.remarks if "stay open" in one)]
    rigid, _ = with_rigid_links(study.mechanism)
    couplings = {one.name for one in layout.ratios}
    missing += [f"The coupling {one.name}." for one in rigid.couplings if one.name not in couplings]
    if missing:
        raise InputError(
            "Argument `--verify` must be left out where the file does not move as the study with rigid links: "
            f"{' '.join(missing)[:300]}"
        )
    joints = [replace(one, rate=None, speed=None, rates=None) for one in rigid.joints]
    span = min(SPAN, study.require_duration())
    cases = () if case is None else (study.case(case),)
    return Study(
        study.title, replace(rigid, joints=joints), None, span, Automatic(accuracy=1e-6), cases=cases,
        save_every=span / INSTANTS, design=study.design,
    )  # fmt: skip


def compared(text: str, study: Study, layout: Layout) -> ComparedMotion:
    """The motions of a file and of its `rigid_study`, whose method is settled.

    **Raises:** `InputError` where `mujoco` is not installed, or one of them fails.
    """
    single = {one.name: one for one in layout.joints if not one.cut and one.kind in ("revolute", "prismatic")}
    if not single:
        raise InputError(
            "Argument `--verify` must be of a mechanism with hinges or slides in its tree, but it has none."
        )
    from rfem_jax.mechanics.model.status import STATUS
    from rfem_jax.simulation import run_cases

    run = next(iter(run_cases(study)[1].values()))
    if int(run.status) != 0:
        raise InputError(f"The study with rigid links must run to be compared, but: {STATUS[int(run.status)].message}")
    times = np.asarray(run.times)
    found = {**run.motion.angles, **run.motion.displacements}
    ours = {name: np.asarray(found[name]) for name in single}
    theirs = _by_mujoco(text, list(single), times)
    units = {name: "rad" if KINDS[one.kind].angles else "m" for name, one in single.items()}
    soft = any(one.cut for one in layout.joints) or bool(layout.ratios)
    return ComparedMotion(times, units, ours, theirs, CLOSED if soft else OPEN)


def _by_mujoco(text: str, joints: Sequence[str], times: Float[np.ndarray, " T"]) -> dict[str, Float[np.ndarray, " T"]]:
    """Coordinates at some times, by steps of equal length between them."""
    try:
        mujoco = import_module("mujoco")
    except ImportError:
        raise InputError(
            "The package mujoco must be there to verify, but cannot be imported; install it with "
            '`pip install "rfem_jax[mujoco]"`.'
        ) from None
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    rows = []
    for begin, end in zip([0.0, *times[:-1]], times, strict=True):
        count = max(round((end - begin) / STEP), 1) if end > begin else 0
        if count:
            model.opt.timestep = (end - begin) / count
            mujoco.mj_step(model, data, nstep=count)
        rows.append([float(data.joint(name).qpos[0]) for name in joints])
    if any(one.number for one in data.warning):
        raise InputError("MuJoCo must be able to simulate the file, but warns of unstable steps or numbers.")
    return dict(zip(joints, np.array(rows).T, strict=True))
