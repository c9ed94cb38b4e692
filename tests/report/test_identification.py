"""Identification on a closed form: from the study file and its measurements to table, files, pictures and page."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, InputError, Metric, load_study
from rfem_jax.report.command_line import main
from rfem_jax.report.contents.files import axes_columns, history_columns
from rfem_jax.report.page.folder import folder_content
from rfem_jax.report.tasks.catalogue import report_on
from rfem_jax.report.tasks.task_overview import tasks_text
from rfem_jax.simulation import run_cases
from rfem_jax.text_layout import WIDTH
from rfem_jax.tolerancing.identification.signals import run_columns, signal
from tests.study_texts import STEEL, hinge, link, rectangle

from .conftest import STUDY, rows_of

TIMES = np.linspace(0.0, 0.5, 101)
TRUTH = {"D.delta_x": np.radians(0.1), "D.d_y": -5e-5}
TABLES = """
[tolerances]
"D.delta_x" = { half_width = "0.25 deg", distribution = "normal" }
"D.d_y" = { half_width = "0.25 mm", distribution = "normal" }
[identification]
data = "measured.csv"
starts = 4
samples = 64
[identification.signals]
rate_rad_s = { noise = "0.02 rad/s" }
A_force_x_N = { noise = 0.3, offset = "1 N" }
[identification.candidates]
D_force_y_N = { noise = 0.1 }
"""
CORRECTION = """
[identification.correction]
metric = "D.rms_moment"
limits = { "D.rms_moment" = 0.05 }
[identification.correction.adjustments]
"D.delta_x" = ["-0.2 deg", "0.2 deg"]
"D.d_y" = ["-0.2 mm", "0.1 mm"]
"""


def load(errors):
    """A metric that both errors together make."""
    tilt, shift = (errors[name] / size for name, size in (("D.delta_x", 2e-3), ("D.d_y", 1e-4)))
    return {"D.rms_moment": jnp.sqrt(1e-4 + (0.2 * tilt + 0.3 * shift) ** 2 + (0.5 * shift) ** 2)}


def signals(errors):
    t = jnp.asarray(TIMES)
    tilt, shift = (errors[name] / size for name, size in (("D.delta_x", 2e-3), ("D.d_y", 1e-4)))
    return {
        "time_s": t,
        "rate_rad_s": 10.0 * t + 0.3 * tilt * jnp.sin(9.0 * t),
        "A_force_x_N": 5.0 + shift * jnp.cos(20.0 * t) + tilt * t,
        "D_force_y_N": 4.0 * shift * t,
    }


def build(study, metrics, model=None, trials=None):
    if "D.rms_moment" in metrics:
        return FunctionProblem(load, tuple(TRUTH), [Metric("D.rms_moment", "N m")], error_units={"D.d_y": "m"})
    names = ["time_s", *(one.name for one in metrics)]
    return FunctionProblem(
        lambda errors: {name: signals(errors)[name] for name in names}, (*TRUTH, "D.delta_z"),
        [Metric(name) for name in names], error_units={"D.d_y": "m"},
    )  # fmt: skip


def measure(path, noise=1.0, force=0.0):
    """A table in which the force is sampled at every second time only, by a sensor that adds `force` [N]."""
    rng, values = np.random.default_rng(0), signals(TRUTH)
    lines = ["time_s, rate_rad_s, A_force_x_N"]
    for k in range(1, 100):
        rate = float(values["rate_rad_s"][k]) + 0.02 * noise * rng.normal()
        load = float(values["A_force_x_N"][k]) + force + 0.3 * noise * rng.normal()
        lines.append(f"{TIMES[k]:.3f}, {rate:.5f}, {f'{load:.5f}' if k % 2 else ''}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def path(answered_by, tmp_path):
    measure(tmp_path / "measured.csv")
    return answered_by(build, TABLES)


def test_errors_are_identified_written_and_drawn(path, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["identify", str(path), "--out", str(out)]) == 0
    assert {one.name for one in out.iterdir()} == {
        *("identification.csv", "identification.json", "identification_curves.csv", "report.html"),
        *("identification_curves.png", "identification_errors.png", "identification_posterior.png"),
    }
    found = json.loads((out / "identification.json").read_text(encoding="utf-8"))
    assert found["status"] == "ok" and found["intervals_by"] == "laplace"
    for row, (name, truth) in zip(rows_of(out / "identification.csv"), TRUTH.items(), strict=True):
        assert row["error"] == name and float(row["estimate"]) == pytest.approx(found["estimate"][name])
        assert float(row["low"]) < truth < float(row["high"])
        assert float(row["tolerance_high"]) == -float(row["tolerance_low"])
    assert [one["samples"] for one in found["signals"]] == [99, 50]
    curves = rows_of(out / "identification_curves.csv")
    assert len(curves) == 149 and {row["unit"] for row in curves} == {"rad/s", "N"}
    left = {
        when: np.std([float(row["measured"]) - float(row[when]) for row in curves[:99]]) for when in ("before", "after")
    }
    assert left["after"] == pytest.approx(0.02, rel=0.2) and left["before"] > 5.0 * left["after"]
    # The candidate tells most of the shift, and is chosen first or second of three.
    worth = {one["column"]: one for one in found["visibility"]["signals"]}
    assert set(worth) == {"rate_rad_s", "A_force_x_N", "D_force_y_N"} and worth["D_force_y_N"]["place"] < 3
    checked = {one["what"]: one for one in found["divisions"]}
    assert set(checked) == {"save_every", "rfes"} and not any(one["coarse"] for one in checked.values())
    assert checked["rfes"]["movement"] == [0.0, 0.0]  # a closed form has no links
    printed = capsys.readouterr().out
    assert "status ok" in printed and "D.delta_x" in printed and "What the signals tell" in printed
    assert "The model is fine enough" in printed
    assert max(len(line) for line in printed.splitlines() if str(tmp_path) not in line) <= WIDTH
    (task,) = folder_content(out)["tasks"]
    assert task["name"] == "identification" and len(task["result"]["curves"]) == 2


@pytest.mark.long
def test_the_pictures_show_what_was_measured_and_found(path, tmp_path):
    report = report_on(load_study(path), "identification")
    result = report.run(tmp_path)
    figures = report.pictures(result)
    measured, before, after = figures["identification_curves"].axes[0].lines
    np.testing.assert_array_equal(measured.get_ydata(), result.curves[0].measured)
    np.testing.assert_array_equal(before.get_ydata(), result.curves[0].before)
    np.testing.assert_array_equal(after.get_ydata(), result.curves[0].after)
    axes = figures["identification_errors"].axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), result.estimate / result.prior_deviation)
    assert [one.get_width() for one in axes.patches] == pytest.approx([6.0, 6.0])  # tolerances of 3 deviations


@pytest.mark.long
def test_a_correction_is_written_told_and_drawn(path, tmp_path, capsys):
    path.write_text(STUDY + TABLES + CORRECTION, encoding="utf-8")
    study, out = load_study(path), tmp_path / "out"
    assert main(["identify", str(path), "--out", str(out)]) == 0
    found = json.loads((out / "identification.json").read_text(encoding="utf-8"))["correction"]
    rows = rows_of(out / "identification_correction.csv")
    assert [row["correction"] for row in rows] == ["as it is", "D.delta_x", "D.d_y", "all together"]
    for row, one in zip(rows, found["outcomes"], strict=True):
        assert float(row["mean"]) == pytest.approx(one["mean"])
        assert float(row["amount_D.d_y"]) == pytest.approx(one["amounts"][1])
        assert float(row["broken_D.rms_moment"]) == pytest.approx(one["broken"]["D.rms_moment"])
        true = float(
            load({name: value + one["amounts"][i] for i, (name, value) in enumerate(TRUTH.items())})["D.rms_moment"]
        )
        assert one["low"] < true < one["high"]
        values, below = one["distribution"]["values"], one["distribution"]["below"]
        assert (np.diff(values) >= 0.0).all() and below[-1] == pytest.approx(1.0) and len(values) <= 200
    # The shift alone does most; it undoes the tilt's part, too: 0.2 tilt + 0.3 shift and 0.5 shift are least together.
    tilt = found["outcomes"][0]["mean"]
    assert found["best"] == "D.d_y" and tilt > found["outcomes"][2]["mean"] > found["outcomes"][3]["mean"]
    undone = np.array(found["outcomes"][3]["amounts"]) + list(TRUTH.values())
    assert (np.abs(undone) < [6e-5, 1.8e-5]).all()  # three standard deviations of what is known
    printed = capsys.readouterr().out
    assert "Correction: status ok" in printed and "The best single adjustment: D.d_y by" in printed
    report = report_on(study, "identification")
    result = report.run(tmp_path)
    (axes,) = report.pictures(result)["identification_correction"].axes
    assert axes.lines[0].get_label() == "as it is" and len(axes.lines) == 3
    posterior = report.pictures(result)["identification_posterior"].axes[1].lines[0]
    assert np.mean(posterior.get_xdata()) == pytest.approx(np.degrees(result.estimate[0]), abs=2e-4)
    assert "correction: D.rms_moment by D.delta_x, D.d_y" in tasks_text(study)


def measure_machines(path, count=12):
    """One file with the column `machine`; the last one has noise that the sensors cannot have."""
    rng = np.random.default_rng(2)
    rows = ["machine, time_s, rate_rad_s, A_force_x_N"]
    for number in range(count):
        truth = {
            name: size * z
            for (name, size), z in zip((("D.delta_x", 1e-3), ("D.d_y", 6e-5)), rng.normal(size=2), strict=True)
        }
        values, noise = signals(truth), 5.0 if number == count - 1 else 1.0
        for k in range(1, 100):
            rate = float(values["rate_rad_s"][k]) + 0.02 * noise * rng.normal()
            force = float(values["A_force_x_N"][k]) + 0.3 * noise * rng.normal()
            rows.append(f"no {number}, {TIMES[k]:.3f}, {rate:.5f}, {force:.5f}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


@pytest.mark.long
def test_several_machines_tell_the_errors_of_production(path, tmp_path, capsys):
    measure_machines(tmp_path / "measured.csv")
    out = tmp_path / "out"
    assert main(["identify", str(path), "--out", str(out)]) == 0
    assert {one.name for one in out.iterdir()} == {
        *("identification.csv", "identification.json", "identification_machines.csv", "identification_production.png"),
        *("identification_tolerances.toml", "report.html"),
    }
    found = json.loads((out / "identification.json").read_text(encoding="utf-8"))
    for row, true in zip(rows_of(out / "identification.csv"), (1e-3, 6e-5), strict=True):
        assert float(row["deviation_low"]) < true < float(row["deviation_high"]) and float(row["mean_low"]) < 0.0
    machines = rows_of(out / "identification_machines.csv")
    assert [row["status"] for row in machines] == ["ok"] * 11 + ["misfit"] and machines[-1]["machine"] == "no 11"
    printed = capsys.readouterr().out
    assert "Production, from 11 machines: status ok" in printed and "Left out (1 misfit): no 11." in printed
    lines = (out / "identification_tolerances.toml").read_text(encoding="utf-8")
    assert lines in found["tolerances"] and lines.splitlines()[0] in printed
    again = tmp_path / "again.toml"
    again.write_text(STUDY + lines, encoding="utf-8")
    specified = load_study(again).tasks.tolerances
    assert specified.half_widths()["D.delta_x"] == pytest.approx(3.0 * found["errors"][0]["deviation"], rel=1e-4)
    figure = report_on(load_study(path), "identification")
    (axes, _) = figure.pictures(figure.run(tmp_path))["identification_production"].axes
    assert len(axes.lines[-1].get_xdata()) == 11


def test_tables_of_machines_that_cannot_be_read(path, tmp_path, capsys):
    measure_machines(tmp_path / "measured.csv", count=2)
    run = ["identify", str(path), "--out", str(tmp_path / "out")]
    assert main(run) == 2 and "`machines` must be at least 3" in capsys.readouterr().err
    text = (tmp_path / "measured.csv").read_text(encoding="utf-8")
    (tmp_path / "measured.csv").write_text(text.replace("no 1, 0.010", ", 0.010"), encoding="utf-8")
    assert main(run) == 2 and "`machine` of row 102" in capsys.readouterr().err
    path.write_text(STUDY + TABLES + CORRECTION, encoding="utf-8")
    measure_machines(tmp_path / "measured.csv", count=3)
    assert main(run) == 2 and "`correction` must be of one machine" in capsys.readouterr().err


def test_a_correction_on_doubtful_errors_is_no_success(path, tmp_path, capsys):
    measure(tmp_path / "measured.csv", noise=3.0)
    path.write_text(STUDY + TABLES + CORRECTION, encoding="utf-8")
    assert main(["identify", str(path), "--out", str(tmp_path / "out")]) == 3
    assert "Correction: status doubtful" in capsys.readouterr().out


def test_other_data_and_a_model_that_does_not_explain_them(path, tmp_path, capsys):
    measure(tmp_path / "noisy.csv", noise=3.0)
    assert main(["identify", str(path), "--out", str(tmp_path / "out"), "--data", str(tmp_path / "noisy.csv")]) == 3
    printed = capsys.readouterr().out
    assert "status misfit" in printed and "larger than the noise" in printed
    assert main(["identify", str(path), "--out", str(tmp_path / "out"), "--data", "nowhere.csv"]) == 2
    assert "nowhere.csv" in capsys.readouterr().err


def test_without_data_it_tells_what_signals_can_tell(path, tmp_path, capsys):
    more = 'experiments = { tilted = { "D.delta_z" = "0.1 deg" } }\n'
    path.write_text(STUDY + TABLES.replace('data = "measured.csv"\n', more), encoding="utf-8")
    assert main(["identify", str(path), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "Identifiability of 2 unknowns" in printed and "Which experiment tells most" in printed
    assert max(len(line) for line in printed.splitlines() if str(tmp_path) not in line) <= WIDTH
    found = json.loads((tmp_path / "out" / "identification.json").read_text(encoding="utf-8"))
    for row in found["errors"]:
        assert 0.0 < row["expected_deviation"] < 0.3 * row["prior_deviation"]
    given, tilted = found["experiments"]
    assert given["name"] == "as given" and tilted["name"] == "tilted"
    left = [row["expected_deviation"] / row["prior_deviation"] for row in found["errors"]]
    np.testing.assert_allclose(given["deviations"][-1], left, rtol=1e-12)
    np.testing.assert_allclose(tilted["lengths"], np.linspace(0.05, 0.5, 10), atol=6e-3)
    assert [one.name for one in (tmp_path / "out").glob("*.png")] == ["identification_lengths.png"]


def test_check_says_what_is_asked(path):
    text = tasks_text(load_study(path))
    assert "rate_rad_s (noise 0.02 rad/s), A_force_x_N (noise 0.3 N, offset 1 N)" in text
    assert "unknowns: D.delta_x, D.d_y" in text


@pytest.mark.parametrize(
    "before, after, words",
    [
        ("starts = 4", "starts = 0", ("[identification]", "`starts`", "at least 1")),
        ("starts = 4", 'loss = "l1"', ("[identification]", "`loss`")),
        ("starts = 4", 'unknowns = ["D.d_q"]', ("[identification]", "`D.d_q`")),
        ("starts = 4", 'unknowns = ["D.d_z"]', ("[identification]", "`unknowns`", "`D.d_z`", "tolerances")),
        ("starts = 4", 'at = { "Q.d_z" = "1 mm" }', ("`identification`", "`Q.d_z`")),
        ("starts = 4", 'bounds = { "D.d_y" = ["1 mm", "0 mm"] }', ("[identification]", "`bounds`", "rise")),
        ("starts = 4", "experiments = 3", ("[identification]", "`experiments`", "slower")),
        ("starts = 4", 'experiments = { a = { "Q.d_z" = "1 mm" } }', ("`identification`", "`a`", "`Q.d_z`")),
        (
            '"0.02 rad/s"',
            '"0.02 rad/s", filter = "low_pass"',
            ("signals.rate_rad_s]", "`filter_time`", "both, or none"),
        ),
        ("starts = 4", 'time_shift = "-1 s"', ("[identification]", "`time_shift`", "negative")),
        ("starts = 4", "time_shift = inf", ("[identification]", "`time_shift`", "finite")),
        ("starts = 4", "data = 3", ("[identification]", "`data`", "CSV")),
        ("rate_rad_s =", "rate_deg_s =", ("[identification]", "`rate_deg_s`", "SI units")),
        ('"0.02 rad/s"', '"0.02 N"', ("[identification]", "`noise` of `rate_rad_s`", "force")),
        ('"0.02 rad/s"', "-0.02", ("[identification.signals.rate_rad_s]", "`noise`", "negative")),
        ('"0.02 rad/s"', "0.0", ("[identification]", "`noise` of `rate_rad_s`", "positive")),
        ("D_force_y_N = { noise = 0.1 }", "D_force_y_N = {}", ("[identification]", "`candidates`", "`D_force_y_N`")),
        ('"D.rms_moment"\n', '"D.rms_momnt"\n', ("[identification.correction]", "`D.rms_moment`")),
        ('"D.rms_moment"\n', '"Q.rms_moment"\n', ("`identification`", "`Q`")),
        ('"D.rms_moment"\n', '"*.rms_moment"\n', ("[identification.correction]", "`metric`")),
        ('"D.d_y" = ["-0.2 mm"', '"Q.d_y" = ["-0.2 mm"', ("`identification`", "`Q.d_y`")),
        ('"D.d_y" = ["-0.2 mm"', '"D.d_y" = ["0.02 mm"', ("[identification.correction]", "`adjustments`", "0 among")),
        ('["-0.2 mm", "0.1 mm"]', '["0.2 mm", "0.1 mm"]', ("[identification.correction]", "`adjustments`", "rise")),
        ("limits = {", "limit = {", ("[identification.correction]", "`limits`")),
        ("limits = {", 'multiples_of = { "D.d_z" = 1e-4 }\nlimits = {', ("`multiples_of`", "`D.d_z`", "adjustments")),
        ("noise = 0.3", "nose = 0.3", ("[identification.signals.A_force_x_N]", "`nose`", "`noise`")),
    ],
)
def test_wrong_tables_are_refused_in_a_sentence(before, after, words, path, refused):
    tables = TABLES if before != "starts = 4" or "data" not in after else TABLES.replace('data = "measured.csv"\n', "")
    path.write_text(STUDY + (tables + CORRECTION).replace(before, after), encoding="utf-8")
    with refused(*words):
        load_study(path)


MOVES = f"""
[mechanism]
{STEEL}{rectangle()}{link("arm", 0.2)}{link("block", 0.1)}{hinge("arm")}
[[mechanism.joints]]
name = "G"
parent = "arm"
child = "block"
kind = "prismatic"
[[mechanism.points]]
name = "P"
link = "block"
position = 0.05
[simulation]
duration = 0.02
method = "generalised_alpha"
step = "2 ms"
"""
TURNS = '[[drives]]\njoint = "A"\nkind = "moment_ramp"\nmoment = 1.0\nrise_time = 0.1\n'
SLIDES = '[[drives]]\njoint = "G"\nkind = "force_ramp"\nforce = 2.0\nrise_time = 0.1\n'
IN_BASE = 'parent = "base"'
LOOSE = 'clearance = { radial = "0.05 mm", length = "20 mm", stiffness = "60 kN/mm^1.5", restitution = 0.9 }'
FORCES = """
[[mechanism.springs]]
name = "coil"
links = ["base", "block"]
points = [[0.1, 0.0, 0.4], 0.02]
stiffness = 200.0
[[mechanism.forces]]
name = "push"
link = "block"
position = 0.05
force = [0, 1.0, 2.0]
[[mechanism.forces]]
kind = "point_moment"
name = "twist"
link = "block"
position = 0.05
moment = [0, 0.1, 0.0]
[[mechanism.couplings]]
name = "rack"
joints = ["A", "G"]
ratio = "20 mm/rad"
stiffness = "2 kN/m"
"""
OF_CASES_ONLY = ("_J", "_loss_J", "_dissipation_J")  # energies are no signals


@pytest.mark.slow
@pytest.mark.parametrize(
    "drives",
    [TURNS, SLIDES, TURNS + SLIDES, FORCES + TURNS, pytest.param(LOOSE, marks=pytest.mark.long)],
    ids=["turns", "slides", "both", "forces", "clearance"],
)
def test_signals_are_the_columns_that_a_run_writes(drives, tmp_path):
    path, mechanism = tmp_path / "study.toml", MOVES
    if drives == FORCES + TURNS:
        mechanism = mechanism.replace("[mechanism]\n", "[mechanism]\nshaking_point = [0, 0, 0]\n")
        mechanism = f'metrics = ["rms_shaking_force"]\n{mechanism}'
    if drives == LOOSE:
        mechanism, drives = mechanism.replace(IN_BASE, f"{IN_BASE}\n{LOOSE}"), TURNS
    path.write_text(mechanism + drives, encoding="utf-8")
    study = load_study(path)
    (run,) = run_cases(study)[1].values()
    written, known = history_columns(study, run), dict(run_columns(run))
    measurable = [name for name in written if not name.endswith(OF_CASES_ONLY)]
    assert len(measurable) > 20 and set(measurable) <= set(known)
    for name in measurable:
        np.testing.assert_array_equal(np.asarray(known[name]()), written[name], err_msg=name)
        if name != "time_s":
            np.testing.assert_array_equal(np.asarray(signal(name)(run)), written[name])


@pytest.mark.slow
def test_loads_in_other_axes_are_signals(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(MOVES + TURNS, encoding="utf-8")
    study = load_study(path)
    (run,) = run_cases(study)[1].values()
    for axes in ("global", "child"):
        for name, values in axes_columns(study, run.loads_in(axes), axes).items():
            np.testing.assert_array_equal(np.asarray(signal(name)(run)), values)
    with pytest.raises(InputError, match="A_force_local_x_N"):
        signal("A_force_local_x_N")(run)


def build_of_experiment(study, metrics, model=None, trials=None):
    """A third error that only another experiment shows, and a rate that is larger over a longer time."""
    names = ["time_s", *(one.name for one in metrics)]

    def measured(errors):
        values = signals(errors)
        third = errors["D.delta_z"] / 2e-3 * jnp.sin(30.0 * jnp.asarray(TIMES))
        values["rate_rad_s"] = study.duration / 0.5 * values["rate_rad_s"] + third
        return {name: values[name] for name in names}

    return FunctionProblem(
        measured, (*TRUTH, "D.delta_z"), [Metric(name) for name in names], error_units={"D.d_y": "m"}
    )  # fmt: skip


@pytest.mark.long
def test_further_experiments_are_read_from_their_files(answered_by, tmp_path, capsys):
    """At another duration, as another study says, and with an error that was made on purpose."""
    tables = TABLES + (
        '[identification.measured.longer]\ndata = "longer.csv"\nstudy = "longer.toml"\n'
        '[identification.measured.turned]\ndata = "turned.csv"\nchanges = { "D.delta_z" = "0.2 deg" }\n'
    )
    path, rng = answered_by(build_of_experiment, tables), np.random.default_rng(0)
    (tmp_path / "longer.toml").write_text(STUDY.replace("duration = 0.5", "duration = 1.0"), encoding="utf-8")
    for name, duration, turned in (("measured", 0.5, 0.0), ("longer", 1.0, 0.0), ("turned", 0.5, np.radians(0.2))):
        problem = build_of_experiment(
            type("Study", (), {"duration": duration}), [Metric(one) for one in ("rate_rad_s", "A_force_x_N")]
        )
        values = problem(TRUTH | {"D.delta_z": turned})[0]
        rows = [
            f"{TIMES[k]:.3f},{values['rate_rad_s'][k] + 0.02 * rng.normal():.5f},"
            f"{values['A_force_x_N'][k] + 0.3 * rng.normal():.5f}"
            for k in range(1, 100)
        ]
        (tmp_path / f"{name}.csv").write_text("time_s,rate_rad_s,A_force_x_N\n" + "\n".join(rows), encoding="utf-8")
    out = tmp_path / "out"
    assert main(["identify", str(path), "--out", str(out)]) == 0
    found = json.loads((out / "identification.json").read_text(encoding="utf-8"))
    assert found["status"] == "ok" and [one["experiment"] for one in found["signals"]] == [1, 1, 2, 2, 3, 3]
    for row, truth in zip(found["errors"], TRUTH.values(), strict=True):
        assert row["low"] < truth < row["high"]
    alone = report_on(load_study(answered_by(build_of_experiment, TABLES)), "identification").run(tmp_path)
    assert found["errors"][0]["deviation"] < 0.6 * alone.deviation[0]
    assert "longer (longer.csv of longer.toml), turned (turned.csv)" in tasks_text(
        load_study(answered_by(build_of_experiment, tables))
    )
    capsys.readouterr()
    for old, new, words in (
        ('study = "longer.toml"', 'study = "none.toml"', ("measured.longer", "none.toml")),
        ("D.delta_z", "D.delta_x", ("`at`", "`D.delta_x` varies")),
        ("D.delta_z", "Q.delta_z", ("turned", "`Q.delta_z`")),
        ('data = "turned.csv"', "data = 3", ("`data`", "3")),
        ('data = "turned.csv"\n', "", ("turned", "`data`")),
        ('data = "measured.csv"\n', "", ("`measured`", "no `data`")),
        ("[identification.measured.turned]", "[identification.measured.turned]\nspeed = 3", ("turned", "`speed`")),
    ):
        answered_by(build_of_experiment, tables.replace(old, new))
        assert main(["identify", str(path), "--out", str(tmp_path / "refused")]) == 2
        said = capsys.readouterr().err
        assert all(word in said for word in words), (said, words)
