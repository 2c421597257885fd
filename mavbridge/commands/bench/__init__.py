"""``mavbridge bench``: what this machine reaches, beside what it could and what others do.

    kernels   one encode, one chunk, every engine, against the roofline of one thread
    flights   both loops against the simulated vehicle, and the usual runner beside them
    link      attitude out of the vehicle to sticks back in, and the peers beside us

Each measured thing runs in a process of its own; the parent only waits. The runner, the echoing
vehicle and the peers' programs are in the source tree's ``benchmarks/``, outside the package.
"""
