"""Analyses beside simulation and tolerance tasks: natural modes, the kinetostatic turn; a file each, and commands.

analysis      what they have in common: cases, files
modes_report  natural frequencies, shapes and derivatives
turn_report   preload, holding moment and stresses over the drive's range
commands      subcommands of `rfem-jax`
"""
