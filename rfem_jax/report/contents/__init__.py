"""What a person reads: names and units, tables, sentences and files of numbers.

annotations               types of what is reported
summary                   the numbers of the runs, picked out once
tables                    these on the terminal
overview                  what `check` says of a study
files                     results.json and the cases' CSV files
motion_files              motions for other programs
comparison                results of two folders side by side
driven_motions_report     what the drives do
keys_text                 `rfem-jax keys`
output                    writing JSON and CSV
"""
