"""Values, ports, clock, errors and threads: what everything else may know."""
