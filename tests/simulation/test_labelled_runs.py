"""Runs as labelled data: dimensions, units, netCDF, tables, HTML; of a rigid pendulum on a guide."""

import jax
import numpy as np
import pytest
import xarray

from rfem_jax import (
    Case,
    GeneralisedAlpha,
    InputError,
    Joint,
    Mechanism,
    PrescribedSpeed,
    RungeKutta4,
    Simulation,
    Study,
    run_cases,
    simulate,
)
from rfem_jax.simulation import one_of
from rfem_jax.simulation.outcome.run import Loads
from rfem_jax.validation.clearances import SOFT, WEIGHT, hung

from ..mechanisms import link

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def runs():
    """Two cases of a slider that is moved along x and carries a pendulum."""
    joints = [Joint("G", "base", "slider", kind="prismatic"), Joint("A", "slider", "arm", angle=0.2)]
    mechanism = Mechanism([link("slider", 0.1), link("arm", 0.3)], joints, driven_joint="G")
    cases = (Case("nominal"), Case("tilted", {"A.delta_x": 0.01}))
    drive = PrescribedSpeed("G", 0.5)
    _, found = run_cases(Study(HOSTILE, mechanism, drive, 0.02, RungeKutta4(step=2e-3), 0.01, cases))
    return found


@pytest.mark.long
def test_loads_have_a_joint_axis(runs):
    loads = runs["tilted"].loads
    assert loads.joints == ("A", "G") and loads.force.shape == (3, 2, 3)
    np.testing.assert_array_equal(loads.force[:, 1], loads["G"].force)
    np.testing.assert_array_equal(loads.moment[:, 0], loads["A"].moment)
    plain = dict(loads)
    assert jax.tree.leaves(loads)[0] is jax.tree.leaves(plain)[0]
    assert [path for path, _ in jax.tree.leaves_with_path(loads)] == [p for p, _ in jax.tree.leaves_with_path(plain)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *runs.values())
    assert isinstance(batch.loads, Loads) and batch.loads.force.shape == (2, 3, 2, 3)
    np.testing.assert_array_equal(one_of(batch, 1).loads.force, loads.force)
    turned = jax.vmap(lambda one: one.force[0])(batch.loads)
    np.testing.assert_array_equal(turned, batch.loads.force[:, 0])


def test_a_dataset_of_all_cases(runs):
    found = runs.to_xarray()
    assert found.force.dims == ("case", "time", "joint", "component") and found.force.attrs["units"] == "N"
    tilted = runs["tilted"]
    np.testing.assert_array_equal(found.force.sel(case="tilted", joint="A"), tilted.loads["A"].force)
    np.testing.assert_array_equal(found.preload_moment.sel(case="tilted", joint="G"), tilted.preload["G"].moment)
    np.testing.assert_array_equal(found.rms_force.sel(case="nominal"), [*runs["nominal"].metrics.rms_force.values()])
    np.testing.assert_allclose(found.time, [0.0, 0.01, 0.02])
    # The drive is a translation, the pendulum's coordinate an angle.
    np.testing.assert_allclose(found.drive_displacement.sel(translation="G")[0], [0.0, 0.005, 0.01])
    assert found.drive_force.attrs["units"] == "N" and "drive_angle" not in found
    np.testing.assert_array_equal(found.joint_angle.sel(case="nominal", angle="A"), runs["nominal"].motion.angles["A"])
    np.testing.assert_array_equal(found.total_energy.sel(case="tilted"), tilted.energy.total)
    np.testing.assert_array_equal(found.link_end.sel(case="tilted", link="arm"), tilted.motion.ends["arm"])
    line = found.centre_line.sel(case="tilted", link="arm").dropna("point")
    np.testing.assert_array_equal(line, tilted.motion.centre_lines["arm"])
    assert found.status.attrs["flag_meanings"].split()[int(found.status[0])] == "ok"
    lacking = [name for name in found.variables if name not in found.dims and not found[name].attrs.get("units")]
    assert lacking == [] and all(found[name].attrs["long_name"] for name in found.data_vars)


@pytest.mark.long
def test_contacts_of_pins(tmp_path):
    method = GeneralisedAlpha(step=1e-4)
    run = simulate(Simulation(hung(SOFT), drive=None, duration=3e-4, method=method, save_every=1e-4))
    found, pin = run.to_xarray(), run.contacts["D"]
    assert found.contact_force.dims == ("time", "pin", "contact") and found.contact_force.attrs["units"] == "N"
    np.testing.assert_array_equal(found.contact_force.sel(pin="D", contact="end"), pin.normal_force[:, 1])
    np.testing.assert_array_equal(found.contact_penetration.sel(pin="D"), pin.penetration)
    place = found.pin_eccentricity.sel(pin="D", pin_end="start", direction="z")
    np.testing.assert_array_equal(place, pin.eccentricity[:, 0, 1])
    np.testing.assert_array_equal(found.pin_along.sel(pin="D"), pin.along)
    np.testing.assert_array_equal(found.contact_loss.sel(pin="D"), run.contact_losses["D"])
    assert float(found.contact_changes) == float(run.contact_changes)
    # The body hangs on both ends of the pin.
    np.testing.assert_allclose(found.contact_force.isel(time=-1, pin=0), [0.5 * WEIGHT, 0.5 * WEIGHT, 0.0], atol=1e-4)
    found.to_netcdf(tmp_path / "run.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "run.nc", engine="scipy") as read:
        assert [str(one) for one in read.contact.values] == ["start", "end", "axial"]


def test_netcdf_keeps_everything(runs, tmp_path):
    found = runs["tilted"].to_xarray()
    assert found.force.dims == ("time", "joint", "component")
    found.to_netcdf(tmp_path / "run.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "run.nc", engine="scipy") as read:
        assert set(read.variables) == set(found.variables)
        for name in found.data_vars:
            np.testing.assert_array_equal(read[name], found[name], err_msg=name)
            assert read[name].attrs["units"] == found[name].attrs["units"]
        assert [str(one) for one in read.joint.values] == ["A", "G"]


def test_a_table_of_joints(runs):
    table = runs.to_pandas()
    assert table.index.names == ["case", "joint"] and len(table) == 4
    metrics, start = runs["tilted"].metrics, runs["tilted"].preload["G"]
    assert table.loc[("tilted", "G"), "rms_moment_Nm"] == float(metrics.rms_moment["G"])
    assert table.loc[("tilted", "G"), "preload_force_z_N"] == float(start.force[2])
    one = runs["tilted"].to_pandas()
    assert list(one.index) == ["A", "G"] and list(one.columns) == list(table.columns)


def test_what_has_no_table_is_refused(runs):
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *runs.values())
    with pytest.raises(InputError, match="must be of one run"):
        batch.to_pandas()
    with pytest.raises(InputError, match="must have one axis"):
        jax.tree.map(lambda leaf: leaf[None], batch).to_xarray()


def test_html_of_runs_is_escaped(runs):
    run = runs["tilted"]
    text = run._repr_html_()
    assert "<table>" in text and "status ok" in text and f"{float(run.metrics.rms_force['A']):.6g}" in text
    assert "tilted" in runs._repr_html_() and runs._repr_html_().count("<tr>") == 5
    loads = Loads({HOSTILE: run.loads["A"]})
    metrics = jax.tree.map(lambda x: x, run.metrics)
    for one in vars(metrics).values():
        one[HOSTILE] = one["A"]
    preload = {HOSTILE: run.preload["A"]}
    hostile = type(runs)({HOSTILE: replaced(run, loads=loads, metrics=metrics, preload=preload)})
    for text in (hostile._repr_html_(), hostile[HOSTILE]._repr_html_()):
        assert "<script" not in text and "&lt;script&gt;" in text
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *runs.values())
    assert "a batch of (2,) runs" in batch._repr_html_()


def replaced(run, **fields):
    """A run with other fields."""
    made = object.__new__(type(run))
    for name, value in {**vars(run), **fields}.items():
        object.__setattr__(made, name, value)
    return made
