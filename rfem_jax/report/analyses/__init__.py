"""Analyses beside simulation and tolerance tasks: a file each; their commands are in `report/commands`.

analysis      what they have in common: cases, files
modes_report  natural frequencies, shapes and derivatives
turn_report   preload, holding moment and stresses over the drive's range
"""
