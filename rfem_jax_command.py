"""The command `rfem-jax` from its first instant: what is imported takes a while, in which Ctrl-C may come.

Place in the pipeline: **the command's script** -> `rfem_jax.report.command_line`. It is no part of the package, which
would be imported first.
"""

import sys


def run() -> int:
    """Run the command as all that this process does; returns its exit code."""
    try:
        from rfem_jax.report.command_line import run_process
    except KeyboardInterrupt:
        if sys.stderr is not None:
            print("Interrupted: nothing was done yet; start the same command again.", file=sys.stderr)
        return 130
    return run_process()


if __name__ == "__main__":
    sys.exit(run())
