"""A study and its file.

study                          a mechanism with its drive, method, cases and tasks
study_reader, force_reader     the tables of a file
key_reference, schema          what `rfem-jax keys` tells; the JSON Schema for editors
plausibility                   what is odd, though possible
"""
