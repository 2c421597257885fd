"""Recorded flights on disk, in the format of docs/formats.md.

    loops and TelemetryCache --emit--> Recorder (its own thread) --> FlightWriter --> tables
                                                                         |
                                      VideoWriter: frames through shared memory
                                                                         v
                                            writer process --> camera.mp4
    process of the link --open_tlog_pipe--> writer process --> link.tlog

``FlightWriter`` alone, in the offline mode, records flights that need not run in real time
(demonstrations). ``VideoWriter`` alone makes one video of frames from any source (rollouts).
``open_flight`` reads a recording back, also after a crash. The loops do not import this package.
"""
