"""Vision policies: nets only, no MAVLink, threads or clock. ``policy.contract`` is the way in."""
