"""The terminal and the process of a command.

console    the streams, whatever they are: closed, unread, or without the characters that are printed
messages   what is printed, and the line of progress above which it stands
process    precision, devices, the cache of programs, and other processes with which a command shares the machine
timings    how long a task will take, from what it took before
"""
