"""The report of `rfem-jax validate`.

validation_command   problems computed one after another
validation_tables    what is printed and written
validation_figures   the picture
"""
