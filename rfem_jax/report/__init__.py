"""What a person sees: tables, files, pictures and the command line.

The last package of the pipeline (description -> mechanics -> simulation -> tolerancing -> report).
It computes no mechanics: `summary` picks the numbers out of the runs once, `tables`, `files` and
`figures` show them, `command_line` and its subcommands in `commands` tie the packages
together. Nothing is imported here, so that
`rfem-jax --help` does not wait for JAX or matplotlib.
"""
