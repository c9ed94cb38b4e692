"""A small study and synthetic runs with known numbers: reports are tested without simulating."""

import csv
from types import SimpleNamespace

import numpy as np
import pytest

import rfem_jax.simulation
from rfem_jax import load_study
from rfem_jax.mechanics.model.discretisation import StartHeld
from rfem_jax.report import command_line
from rfem_jax.report.tasks import study_problem
from tests.description.conftest import refused  # noqa: F401

STUDY = """
title = "Test four-bar"

[mechanism]
gravity = [0.0, 0.0, -9.81]
[mechanism.materials.steel]
youngs_modulus = "210 GPa"
poisson_ratio = 0.3
density = 7850.0
[mechanism.sections.bar]
shape = "rectangle"
width = "10 mm"
height = "20 mm"

[[mechanism.links]]
name = "crank"
length = 0.12
section = "bar"
material = "steel"
rigid = true
[[mechanism.links]]
name = "coupler"
length = 0.30
section = "bar"
material = "steel"
rfes = 5
point_masses = [{ mass = 0.1, position = 0.15 }]
[[mechanism.links]]
name = "rocker"
length = 0.30
section = "bar"
material = "steel"
rfes = 5

[[mechanism.joints]]
name = "A"
parent = "base"
child = "crank"
angle = "-90 deg"
[[mechanism.joints]]
name = "B"
parent = "crank"
child = "coupler"
angle = "54.4 deg"
[[mechanism.joints]]
name = "D"
parent = "base"
child = "rocker"
position = [0.3, 0.0, 0.0]
angle = "-100.8 deg"
[[mechanism.joints]]
name = "C"
parent = "coupler"
child = "rocker"
cut = true

[drive]
joint = "A"
kind = "moment_ramp"
moment = 1.5
rise_time = 0.1

[simulation]
duration = 0.5
method = "rk4"
step = 1e-5
save_every = 0.05

[[cases]]
name = "P1"
[[cases]]
name = "P2"
errors = { "D.delta_x" = "0.5 deg" }
[[cases]]
name = "P3"
errors = { "D.d_y" = "0.5 mm", "coupler.length" = "-0.1 mm" }
"""

JOINTS = ("A", "B", "D", "C")
START = StartHeld("as_given", ("A",), (), ())
NOMINAL = {
    "crank": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.12)),
    "coupler": ((0.0, 0.0, 0.12), (0.244, 0.0, 0.295)),
    "rocker": ((0.3, 0.0, 0.0), (0.244, 0.0, 0.295)),
}


def rows_of(path):
    """The rows of a CSV file, by the names of its columns."""
    with path.open(newline="", encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


def joint_vector(size, number):
    """(11, 3) loads whose components are easy to tell apart: size * (1, 2, 3) + number."""
    return size * np.array([1.0, 2.0, 3.0]) + number + np.zeros((11, 3))


def synthetic_run(size, status=0):
    """A run in the form of `rfem_jax.simulation.Run`; `size` scales what errors cause."""
    times = np.linspace(0.0, 0.5, 11)
    numbered = tuple(enumerate(JOINTS))
    loads = {
        joint: SimpleNamespace(force=joint_vector(size, number), moment=0.1 * joint_vector(size, number))
        for number, joint in numbered
    }
    preload = {joint: SimpleNamespace(force=load.force[0], moment=load.moment[0]) for joint, load in loads.items()}
    nominal = {link: np.linspace(*ends, 9) for link, ends in NOMINAL.items()}
    bend = np.linspace(0.0, 1e-3, 9)[:, None] * np.array([0.0, 1.0, 0.0])
    metrics = {
        name: {joint: factor * (number + 1.0) * size for number, joint in numbered}
        for name, factor in (
            ("rms_force", 1.0),
            ("rms_moment", 0.1),
            ("max_force", 4.0),
            ("max_moment", 0.4),
            ("max_axial_force", 2.0),
            ("max_normal_force", 3.0),
        )
    }
    motion = SimpleNamespace(
        angle=-1.5 + 20.0 * times + 0.01 * size * times,
        rate=20.0 + 0.0 * times,
        angle_end=8.5 + 0.005 * size,
        rate_end=20.0,
        angles={"A": times, "B": 2.0 * times, "D": 0.1 * times * size},
        displacements={},
        drive_moment=np.where(times <= 0.1, 15.0 * times, 0.0),
        centre_lines={link: line + (0.0 if link == "crank" else size) * bend for link, line in nominal.items()},
        nominal_lines=nominal,
        branch={"C": np.where(times < 0.2, 1.0, -1.0)},
        positions=None,
    )
    checks = SimpleNamespace(
        energy_balance_error=1e-7,
        closure_drift=2e-12,
        closure_drift_angle=3e-12,
        momentum_balance_error=4e-12,
        start_stability=None,
        stabilisation_share=5e-6,
        solution_residual=6e-7,
        linear_error=1e-4,
    )
    return SimpleNamespace(
        times=times,
        motion=motion,
        checks=checks,
        loads=loads,
        preload=preload,
        energy=SimpleNamespace(
            kinetic=times, elastic=0.5 * times, gravity=-0.25 * times, work=times, dissipation=times
        ),
        metrics=SimpleNamespace(**metrics),
        status=np.int32(status),
        friction_losses={},
        contacts={},
        couplings={},
        contact_losses={},
        points={},
        recorded={},
        contact_changes=None,
        model=None,
    )


@pytest.fixture
def answered_by(tmp_path, monkeypatch):
    """The path of the small study with tables of tasks, whose problem is a function's in place of the simulator's; no
    settings of the process are changed."""

    def write(build_problem, tables):
        monkeypatch.setattr(study_problem, "build_problem", build_problem)
        monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
        monkeypatch.setattr(rfem_jax.simulation, "check_step", lambda model, method, drive: 1.9e-5)
        path = tmp_path / "study.toml"
        path.write_text(STUDY + tables, encoding="utf-8")
        return path

    return write


@pytest.fixture
def study_file(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


@pytest.fixture
def study(study_file):
    return load_study(study_file)


def synthetic_runs():
    return {"P1": synthetic_run(0.0), "P2": synthetic_run(2.0), "P3": synthetic_run(1.0)}


def all_complete():
    return dict.fromkeys(("P1", "P2", "P3"), ("ok", "The run is complete."))


@pytest.fixture
def runs():
    return synthetic_runs()


@pytest.fixture
def statuses():
    return all_complete()


@pytest.fixture(scope="module")
def commands_here():
    """Commands run in this process and leave JAX as it is, whose devices other tests have found."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command_line, "set_up_jax", lambda *_: None)
        yield
