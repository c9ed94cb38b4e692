"""Every number of a description by a name.

parts          where the numbers are
parameters     their names
design_table   the table [design]
deviations     which errors and parameters may deviate
"""
