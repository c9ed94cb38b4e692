"""`rfem-jax compare`: known differences, what only one result has, files that are something else."""

import copy
import csv
import json

import pytest

from rfem_jax.report.command_line import main
from rfem_jax.report.contents.files import write_results
from rfem_jax.report.contents.summary import summarise


@pytest.fixture
def folders(study, runs, statuses, tmp_path):
    """Two folders with the same results, and a function that changes those of the second."""
    paths = [tmp_path / name / "results.json" for name in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        write_results(path, study, summarise(study, runs, statuses))
    content = json.loads(paths[1].read_text(encoding="utf-8"))

    def change(edit):
        changed = copy.deepcopy(content)
        edit(changed)
        paths[1].write_text(json.dumps(changed), encoding="utf-8")

    return str(tmp_path / "a"), str(tmp_path / "b"), change


def rows_of(document):
    return {(one["case"], one["joint"], one["quantity"]): one for one in document["differences"]}


def test_the_same_results_do_not_differ(folders, capsys):
    first, second, _ = folders
    assert main(["compare", first, second, "--json"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert captured.err == "" and found["remarks"] == []
    assert len(found["differences"]) == 3 * (4 * 6 + 2)
    assert {one["difference"] for one in found["differences"]} == {0.0}
    # The case without errors has no loads here: nothing to compare with.
    assert {one["case"] for one in found["differences"] if one["relative"] is None} == {"P1"}


def test_differences_absolute_and_relative(folders, tmp_path, capsys):
    first, second, change = folders

    def edit(content):
        content["cases"]["P2"]["joints"]["A"]["rms_force"] = 2.5  # 2 in the first
        content["cases"]["P3"]["joints"]["B"]["max_axial_force"] = None  # 4
        content["cases"]["P2"]["driven_joint"]["angle_end"] = 8.0  # 8.51

    change(edit)
    assert main(["compare", first, second, "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines()]
    assert ["P2", "A", "2.00000", "2.50000", "+0.5", "+25", "%"] in lines
    assert ["P3", "B", "4.0000", "-", "-", "-"] in lines
    assert "Largest relative difference: +25 % (rms force, case P2, joint A)." in text
    found = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    rows = rows_of(found)
    assert rows["P2", "-", "angle_end"]["relative"] == pytest.approx((8.0 - 8.51) / 8.51)
    assert rows["P3", "B", "max_axial_force"]["second"] is None and found["versions"]
    with open(tmp_path / "out" / "comparison.csv", newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(rows)
    one = next(row for row in table if (row["case"], row["joint"], row["quantity"]) == ("P2", "A", "rms_force"))
    assert (one["unit"], one["first"], one["second"], one["difference"], one["relative"]) == (
        "N",
        "2",
        "2.5",
        "0.5",
        "0.25",
    )


def test_what_only_one_has_is_said(folders, capsys):
    first, second, change = folders

    def edit(content):
        del content["cases"]["P1"], content["cases"]["P2"]["joints"]["C"]
        content["cases"]["P9"] = content["cases"]["P3"] | {"status": "diverged"}
        content["cases"]["P3"]["errors"] = {}
        content["title"] = "Another"

    change(edit)
    assert main(["compare", first, second]) == 0
    text = capsys.readouterr().out
    for sentence in (
        "They differ in title: Test four-bar; Another.",
        "Only the first has the cases: P1.",
        "Only the second has the cases: P9.",
        "Only the first has the joints of case P2: C.",
        "Case P3: errors {'D.d_y': 0.0005, 'coupler.length': -0.0001} in the first, {} in the second.",
    ):
        assert sentence in text
    change(lambda content: content.update(cases={}))
    assert main(["compare", first, second]) == 0
    assert "There is no value to compare." in capsys.readouterr().out


def test_numbers_of_cases_that_failed_carry_a_mark(folders, tmp_path, capsys):
    first, second, change = folders
    change(lambda content: content["cases"]["P2"].update(status="diverged"))
    for folder, statuses in (("a", ("ok", "ok")), ("b", ("ok", "not_assembled"))):
        cases = {name: {"status": one, "modes": [{"frequency": 3.0}]} for name, one in zip(("P1", "P3"), statuses)}
        path = tmp_path / folder / "modes.json"
        path.write_text(json.dumps({"title": "Study", "cases": cases}), encoding="utf-8")
    assert main(["compare", first, second]) == 0
    text = capsys.readouterr().out
    named = {line.split()[0] for line in text.splitlines() if line.startswith(("P1", "P2", "P3"))}
    assert named >= {"P1", "P2*", "P3"} and not {"P2", "P1*", "P3*"} & named
    assert "P3, 1*" in text and "P1, 1*" not in text
    assert "* Case P2: ok in the first, diverged in the second; these numbers are not of a complete run." in text
    assert "* Results of modes: the status of one of both says that it is not complete." in text


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"cases": 3}', '{"cases": {"P1": 3}}', '{"cases": {"P1": {"joints": []}}}'],
)
def test_what_is_something_else_is_refused(folders, tmp_path, capsys, content):
    first, second, _ = folders
    (tmp_path / "b" / "results.json").write_text(content, encoding="utf-8")
    assert main(["compare", first, second]) == 2
    assert "is something else; name another folder." in capsys.readouterr().err
    assert main(["compare", first, str(tmp_path / "none")]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_text_in_the_place_of_a_number_is_refused(folders, capsys):
    first, second, change = folders
    change(lambda content: content["cases"]["P1"]["joints"]["A"].update(rms_force="<b>"))
    assert main(["compare", first, second]) == 2
    assert "`rms_force` is '<b>' there" in capsys.readouterr().err


def task(metric=21.0, tilt=2e-3):
    return {
        "title": "Study", "units": {"D.rms_moment": "N m", "D.delta_x": "rad"}, "cost": 4.0,
        "metrics": {"D.rms_moment": {"mean": {"value": metric}, "std": {"value": 2.0}, "yield_of_all": None}},
        "tolerances": {"D.delta_x": tilt}, "samples": 64,
    }  # fmt: skip


@pytest.fixture
def task_folders(tmp_path):
    """Two folders with results of tasks alone."""
    for name, content in (("c", task()), ("d", task(22.05, 1e-3))):
        (tmp_path / name).mkdir()
        for kind in ("monte_carlo", "allocation"):
            (tmp_path / name / f"{kind}.json").write_text(json.dumps(content), encoding="utf-8")
    modes = {"cases": {"P1": {"modes": [{"frequency": 10.0}, {"frequency": 20.0}]}}}
    (tmp_path / "d" / "modes.json").write_text(json.dumps(modes), encoding="utf-8")
    return tmp_path / "c", tmp_path / "d"


def test_results_of_tasks_side_by_side(task_folders, tmp_path, capsys):
    first, second = map(str, task_folders)
    assert main(["compare", first, second, "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines()]
    assert "Monte Carlo: mean" in text and "Allocation: tolerance" in text
    assert ["D.rms_moment", "N", "m", "21.0000", "22.0500", "+1.05", "+5", "%"] in lines
    assert "Only the second has results of modes." in text and "Neither has loads of cases." in text
    found = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    rows = {(row["task"], row["of"], row["quantity"]): row for row in found["tasks"]}
    tilt = rows["allocation", "D.delta_x", "tolerance"]
    assert (tilt["unit"], tilt["first"], tilt["second"], tilt["relative"]) == ("rad", 2e-3, 1e-3, -0.5)
    assert rows["monte_carlo", "-", "samples"]["difference"] == 0.0
    assert ("monte_carlo", "D.rms_moment", "yield") not in rows  # there was no limit
    with open(tmp_path / "out" / "comparison_tasks.csv", newline="", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def test_modes_are_compared_by_case_and_number(task_folders, capsys):
    first, second = task_folders
    modes = {"cases": {"P1": {"modes": [{"frequency": 11.0}]}, "P2": {"modes": "x"}}}
    (first / "modes.json").write_text(json.dumps(modes), encoding="utf-8")
    assert main(["compare", str(first), str(second), "--json"]) == 0
    rows = {row["of"]: row for row in json.loads(capsys.readouterr().out)["tasks"] if row["task"] == "modes"}
    assert (rows["P1, 1"]["first"], rows["P1, 1"]["second"], rows["P1, 1"]["unit"]) == (11.0, 10.0, "Hz")
    assert (rows["P1, 2"]["first"], rows["P1, 2"]["second"]) == (None, 20.0)
