"""What is compiled in the background when a process ends: Python would be aborted while XLA compiles."""

import os
import subprocess
import sys
import threading

import pytest

from rfem_jax.compilation import pending
from tests.processes import ROOT, in_a_new_process

SLOW = """
import sys, time
from rfem_jax.compilation.pending import Pending, in_progress

class Slow:
    head = None

    def finish(self):
        time.sleep(float(sys.argv[1]))
        print("made", flush=True)

assert not in_progress()
Pending(Slow()).begin()
assert in_progress()
"""
COMMAND = f"""{SLOW}
from rfem_jax.report import command_line

def main():
    print("said")
    return int(sys.argv[2])

command_line.main = main
sys.exit(command_line.run_process())
"""


def test_python_ends_when_it_is_done():
    assert in_a_new_process(SLOW, "0.5") == "made"


@pytest.mark.parametrize(["code", "lasts", "said"], [(7, 600, "said\n"), (0, 0.5, "said\nmade\n")])
def test_a_command_ends_with_its_code_and_all_that_it_says_and_at_once_if_it_fails(code, lasts, said):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": ""}
    command = [sys.executable, "-c", COMMAND, str(lasts), str(code)]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert (answer.returncode, sorted(answer.stdout.split()), answer.stderr) == (code, sorted(said.split()), "")


@pytest.mark.wrong_types  # a program that waits
@pytest.mark.parametrize("fails", [False, True])
def test_what_is_done_is_not_in_progress(fails):
    class Program:
        head = None

        def __init__(self):
            self.may_end = threading.Event()

        def finish(self):
            self.may_end.wait()
            if fails:
                raise ValueError("of XLA")
            return "executable"

    program, others = Program(), set(pending._threads)
    pending.Pending(program).begin()
    (thread,) = pending._threads - others
    assert pending.in_progress()
    program.may_end.set()
    thread.join()
    assert thread not in pending._threads
