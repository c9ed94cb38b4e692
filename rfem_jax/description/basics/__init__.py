"""What all descriptions need: units, sentences of errors, tables of files, kinds of joints.

errors, near_names         InputError: what is wrong, and what was meant
units, numbers             quantities with units; what is a number of a description
tables                     tables of a study file
joint_kinds                what each kind of joint lets move, and which errors it has
iso_fits                   fits and tolerance grades
own_functions              functions and modules of the user's own
precision                  double precision is asked for
notebook_tables            descriptions as tables in notebooks
"""
