"""Names of errors, tolerances and zones of drawings.

error_catalogue    the errors of every kind of joint
tolerances         distributions and correlations of errors and parameters
zones              position, coaxiality and the like: two errors or more in one zone
"""
