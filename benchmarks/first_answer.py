"""How long a user waits for the first answer: processor and clock time of whole processes.

    python benchmarks/first_answer.py [--old FOLDER] [--repeat 3] [--only run check ...] [--no-exudyn] [--out FOLDER]

Every command runs in a process of its own with an empty home (cold: nothing compiled, no cache but Python's byte
code), then again (warm).  With `--old`, this version and another checkout of the project alternate, so that the load of
the machine is the same for both.  Times are those of the process and all its children, as the system counts them;
installation is excluded.  Prints a table of medians and writes it with all single times to
`benchmark_results/first_answer.json`.

    run          README's first command: five cases, tables, files, pictures
    check        the same study, validated and described
    one_case     its last case alone, without matplotlib
    example      the Python example of loads and a derivative; both versions keep JAX's own cache
    gradient     mean-square moments by 3 errors, batch of 16, `auto` at 0.1 %; likewise
    sensitivity, monte_carlo   the shipped studies
    new_run         the slider-crank of `rfem-jax init`, rigid and without errors
    new_sensitivity   that slider-crank as it is written, its tolerance studies switched on

Exudyn, which compiles nothing, does two of them (`exudyn_first_answer.py`): `run`, five cases with their static
starts, and `monte_carlo`, 4096 samples on all cores, with its fastest step and settings within 0.1 %.
"""

import argparse
import json
import os
import platform
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
COMMAND = "rfem_jax.report.command_line"
WITHOUT_PLOTS = f"import runpy, sys; sys.modules['matplotlib'] = None; runpy.run_module('{COMMAND}', None, '__main__')"
GRADIENT = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import rfem_jax
from rfem_jax import Problem, discretise, load_study

study = load_study("studies/four_bar/study.toml")
model = discretise(study.mechanism)
metrics = [f"{joint}.mean_square_moment" for joint in "ABCD"]
names = ("D.delta_x", "D.delta_z", "D.d_y")
if hasattr(rfem_jax, "Simulation"):
    method = rfem_jax.Automatic(accuracy=1e-3)
    simulation = rfem_jax.Simulation(model, drive=study.drive, duration=study.duration, method=method)
    problem = Problem(simulation, metrics)
else:  # of an older checkout
    problem = Problem(model, study.drive, study.duration, metrics, rfem_jax.Method("auto", accuracy=1e-3))
points = jnp.linspace(0.5, 1.5, 16)[:, None] * jnp.array([[5e-3, 4e-3, 5e-4]])

def values(point):
    return problem(dict(zip(names, point)))[0]

print(jax.vmap(jax.jacfwd(values))(points))
"""
KEEPS_JAX_CACHE = ("example", "gradient")
NAMES = (
    "run", "check", "one_case", "example", "gradient", "sensitivity", "monte_carlo", "new_run", "new_sensitivity"
)  # fmt: skip


def example(folder: Path) -> str:
    """The Python example of loads and a derivative, which stood in the README and is in the guide now, up to the
    derivative."""
    files = [file for file in (folder / "README.md", folder / "docs" / "guides" / "python.md") if file.exists()]
    blocks = [
        block for file in files for block in re.findall(r"```python\n(.*?)```", file.read_text(encoding="utf-8"), re.S)
    ]
    derivative = "jax.jacfwd(moment)(0.005)"
    return next(block.partition(derivative)[0] + derivative for block in blocks if derivative in block)


def new_study(name: str, work: Path) -> Path:
    """What a new user has before the first command: the slider-crank of `rfem-jax init`, of this version for both."""
    started = HERE / "rfem_jax" / "report" / "starting_studies" / "slider_crank.toml"
    before, mark, tasks = started.read_text(encoding="utf-8").partition("# [tolerances]")
    text = before.replace("rfes = 5", "rigid = true").partition('[[cases]]\nname = "guide_tilted"')[0]
    if name == "new_sensitivity":
        text = before + re.sub(r"^# ?", "", f"{mark}{tasks}", flags=re.MULTILINE)
    file = work / f"{name}.toml"
    file.write_text(text, encoding="utf-8")
    return file


def command_of(name: str, folder: Path, work: Path) -> list[str]:
    """Arguments of Python for one program of the checkout in `folder`; files go into `work`."""
    study = "studies/four_bar/study.toml"
    out = ["--out", str(work / f"{name}_results")]
    if name == "example":
        return ["-c", example(folder)]
    if name == "gradient":
        return ["-c", GRADIENT]
    if name.startswith("new_"):
        return ["-m", COMMAND, name.removeprefix("new_"), str(new_study(name, work)), *out]
    if name == "one_case":
        before, *cases = (folder / study).read_text(encoding="utf-8").split("[[cases]]")
        one = work / "one_case.toml"
        one.write_text(f"{before}[[cases]]{cases[-1]}", encoding="utf-8")
        return ["-c", WITHOUT_PLOTS, "run", str(one), *out]
    arguments = {
        "run": ["run", study, *out],
        "check": ["check", study],
        "sensitivity": ["sensitivity", "studies/tolerance_sensitivity/study.toml", *out],
        "monte_carlo": ["monte-carlo", "studies/monte_carlo/study.toml", *out],
    }
    return ["-m", COMMAND, *arguments[name]]


def environment_of(name: str, folder: Path, home: Path) -> dict[str, str]:
    """The environment with a home of its own, without choices about caches or compilation; Python keeps byte code."""
    choices = ("JAX_", "XLA_", "RFEM_", "XDG_", "MPL", "PYTHONDONTWRITEBYTECODE")
    ours = {key: value for key, value in os.environ.items() if not key.startswith(choices)}
    ours |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache"), "PYTHONPATH": str(folder)}
    if name in KEEPS_JAX_CACHE:
        ours["JAX_COMPILATION_CACHE_DIR"] = str(home / "jax")
    return ours


def measure(python: str, arguments: list[str], folder: Path, environment: dict) -> dict:
    """{"cpu", "clock": s, "memory_mb"} of one process with its children. Raises: SystemExit if it fails."""
    with tempfile.TemporaryFile() as said:
        started = time.perf_counter()
        process = subprocess.Popen(
            [python, *arguments], cwd=folder, env=environment, stdout=said, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
        clock = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            said.seek(0)
            raise SystemExit(f"{arguments} failed in {folder}:\n{said.read().decode()[-3000:]}")
    return {"cpu": usage.ru_utime + usage.ru_stime, "clock": clock, "memory_mb": usage.ru_maxrss / 1e3}


def measure_all(name: str, versions: dict[str, Path], repeat: int, python: str) -> list[dict]:
    """Single times of one program: {"program", "version", "state", "cpu", "clock"}; versions alternate."""
    rows = []
    for _ in range(repeat):
        with tempfile.TemporaryDirectory() as root:
            homes = {version: Path(root) / version for version in versions}
            for state in ("cold", "warm"):
                for version, folder in versions.items():
                    work = homes[version]
                    work.mkdir(exist_ok=True)
                    shutil.rmtree(work / f"{name}_results", ignore_errors=True)
                    arguments = command_of(name, folder, work)
                    taken = measure(python, arguments, folder, environment_of(name, folder, work))
                    rows.append({"program": name, "version": version, "state": state, **taken})
                    print(
                        f"{name}, {version}, {state}: {taken['cpu']:.1f} s of CPU, {taken['clock']:.1f} s",
                        file=sys.stderr, flush=True,
                    )  # fmt: skip
    return rows


def measure_exudyn(name: str, repeat: int, python: str) -> list[dict]:
    """The same by Exudyn; a first run, which is not timed, fills the caches of the model's numbers."""
    rows = []
    with tempfile.TemporaryDirectory() as home:
        environment = environment_of("example", HERE, Path(home))
        arguments = [str(HERE / "benchmarks" / "exudyn_first_answer.py"), name]
        measure(python, [*arguments, "--samples", "2"], HERE, environment)
        for _ in range(repeat):
            taken = measure(python, arguments, HERE, environment)
            rows.append({"program": name, "version": "Exudyn", "state": "warm", **taken})
    return rows


def table(rows: list[dict]) -> str:
    """Medians as Markdown: CPU and clock seconds by program, state and version, now over old."""

    def median(program, version, state, what):
        found = [r[what] for r in rows if (r["program"], r["version"], r["state"]) == (program, version, state)]
        return statistics.median(found) if found else None

    def cell(*key):
        cpu, clock = median(*key, "cpu"), median(*key, "clock")
        return "-" if cpu is None else f"{cpu:.1f}, {clock:.1f}"

    lines = [
        "| program | state | old: CPU, clock s | now: CPU, clock s | now / old: CPU, clock | Exudyn: CPU, clock s |",
        "|---|---|---|---|---|---|",
    ]
    for program in dict.fromkeys(r["program"] for r in rows):
        for state in ("cold", "warm"):
            shares = []
            for what in ("cpu", "clock"):
                pair = [median(program, version, state, what) for version in ("now", "old")]
                shares.append("-" if None in pair else f"{pair[0] / pair[1]:.2f}")
            cells = [cell(program, version, state) for version in ("old", "now", "Exudyn")]
            lines.append(f"| {program} | {state} | {cells[0]} | {cells[1]} | {', '.join(shares)} | {cells[2]} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--old", type=Path, help="another checkout of the project, measured alternately")
    parser.add_argument("--repeat", type=int, default=3, help="cold and warm starts of each program")
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, metavar="NAME")
    parser.add_argument("--no-exudyn", action="store_true")
    parser.add_argument("--python", default=sys.executable, help="interpreter of the measured processes")
    parser.add_argument("--out", type=Path, default=HERE / "benchmark_results", help="folder for the times")
    options = parser.parse_args()
    versions = {"now": HERE} | ({"old": options.old.resolve()} if options.old else {})
    rows = []
    for name in options.only:
        rows += measure_all(name, versions, options.repeat, options.python)
        if name in ("run", "monte_carlo") and not options.no_exudyn:
            rows += measure_exudyn(name, options.repeat, options.python)
        print(f"\n{table(rows)}\n", flush=True)
        write(rows, options)


def write(rows: list[dict], options) -> None:
    """All single times and the table, after every program: a long measurement may be interrupted."""
    options.out.mkdir(parents=True, exist_ok=True)
    machine = {"python": platform.python_version(), "cores": os.cpu_count(), "machine": platform.processor()}
    limits = {"memory_bytes": resource.getrlimit(resource.RLIMIT_AS)[0]}
    content = {"machine": machine | limits, "old": str(options.old), "times": rows, "table": table(rows)}
    (options.out / "first_answer.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
