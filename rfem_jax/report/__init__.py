"""What a person sees: tables, files, pictures and the command line.

It computes no mechanics. Nothing is imported here, so that `rfem-jax --help` does not wait for JAX or matplotlib.

    command_line      `rfem-jax`; its subcommands are in `commands`
    task_comparison   answers of tasks in two folders side by side
    tasks             what tolerance studies show: texts, tables, pictures
    analyses          modes, loads at rest, the turn of a drive
    page              the page of results
    validation        `rfem-jax validate`
    drawings          pictures of mechanisms and curves
    contents          tables, sentences and files of numbers
    terminal          what is printed, progress, the process of a command
"""
