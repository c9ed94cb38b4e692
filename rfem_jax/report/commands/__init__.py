"""The subcommands of `rfem-jax`: one file each.

    command      what a subcommand is: its words for `--help`, its options, what it does; exit codes, common options
    catalogue    all of them, in the order of `--help`; the names stand in `rfem_jax.task_kinds.COMMANDS`
    steps        what several do: read a study, settle its method, say what begins
    folders      folders for results
    init, run, check, compare, keys, import, export, validate; `tasks` makes one of every kind of task

Place in the pipeline: `report.command_line` parses and calls them. Each file imports nothing at its top that takes
long (JAX, NumPy, the description), as all of them are loaded for `--help`.
"""
