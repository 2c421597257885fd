"""``mavbridge bench``: what this machine reaches with one policy.

    engines   encoding one image and sampling one chunk, on every engine that runs here
    flight    both loops, flown against the simulated vehicle
    link      an attitude out of a vehicle until the sticks made from it arrive

Flight and link run in child processes; this process only waits. Comparisons with other software
are in ``benchmarks/`` of the source tree.
"""
