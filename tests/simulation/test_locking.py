"""A prescribed motion beyond the limit of a mechanism: where its loop stops closing, and the status that says so."""

import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    Case,
    Joint,
    Mechanism,
    MomentTable,
    PrescribedDisplacements,
    PrescribedRate,
    PrescribedSpinUp,
    PrescribedTable,
    Problem,
    RungeKutta4,
    Simulation,
    Study,
    assembly_errors,
    discretise,
    run_cases,
    simulate,
)
from rfem_jax.description.methods import named_method
from rfem_jax.mechanics.model.status import PAST_LIMIT
from rfem_jax.simulation import drive_limit
from tests.mechanisms import four_bar, link

CRANK, COUPLER, ROCKER, BASE = 0.3, 0.25, 0.2, 0.3
START = np.radians(60.0)
# Coupler and rocker in line.
LIMIT = np.arccos((CRANK**2 + BASE**2 - (COUPLER + ROCKER) ** 2) / (2.0 * CRANK * BASE))


def locking(rfes=None, **more):
    """A four-bar whose crank cannot turn round, rigid unless it has rfes; angles are against the y axis."""
    pin = CRANK * np.array([np.cos(START), np.sin(START)])
    across = np.array([BASE, 0.0]) - pin
    away = np.linalg.norm(across)
    inner = np.arccos((COUPLER**2 + away**2 - ROCKER**2) / (2.0 * COUPLER * away))
    coupler = np.arctan2(across[1], across[0]) + inner
    end = pin + COUPLER * np.array([np.cos(coupler), np.sin(coupler)])
    rocker = np.arctan2(end[1], end[0] - BASE)
    joints = [
        Joint("A", "base", "crank", angle=-START),
        Joint("B", "crank", "coupler", angle=-(coupler - START)),
        Joint("D", "base", "rocker", position=(BASE, 0.0, 0.0), angle=-rocker),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    links = [link("crank", CRANK), link("coupler", COUPLER, rfes), link("rocker", ROCKER)]
    rigid = {} if rfes else {"redundant_reactions": "minimum_norm"}
    return Mechanism(links, joints, gravity=(0.0, 0.0, 0.0), driven_joint="A", **rigid, **more)


@pytest.fixture(scope="module")
def model():
    return discretise(locking())


class TestWhereItLocks:
    @pytest.mark.long
    def test_by_drives_of_all_kinds(self, model):
        """Time and angle are those of the closed form."""
        way = LIMIT - START
        times = np.linspace(0.0, 4.0, 9)
        drives = [
            (PrescribedRate("A", -0.5), way / 0.5),
            (PrescribedTable("A", times, -0.25 * times), way / 0.25),
            (PrescribedSpinUp("A", -1.0, 0.4), way + 0.2),
        ]
        text = ""
        for drive, time in drives:
            limit = drive_limit(model, drive, 4.0)
            assert limit is not None and limit.label == "A" and not limit.slide
            np.testing.assert_allclose([limit.position, limit.start], [-LIMIT, -START], rtol=1e-5)
            assert limit.time == pytest.approx(time, rel=1e-4)
            text = limit.text
        assert "with A at -97.181 deg (-37.181 deg from its start)" in text

    @pytest.mark.slow
    def test_nowhere(self, model):
        way = LIMIT - START
        assert drive_limit(model, PrescribedRate("A", -0.5), 0.95 * way / 0.5) is None
        assert drive_limit(model, MomentTable("A", [0.0, 1.0], [1.0, 1.0]), 1.0) is None
        assert drive_limit(model, None, 1.0) is None
        # A crank that turns round, a hundred times; and one that goes to and fro before the limit.
        turns = discretise(four_bar(None, redundant_reactions="minimum_norm"))
        assert drive_limit(turns, PrescribedRate("A", 100.0), 6.3) is None
        times = np.linspace(0.0, 4.0, 81)
        to_and_fro = PrescribedTable("A", times, -0.9 * way * np.sin(3.0 * times))
        assert drive_limit(model, to_and_fro, 4.0) is None
        beyond = PrescribedTable("A", times, -1.1 * way * np.sin(3.0 * times))
        found = drive_limit(model, beyond, 4.0)
        assert found is not None and found.time == pytest.approx(np.arcsin(1.0 / 1.1) / 3.0, rel=1e-3)

    def test_of_a_slide(self):
        """A slider-crank pushed beyond its dead centre."""
        joints = [
            Joint("A", "base", "crank", angle=-np.pi / 2),
            Joint("B", "crank", "rod", angle=np.pi / 2 + np.arcsin(0.1 / 0.3)),
            Joint("G", "base", "piston", kind="prismatic", displacement=np.sqrt(0.3**2 - 0.1**2)),
            Joint("C", "rod", "piston", cut=True, child_position=(0.0, 0.0, 0.0)),
        ]
        links = [link("crank", 0.1), link("rod", 0.3), link("piston", 0.05)]
        mechanism = Mechanism(links, joints, driven_joint="G", redundant_reactions="minimum_norm")
        drive = PrescribedDisplacements("G", [0.0, 1.0], [0.0, 0.2])
        limit = drive_limit(discretise(mechanism), drive, 1.0)
        assert limit is not None and limit.slide
        assert limit.position == pytest.approx(0.4, abs=1e-6)
        assert limit.time == pytest.approx((0.4 - np.sqrt(0.08)) / 0.2, rel=1e-4)
        assert "with G at 0.4 m (0.11716 m from its start)" in limit.text


class TestStatus:
    @pytest.mark.long
    @pytest.mark.parametrize("method", ["rk4", "generalised_alpha"])
    def test_of_a_run(self, method):
        model = discretise(locking())
        drive = PrescribedRate("A", -4.0)
        duration, time = 0.3, (LIMIT - START) / 4.0
        settings = {"drive": drive, "method": named_method(method, step=2e-3), "save_every": 1e-2}
        run = simulate(Simulation(model, duration=duration, **settings))
        assert int(run.status) == PAST_LIMIT, STATUS[int(run.status)]
        # Before the limit all is well.
        assert int(simulate(Simulation(model, duration=0.9 * time, **settings)).status) == 0

    @pytest.mark.long
    def test_of_a_batch_and_of_samples(self):
        """Cases of a study with errors; samples of a problem know it, too, by the words for their code."""
        method, cases = RungeKutta4(step=2e-3), [Case("nominal"), Case("shifted", {"D.d_x": 1e-4})]
        study = Study("", locking(), PrescribedRate("A", -8.0), 0.1, method, 1e-2, cases)
        model, runs = run_cases(study)
        assert [STATUS[int(run.status)].name for run in runs.values()] == ["past_limit"] * 2
        assert np.isfinite(runs["shifted"].motion.angle[:5]).all()
        problem = Problem(
            Simulation(model, drive=study.drive, duration=0.1, method=method, save_every=1e-2), ["A.rms_force"]
        )
        assert problem.describe_status(3) == "past_limit" and problem.describe_status(1) == "not_assembled"
        early = Problem(
            Simulation(model, drive=study.drive, duration=0.02, method=method, save_every=1e-2), ["A.rms_force"]
        )
        assert early.describe_status(3) == "diverged"

    @pytest.mark.long
    def test_not_of_a_run_that_fails_before(self):
        """Too long a step fails at once: the limit that comes later is not why."""
        model = discretise(locking(3))
        settings = {"drive": PrescribedRate("A", -0.5), "method": RungeKutta4(step=1e-3), "save_every": 1e-2}
        run = simulate(Simulation(model, duration=1.5, **settings), assembly_errors(model, {"D.d_y": 1e-4}))
        assert STATUS[int(run.status)].name == "diverged"
