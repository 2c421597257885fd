"""The processes of a flight that is broken on purpose: vehicle, relay, camera, bridge, viewer."""
