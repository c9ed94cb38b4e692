"""Files of others in a browser: names and texts stay texts, nothing of them runs."""

import json
import shutil

import numpy as np
import pytest

from rfem_jax.report.page.document import write_folder

ATTACKS = (
    "</script><script>window.attacked = 1</script>",
    "<img src=x onerror='window.attacked = 1'>",
    "<svg onload='window.attacked = 1'>",
    "javascript:window.attacked=1",
    "__proto__",
    "=HYPERLINK(1)",
    "a\u2028b\0<!--",
)


def poison(value, counter):
    """Every text of a JSON value, and every second key, replaced by an attack."""
    if isinstance(value, dict):
        return {key: poison(item, counter) for key, item in value.items()}
    if isinstance(value, list):
        return [poison(item, counter) for item in value]
    return ATTACKS[next(counter) % len(ATTACKS)] if isinstance(value, str) else value


def numbers():
    count = 0
    while True:
        yield count
        count += 1


@pytest.fixture
def hostile(folder, tmp_path):
    out = tmp_path / "hostile"
    shutil.copytree(folder, out)
    counter = numbers()
    for path in out.glob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        path.write_text(json.dumps(poison(content, counter)), encoding="utf-8")
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    first, second, third = results["cases"].values()
    second["joints"] = dict(zip(ATTACKS, second["joints"].values()))
    second["errors"] = {f"{attack}.delta_x": 0.01 for attack in ATTACKS} | {"D.d_y": ATTACKS[0]}
    third["joints"] = {"A": {"rms_force": {"a": [1]}, "rms_moment": ATTACKS[1], "preload_force": "x"}}
    cases = [ATTACKS[0], ATTACKS[1], "P3"]
    results |= {"title": ATTACKS[0], "note": ATTACKS[1], "cases": dict(zip(cases, (first, second, third)))}
    results["versions"] = {ATTACKS[0]: ATTACKS[1], "__proto__": {"a": ATTACKS[2]}}
    (out / "results.json").write_text(json.dumps(results), encoding="utf-8")
    with np.load(out / "animation.npz") as file:
        arrays = dict(file)
    description = json.loads(str(arrays.pop("description")))
    description["cases"] = cases
    for part in ("links", "joints"):
        for one, attack in zip(description[part], ATTACKS):
            one["name"] = attack
            one |= {key: attack for key in ("kind", "parent", "child") if key in one}
    np.savez(out / "animation.npz", description=np.array(json.dumps(description)), **arrays)
    text = (out / "P3.csv").read_text(encoding="utf-8")
    (out / "P3.csv").write_text(text.replace("rate_rad_s", "<img src=x onerror=alert(1)>_rad_s"), encoding="utf-8")
    return write_folder(out)


def test_names_and_texts_stay_texts(open_page, hostile):
    page = open_page(hostile)
    assert page.text("h1") == ATTACKS[0] and page.run("return document.title") == ATTACKS[0]
    for tab in page.all("[role=tab]"):
        page.run("arguments[0].click()", tab)
    page.run("document.querySelectorAll('button:not([role=tab])').forEach((one) => one.click())")
    page.run("document.querySelectorAll('select').forEach((one) => one.dispatchEvent(new Event('change')))")
    assert page.run("return window.attacked") is None
    assert page.run("return document.querySelectorAll('#page img, #page script, #page iframe').length") == 0
    assert page.run("return ({}).a") is None
    assert "<img src=x" in page.text("#page")  # shown as what it is
    page.click("#tab-overview")
    assert page.complaints() == []


def test_a_task_of_another_form_leaves_the_other_pages(open_page, folder, tmp_path):
    out = tmp_path / "other"
    shutil.copytree(folder, out)
    found = json.loads((out / "sweep.json").read_text(encoding="utf-8"))
    found["surface"] |= {"middle": {}, "metrics": {"D.mean_square_moment": {}}}
    (out / "sweep.json").write_text(json.dumps(found), encoding="utf-8")
    page = open_page(write_folder(out))
    assert "sweep.json is not as this page knows it" in page.text("#page")
    assert page.all("#allocation, #tolerances") and page.complaints() == []


def test_the_policy_blocks_what_would_be_injected(page):
    page.run(
        "const one = document.createElement('script'); one.textContent = 'window.attacked = 1';"
        "document.body.append(one)"
    )
    page.run("document.body.insertAdjacentHTML('beforeend', '<img src=\"data:,x\" onerror=\"window.attacked = 2\">')")
    page.run("document.body.insertAdjacentHTML('beforeend', '<p id=\"styled\" style=\"color: rgb(1, 2, 3)\">x</p>')")
    page.run("window.asked = fetch('https://example.org/').then(() => 'sent', () => 'blocked')")
    assert page.run("return window.asked") == "blocked"
    page.run("return new Promise((done) => setTimeout(done, 100))")
    assert page.run("return window.attacked") is None
    assert page.run("return getComputedStyle(document.getElementById('styled')).color") != "rgb(1, 2, 3)"
    said = page.complaints()
    assert any("script" in one and "Content Security Policy" in one for one in said)


def test_copied_formulas_are_texts(open_page, hostile):
    page = open_page(hostile)
    page.run("navigator.clipboard.writeText = (text) => { window.copied = text; return Promise.resolve(); }")
    page.run("document.querySelectorAll('#page-checks .copy, #page-tables .copy').forEach((one) => one.click())")
    copied = page.wait("return window.copied")
    assert not [cell for line in copied.split("\n") for cell in line.split("\t") if cell[:1] in "=+@" and cell]
